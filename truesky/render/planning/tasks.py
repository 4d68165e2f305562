"""From exposures to render tasks: one a detector, with its cells and what it will cost.

table      rows of the table `tasks`, longest first
remembering  the same, with what earlier exposures left in the detectors;  remembered  how long before those are
in_order   those of several parts
part       those of them that are to be rendered now
Narrowed   the same of tasks that come a part after the other
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import takewhile
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import pyarrow.compute as pc

from lake_schema import sky
from lake_schema.arrays import Float, Int
from lake_schema.errors import BadInput
from lake_schema.ids import GENERATION_ORDER
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.tables.exposures import ExposureRow
from lake_schema.tables.tasks import TASKS
from truesky.render.camera import amplifiers, pointing
from truesky.render.camera import detectors as camera_detectors
from truesky.render.channels import registry
from truesky.render.effects.readout import adc
from truesky.render.exposure import persistence, scene_of
from truesky.render.exposure.records import Variant
from truesky.render.planning import variants
from truesky.render.planning.planned_exposures import Exposure
from truesky.render.planning.prices import Files, Price, price
from truesky.render.planning.source_counts import Densities
from truesky.request.accuracy import SURVEY, Accuracy
from truesky.request.schema import Request

_ITS_OWN = Files()
# Pointings whose detectors' cells are found at once: within so many deg of the first, and as many.
_TOGETHER, _MOST_TOGETHER = 0.5, 16
_POLYGON = "POLYGON ICRS " + " ".join(["%.7f"] * 8)

# ------------------------------------------------------------------------------------------------ tasks


def table(
    exposures: pa.Table,
    detectors: Sequence[tuple[str, ...]],
    mission: MissionConfiguration,
    densities: Densities,
    truth: Sequence[str] = (),
    accuracy: Accuracy = SURVEY,
    forced: Mapping[str, bool] | None = None,
    files: Files = _ITS_OWN,
) -> pa.Table:
    """Rows of the table `tasks`.

    exposures  : rows of the table `exposures`;  detectors : of each exposure, () = all of its camera
    truth      : truth maps that are wanted;  files : what is written besides
    forced     : effects that the request forces on or off
    mission    : the mission database;  densities : of galaxies and stars;  accuracy : of the request
    """
    pairs = set(zip(exposures["camera"].to_pylist(), exposures["channel"].to_pylist(), strict=True))
    cameras = {pair: _Camera(*pair, mission) for pair in pairs}
    rows = [ExposureRow.of(row) for row in exposures.to_pylist()]
    looking = {_where(row, cameras): cameras[row.camera, row.channel] for row in rows}
    places = dict(zip(looking, _places(looking, densities), strict=True))
    prices: dict[tuple[Any, ...], Price] = {}
    planned: list[_Planned] = []
    for row, wanted in zip(rows, detectors, strict=True):
        kind = (row.camera, row.channel, row.image_type, row.exposure_time_s, row.lamp, row.settings)
        if kind not in prices:
            own = variants.variant(row.settings, mission, accuracy, forced or {})
            prices[kind] = _price(row, own, truth, files)
        camera = cameras[row.camera, row.channel]
        planned.append(_Planned.of(row, wanted, camera, places[_where(row, cameras)], prices[kind]))
    return _rows(planned, list(places.values()))


def _remembering(exposures: pa.Table) -> set[str]:
    """Cameras of the exposures whose detectors have something left of those before."""
    kinds = zip(exposures["camera"].to_pylist(), exposures["channel"].to_pylist(), strict=True)
    return {camera for camera, channel in dict.fromkeys(kinds) if registry.CHANNELS[channel].remembers is not None}


def remembered(exposures: pa.Table, mission: MissionConfiguration) -> float:
    """How long before one of the exposures another leaves something in its detectors, days; 0 where none does."""
    return max((persistence.window(camera, mission) for camera in _remembering(exposures)), default=0.0)


def remembering(
    rows: pa.Table, exposures: pa.Table, plan: Iterable[Exposure], mission: MissionConfiguration
) -> pa.Table:
    """Rows of `tasks` with the time that it takes to draw anew what earlier exposures left in the detectors.

    exposures : rows of the table `exposures`, of the tasks;  mission : the mission database
    plan      : exposures that begin while these do, or before them as long as some are remembered
    Error     : as if each exposure were of all detectors
    """
    if not (cameras := _remembering(exposures)):
        return rows
    left: dict[str, dict[float, float]] = {camera: {} for camera in cameras}
    for one in plan:
        channel = registry.CHANNELS[one.channel]
        # Of those that begin at once one has been.
        if one.camera in cameras and channel.sees_sky(one.image_type):
            left[one.camera][one.mjd] = channel.cost.again_s
    more = {}
    # Whole microseconds: sums of a part are those of the whole.
    for camera, dated in left.items():
        days = persistence.window(camera, mission)
        began = np.array(sorted(dated))
        total = np.cumsum([0, *(round(1e6 * dated[mjd]) for mjd in began.tolist())])
        for row in exposures.select(["exposure_id", "camera", "channel", "mjd"]).to_pylist():
            if row["camera"] == camera and registry.CHANNELS[row["channel"]].remembers is not None:
                first, last = np.searchsorted(began, (row["mjd"] - days, row["mjd"]))
                more[row["exposure_id"]] = 1e-6 * float(total[last] - total[first])
    own = [more.get(number, 0.0) for number in rows["exposure_id"].to_pylist()]
    at = rows.schema.get_field_index("seconds")
    seconds = pa.array(rows["seconds"].to_numpy() + np.array(own), rows.schema.field(at).type)
    return _longest_first(rows.set_column(at, rows.schema.field(at), seconds))


def _where(row: ExposureRow, cameras: Mapping[tuple[str, str], _Camera]) -> tuple[Any, ...]:
    """What exposures have in common whose detectors look at the same places."""
    return row.camera, cameras[row.camera, row.channel].margin, row.ra, row.dec, row.position_angle


def in_order(tasks: pa.Table) -> pa.Table:
    """Rows of several parts, longest first; of one part they are already."""
    return tasks.combine_chunks() if tasks["exposure_id"].num_chunks < 2 else _longest_first(tasks)


def _longest_first(tasks: pa.Table) -> pa.Table:
    keys = [("seconds", "descending"), ("exposure_id", "ascending"), ("detector", "ascending")]
    return tasks.sort_by(keys).combine_chunks()


def part(tasks: pa.Table, request: Request) -> list[dict[str, Any]]:
    """Rows of the request's detectors, the first so many of them by exposure and name where it has a limit.

    Errors : BadInput where no exposure has a detector of that name, or the limit leaves none
    """
    narrowed = Narrowed(request)
    found: list[dict[str, Any]] = narrowed.of(tasks).to_pylist()
    narrowed.refuse_unknown()
    return found


class Narrowed:
    """What is wanted of tasks that come a part after the other, in the order of their exposures.

    Errors : BadInput where the request's limit leaves none
    """

    def __init__(self, request: Request) -> None:
        if request.limit is not None and request.limit < 1:
            raise BadInput(f"limit = {request.limit} leaves no detector")
        self.request, self._left = request, request.limit
        self._known: set[str] = set()

    @property
    def is_narrow(self) -> bool:
        """Whether anything may be left out."""
        return bool(self.request.detectors) or self.request.limit is not None

    @property
    def is_done(self) -> bool:
        """Whether nothing is wanted of what comes yet."""
        return self._left == 0 and {*self.request.detectors} <= self._known

    def of(self, tasks: pa.Table) -> pa.Table:
        """Rows of the request's detectors, as long as there are not too many."""
        if self.request.detectors:
            self._known |= {*tasks["detector"].unique().to_pylist()}
            tasks = tasks.filter(pc.is_in(tasks["detector"], pa.array(self.request.detectors, pa.string())))
        if self._left is not None:
            order = pc.sort_indices(tasks, [("exposure_id", "ascending"), ("detector", "ascending")])
            tasks = tasks.take(pa.array(np.sort(order.slice(0, self._left).to_numpy())))
            self._left -= tasks.num_rows
        return tasks

    def refuse_unknown(self) -> None:
        """BadInput where none of the tasks had a detector that the request names."""
        if unknown := sorted({*self.request.detectors} - self._known):
            plan = f"the plan of request {self.request.name}"
            some = ", ".join(sorted(self._known)[:4])
            raise BadInput(f"detectors: {unknown[0]} is not in {plan}, which has {some}, ...")


@dataclass(frozen=True, slots=True)
class _Places:
    """Where the detectors of a camera look that points somewhere; first : number of the first of them in a plan."""

    first: int
    names: list[str]
    ra: Float
    dec: Float
    radius: Float
    cells: list[Int]
    regions: list[str]
    density: Float


@dataclass(frozen=True, slots=True)
class _Planned:
    """The detectors of an exposure that are wanted: where they look, by number, and what each will cost."""

    exposure_id: int
    channel: str
    looks: bool
    places: Int
    sources: Int
    seconds: Float
    memory: Float
    bytes: Int

    @classmethod
    def of(cls, row: ExposureRow, wanted: tuple[str, ...], camera: _Camera, places: _Places, cost: Price) -> _Planned:
        looks = row.image_type in registry.CHANNELS[row.channel].sky_types
        chosen = [camera.index[name] for name in dict.fromkeys(wanted)] or range(len(camera.detectors))
        which = np.array(chosen, np.int64)
        galaxies, stars = places.density[:, which] * (camera.area[which] * looks)
        pixels = camera.pixels[which]
        return cls(
            row.exposure_id,
            row.channel,
            looks,
            places.first + which,
            np.ceil(galaxies + stars).astype(np.int64),
            cost.seconds(pixels, galaxies, stars),
            cost.memory(pixels),
            cost.bytes(pixels, camera.read[which]),
        )


def _rows(planned: Sequence[_Planned], places: Sequence[_Places]) -> pa.Table:
    """The detectors of all exposures, longest first."""
    if not planned:
        return TASKS.empty()
    numbers = np.array([one.exposure_id for one in planned], np.int64)
    channels = np.array([one.channel for one in planned], object)
    of = np.repeat(np.arange(len(planned)), [len(one.places) for one in planned])
    where = np.concatenate([one.places for one in planned])
    names = np.array([name for one in places for name in one.names], object)
    seconds = np.concatenate([one.seconds for one in planned])
    order = np.lexsort((_ranks(names)[where], numbers[of], -seconds))
    of, where = of[order], where[order]
    regions = np.array([region for one in places for region in one.regions], object)
    looks = np.array([one.looks for one in planned])
    lists, none = _lists([cells for one in places for cells in one.cells])
    sky_of = {name: np.concatenate([getattr(one, name) for one in places])[where] for name in ("ra", "dec", "radius")}
    costs = {
        name: np.concatenate([getattr(one, name) for one in planned])[order]
        for name in ("sources", "seconds", "memory", "bytes")
    }
    return TASKS.build(
        {
            "exposure_id": numbers[of],
            "detector": names[where],
            "channel": channels[of],
            **sky_of,
            "cells": lists.take(pa.array(np.where(looks[of], where, none))),
            "s_region": regions[where],
            **costs,
        }
    )


def _ranks(names: npt.NDArray[np.object_]) -> Int:
    """Of each name its place in the alphabet."""
    return np.unique(names.astype(str), return_inverse=True)[1]


def _lists(cells: Sequence[Int]) -> tuple[pa.ListArray, int]:
    """Lists of cells, and the number of one more that is empty."""
    ends = np.cumsum([0, *map(len, cells), 0], dtype=np.int32)
    return pa.ListArray.from_arrays(ends, np.concatenate([*cells, np.empty(0, np.int64)])), len(cells)


class _Camera:
    """Detectors of a camera, and what of them does not depend on the pointing.

    margin : arcsec beyond a detector, as far as the channel reads all sources
    """

    def __init__(self, camera: str, channel: str, mission: MissionConfiguration) -> None:
        self.detectors = camera_detectors.detectors(camera, mission)
        self.names = [detector.name for detector in self.detectors]
        self.index = {name: i for i, name in enumerate(self.names)}
        self.x, self.y = pointing.outline(self.detectors)
        self.margin = registry.CHANNELS[channel].margin(self.detectors[0].section, mission)
        # On the tangent plane, where a detector that the optics distort is larger than it is.
        corner = np.hypot(self.x[:, 1:] - self.x[:, :1], self.y[:, 1:] - self.y[:, :1]).max(axis=1)
        reach = np.array([max(d.half_diagonal, c) for d, c in zip(self.detectors, corner, strict=True)])
        self.radius = (reach + self.margin) / 3600.0
        self.pixels = np.array([detector.nx * detector.ny for detector in self.detectors])
        layouts = [amplifiers.layout(detector, mission) for detector in self.detectors]
        read = [layout and math.prod(layout.raw_shape) for layout in layouts]
        self.read = np.array([n or pixels for n, pixels in zip(read, self.pixels, strict=True)])
        self.area = np.array([d.nx * d.ny * (d.pixel_scale / 3600.0) ** 2 for d in self.detectors])


def _places(looking: Mapping[tuple[Any, ...], _Camera], densities: Densities) -> Iterator[_Places]:
    """Where the detectors look of each camera that points somewhere."""
    first, waiting = 0, list(looking.items())
    while waiting:
        # The dithers of a field: their detectors share most of their cells.
        _, _, ra, dec, _ = waiting[0][0]
        near = (float(sky.separation(ra, dec, *place[2:4])) < _TOGETHER for place, _ in waiting[:_MOST_TOGETHER])
        many = sum(1 for _ in takewhile(bool, near))
        group, waiting = waiting[:many], waiting[many:]
        outlines = [pointing.sky_of_plane(camera.x, camera.y, *place[2:]) for place, camera in group]
        lon, lat = (np.concatenate([one[axis] for one in outlines]) for axis in (0, 1))
        radius = np.concatenate([camera.radius for _, camera in group])
        cells = sky.cells_in_cones(lon[:, 0], lat[:, 0], radius, GENERATION_ORDER)
        corners = np.stack([lon[:, 1:], lat[:, 1:]], axis=2).reshape(len(lon), -1).tolist()
        density = densities.at(lon[:, 0], lat[:, 0])
        start = 0
        for _, camera in group:
            own = slice(start, start + len(camera.names))
            start = own.stop
            yield _Places(
                first,
                camera.names,
                lon[own, 0],
                lat[own, 0],
                camera.radius,
                cells[own],
                [_POLYGON % tuple(some) for some in corners[own]],
                density[:, own],
            )
            first += len(camera.names)


def _price(row: ExposureRow, own: Variant, truth: Sequence[str], files: Files) -> Price:
    """Of the detectors of an exposure.

    Somewhere on a detector there is light enough for every effect; of a frame without a sky the scene is known.
    """
    channel, kind = row.channel, row.image_type
    looks = kind in registry.CHANNELS[channel].sky_types
    effects = registry.CHANNELS[channel].read_as(files.readout).effects.get(kind)
    if effects is not None:
        every = camera_detectors.detectors(row.camera, own.mission)
        amplifiers.refuse_spread(every, own.mission)
        scene = replace(scene_of.scene_of(row, every[0], own.mission, own.accuracy), forced=own.forced)
        scene = scene_of.with_own_light(scene, registry.CHANNELS[channel], effects)
        files = replace(files, wide=adc.pixel_type(scene) is np.int32)
        effects = tuple(e for e in effects if own.forced.get(e.name, looks or e.needed_if(scene)))
    return price(channel, looks, effects, own.accuracy, truth, files)
