"""Make the table `tasks`, which has one row per detector of each exposure.

A row has the position of the detector, the HEALPix cells that it sees, and the estimated cost to render its image.
Render jobs select rows of this table as their tasks.
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
from lake_schema.texts import spelling
from truesky.fluxes import passbands
from truesky.render.camera import amplifiers, pointing
from truesky.render.camera import detectors as camera_detectors
from truesky.render.channels import registry
from truesky.render.effects.charge import ramp
from truesky.render.effects.effect import Effect
from truesky.render.effects.light import calibration_lamp
from truesky.render.effects.readout import adc
from truesky.render.effects.scene import Scene
from truesky.render.exposure import persistence, scene_factory
from truesky.render.exposure.records import Variant
from truesky.render.planning import variants
from truesky.render.planning.detector_costs import CostModel, OutputFiles, RampLoad, cost_model
from truesky.render.planning.planned_exposures import Exposure
from truesky.render.planning.source_counts import Densities
from truesky.request.accuracy import SURVEY, Accuracy
from truesky.request.schema import Request

# Largest number of planned detectors that a message lists.
_MAX_EXAMPLES = 4
_DETECTOR_FILES = OutputFiles()
# The HEALPix cells that detectors see are searched at once for several successive pointings. They must be within this
# distance (deg) of the first of them.
_GROUP_RADIUS = 0.5
# Largest number of successive pointings for which the HEALPix cells that detectors see are searched at once.
_MAX_GROUP = 16
# Format of an IVOA STC-S region from the ra and dec (deg) of the four corners of a detector.
_POLYGON = "POLYGON ICRS " + " ".join(["%.7f"] * 8)


def table(
    exposures: pa.Table,
    detectors: Sequence[tuple[str, ...]],
    mission: MissionConfiguration,
    densities: Densities,
    truth: Sequence[str] = (),
    accuracy: Accuracy = SURVEY,
    forced: Mapping[str, bool] | None = None,
    files: OutputFiles = _DETECTOR_FILES,
) -> pa.Table:
    """Make the rows of the table `tasks` for some exposures, sorted by estimated CPU time, longest first.

    Parameters
    ----------
    exposures : pyarrow.Table
        Rows of the table `exposures`.
    detectors : sequence of tuple of str
        Names of the requested detectors for each exposure; () means all detectors of its camera.
    mission : MissionConfiguration
        Mission database: parameters of the telescopes, cameras and survey.
    densities : Densities
        Numbers of galaxies and stars per square degree, for the estimated CPU time.
    truth : sequence of str
        Names of the truth maps (images of the true signals) that are written for each detector.
    accuracy : Accuracy
        Accuracy of the request, used unless an exposure has another.
    forced : mapping of str to bool, optional
        Detector effects that the request forces on (True) or off (False), by name.
    files : OutputFiles
        Format of the image files.

    Returns
    -------
    pyarrow.Table
        One row per requested detector of each exposure; an empty table without exposures.

    Notes
    -----
    The times do not include earlier exposures that leave persistence: `add_persistence_cost` adds them.
    """
    pairs = set(zip(exposures["camera"].to_pylist(), exposures["channel"].to_pylist(), strict=True))
    cameras = {pair: _Camera(*pair, mission) for pair in pairs}
    rows = [ExposureRow.from_row(row) for row in exposures.to_pylist()]
    camera_by_pointing = {_pointing_key(row, cameras): cameras[row.camera, row.channel] for row in rows}
    places = dict(zip(camera_by_pointing, _places(camera_by_pointing, densities), strict=True))
    costs: dict[tuple[Any, ...], CostModel] = {}
    planned: list[_ExposureTasks] = []
    for row, detector_names in zip(rows, detectors, strict=True):
        kind = (row.camera, row.channel, row.band, row.image_type, row.exposure_time_s, row.lamp, row.settings)
        if kind not in costs:
            variant = variants.variant(row.settings, mission, accuracy, forced or {})
            costs[kind] = _cost_of_exposure(row, variant, truth, files)
        camera = cameras[row.camera, row.channel]
        planned.append(
            _ExposureTasks.from_exposure(row, detector_names, camera, places[_pointing_key(row, cameras)], costs[kind])
        )
    return _rows(planned, list(places.values()))


def _cameras_with_persistence(exposures: pa.Table) -> set[str]:
    """Return the names of those cameras of the exposures whose images contain persistence of earlier exposures."""
    camera_channels = zip(exposures["camera"].to_pylist(), exposures["channel"].to_pylist(), strict=True)
    return {
        camera
        for camera, channel in dict.fromkeys(camera_channels)
        if registry.CHANNELS[channel].persistence_effect is not None
    }


def persistence_days(exposures: pa.Table, mission: MissionConfiguration) -> float:
    """Return for how many days after an exposure its persistence (charge that remains in the pixels) is simulated.

    The result is the maximum over the cameras in `exposures` (rows of the table `exposures`). It is 0 if no camera has
    persistence.
    """
    return max(
        (persistence.window_days(camera, mission) for camera in _cameras_with_persistence(exposures)), default=0.0
    )


def add_persistence_cost(
    rows: pa.Table, exposures: pa.Table, candidates: Iterable[Exposure], mission: MissionConfiguration
) -> pa.Table:
    """Add to estimated CPU times the time needed for earlier exposures that leave persistence in an image.

    Parameters
    ----------
    rows : pyarrow.Table
        Rows of the table `tasks`, one per detector of an exposure.
    exposures : pyarrow.Table
        Rows of the table `exposures` to which these tasks belong.
    candidates : iterable of Exposure
        All planned exposures from `persistence_days` days before the first of `exposures` to the last of them. Others
        may be included.
    mission : MissionConfiguration
        Mission database: parameters of the telescopes, cameras and survey.

    Returns
    -------
    pyarrow.Table
        The rows with the new times in column `seconds`, longest first; unchanged if no camera has persistence.

    Notes
    -----
    A worker that renders a detector in order of time draws the charge map of each exposure once. This time is counted
    for the first later exposure. A shorter time is counted for each pair of an exposure and an earlier one, for the
    charge that is released. Each earlier exposure of a camera is counted for all its detectors, even if it was
    requested only for some.
    """
    if not (cameras := _cameras_with_persistence(exposures)):
        return rows
    redraw_us: dict[str, dict[float, int]] = {camera: {} for camera in cameras}
    for candidate in candidates:
        if candidate.camera in cameras:
            channel = registry.CHANNELS[candidate.channel]
            # Store the CPU times by date, so that repetitions of an exposure (same camera and date) count only once.
            redraw_us[candidate.camera][candidate.mjd] = round(
                1e6 * channel.cost.redraw_s * channel.sees_sky(candidate.image_type)
            )
    extra_seconds = {}
    for camera, us_by_mjd in redraw_us.items():
        days = persistence.window_days(camera, mission)
        start_mjds = np.array(sorted(us_by_mjd))
        for row in exposures.select(["exposure_id", "camera", "channel", "mjd"]).to_pylist():
            cost, effect = registry.CHANNELS[row["channel"]].cost, registry.CHANNELS[row["channel"]].persistence_effect
            if row["camera"] == camera and effect is not None:
                first, last = map(int, np.searchsorted(start_mjds, (row["mjd"] - days, row["mjd"])))
                # Sum integer microseconds: the rounding of sums of floats would depend on how exposures are divided
                # into partitions. The maps of exposures before the last one have been drawn for that one.
                drawing_us = us_by_mjd[float(start_mjds[last - 1])] if last > first else 0
                extra_seconds[row["exposure_id"]] = 1e-6 * (drawing_us + (last - first) * round(1e6 * cost.release_s))
    task_seconds = [extra_seconds.get(number, 0.0) for number in rows["exposure_id"].to_pylist()]
    column = rows.schema.get_field_index("seconds")
    seconds = pa.array(rows["seconds"].to_numpy() + np.array(task_seconds), rows.schema.field(column).type)
    return _longest_first(rows.set_column(column, rows.schema.field(column), seconds))


def _pointing_key(row: ExposureRow, cameras: Mapping[tuple[str, str], _Camera]) -> tuple[Any, ...]:
    """Return a dictionary key for the pointing of an exposure.

    Exposures with equal keys have the same camera, position and angle, so that their detectors see the same sky cells.
    """
    return row.camera, cameras[row.camera, row.channel].margin, row.ra, row.dec, row.position_angle


def sort_by_cost(tasks: pa.Table) -> pa.Table:
    """Sort rows of the table `tasks` by estimated CPU time to render the detector, longest first.

    Rows from a single partition (one Arrow chunk) are returned as they are, because partitions are stored sorted.
    """
    return tasks.combine_chunks() if tasks["exposure_id"].num_chunks < 2 else _longest_first(tasks)


def _longest_first(tasks: pa.Table) -> pa.Table:
    keys = [("seconds", "descending"), ("exposure_id", "ascending"), ("detector", "ascending")]
    return tasks.sort_by(keys).combine_chunks()


def select_requested(tasks: pa.Table, request: Request) -> list[dict[str, Any]]:
    """Return the rows of the table `tasks` that a request selects, as dicts in their stored order.

    They are the rows of the detectors that `request.detectors` names, or all rows if it is empty. If `request.limit` is
    not None, only this number of rows is kept, the first ones by exposure number and detector name. Raises BadInput if
    no row has a detector that the request names, or if the limit is below 1.
    """
    selection = TaskSelection(request)
    rows: list[dict[str, Any]] = selection.select(tasks).to_pylist()
    selection.refuse_unknown()
    return rows


class TaskSelection:
    """Select the rows of the table `tasks` that a request asks for, partition by partition.

    Partitions must be given in the order of their exposure numbers, so that the limit on the number of rows keeps the
    first ones. Raises BadInput if this limit is below 1.
    """

    def __init__(self, request: Request) -> None:
        if request.limit is not None and request.limit < 1:
            raise BadInput(f"limit = {request.limit} must be at least 1")
        self.request, self._remaining = request, request.limit
        self._planned_names: set[str] = set()

    @property
    def is_restricted(self) -> bool:
        """True if the request names detectors or limits the number of rows, so that it may exclude tasks."""
        return bool(self.request.detectors) or self.request.limit is not None

    @property
    def is_done(self) -> bool:
        """True if the limit on the number of rows is reached and all requested detectors have been found."""
        return self._remaining == 0 and {*self.request.detectors} <= self._planned_names

    def select(self, tasks: pa.Table) -> pa.Table:
        """Return the requested rows of one partition; the limit of the request counts the rows of all calls."""
        if self.request.detectors:
            self._planned_names |= {*tasks["detector"].unique().to_pylist()}
            tasks = tasks.filter(pc.is_in(tasks["detector"], pa.array(self.request.detectors, pa.string())))
        if self._remaining is not None:
            order = pc.sort_indices(tasks, [("exposure_id", "ascending"), ("detector", "ascending")])
            tasks = tasks.take(pa.array(np.sort(order.slice(0, self._remaining).to_numpy())))
            self._remaining -= tasks.num_rows
        return tasks

    def refuse_unknown(self) -> None:
        """Raise BadInput if the request names a detector that none of the given partitions had.

        Call this method after all partitions have been given to `select`.
        """
        if unknown := sorted({*self.request.detectors} - self._planned_names):
            plan_name = f"the plan of request {self.request.name}"
            names = sorted(self._planned_names)
            examples = ", ".join([*names[:_MAX_EXAMPLES], *(["..."] if len(names) > _MAX_EXAMPLES else [])])
            similar = spelling.suggestion(unknown[0], names)
            raise BadInput(f"detectors: {unknown[0]} is not in {plan_name}, which has {examples}{similar}")


@dataclass(frozen=True, slots=True)
class _Places:
    """Positions of all detectors of a camera at one pointing.

    `ra`, `dec` and `radius` (deg) are one circle per detector, which contains it and the sky around it from which
    sources are read. `cells` are the order-8 HEALPix cells that overlap each circle, and `regions` the outlines of the
    detectors as STC-S polygons. `density` has the galaxies and stars per deg2, shape (2, n). `first` is the index of
    the first detector in a list of the detectors of all pointings.
    """

    first: int
    names: list[str]
    ra: Float
    dec: Float
    radius: Float
    cells: list[Int]
    regions: list[str]
    density: Float


@dataclass(frozen=True, slots=True)
class _ExposureTasks:
    """Requested detectors of an exposure with the estimated cost to render each, as arrays with one value per detector.

    `place_numbers` are indices of the detectors in a list of the detectors of all pointings. `sources` is the expected
    number of galaxies and stars. The costs are `seconds` (CPU time), `memory` (GB) and `bytes` (of the files).
    """

    exposure_id: int
    channel: str
    sees_sky: bool
    place_numbers: Int
    sources: Int
    seconds: Float
    memory: Float
    bytes: Int

    @classmethod
    def from_exposure(
        cls, row: ExposureRow, detector_names: tuple[str, ...], camera: _Camera, places: _Places, cost: CostModel
    ) -> _ExposureTasks:
        sees_sky = row.image_type in registry.CHANNELS[row.channel].sky_types
        selected = [camera.index[name] for name in dict.fromkeys(detector_names)] or range(len(camera.detectors))
        indices = np.array(selected, np.int64)
        galaxies, stars = places.density[:, indices] * (camera.area[indices] * sees_sky)
        pixels = camera.pixels[indices]
        return cls(
            row.exposure_id,
            row.channel,
            sees_sky,
            places.first + indices,
            np.ceil(galaxies + stars).astype(np.int64),
            cost.seconds(pixels, galaxies, stars),
            cost.memory(pixels),
            cost.bytes(pixels, camera.read_pixels[indices]),
        )


def _rows(planned: Sequence[_ExposureTasks], places: Sequence[_Places]) -> pa.Table:
    """Return the rows of the table `tasks` for all exposures, longest estimated CPU time first.

    `places` has the positions of the detectors, one item per pointing. `place_numbers` of an exposure are indices into
    the list of the detectors of all these items.
    """
    if not planned:
        return TASKS.empty()
    numbers = np.array([item.exposure_id for item in planned], np.int64)
    channels = np.array([item.channel for item in planned], object)
    exposure_index = np.repeat(np.arange(len(planned)), [len(item.place_numbers) for item in planned])
    place_index = np.concatenate([item.place_numbers for item in planned])
    names = np.array([name for item in places for name in item.names], object)
    seconds = np.concatenate([item.seconds for item in planned])
    order = np.lexsort((_ranks(names)[place_index], numbers[exposure_index], -seconds))
    exposure_index, place_index = exposure_index[order], place_index[order]
    regions = np.array([region for item in places for region in item.regions], object)
    sees_sky = np.array([item.sees_sky for item in planned])
    cell_lists, empty_list = _cell_lists([cells for item in places for cells in item.cells])
    sky_of = {
        name: np.concatenate([getattr(item, name) for item in places])[place_index] for name in ("ra", "dec", "radius")
    }
    costs = {
        name: np.concatenate([getattr(item, name) for item in planned])[order]
        for name in ("sources", "seconds", "memory", "bytes")
    }
    return TASKS.build(
        {
            "exposure_id": numbers[exposure_index],
            "detector": names[place_index],
            "channel": channels[exposure_index],
            **sky_of,
            "cells": cell_lists.take(pa.array(np.where(sees_sky[exposure_index], place_index, empty_list))),
            "s_region": regions[place_index],
            **costs,
        }
    )


def _ranks(names: npt.NDArray[np.object_]) -> Int:
    """Return the alphabetical rank of each name from 0; equal names have equal ranks."""
    return np.unique(names.astype(str), return_inverse=True)[1]


def _cell_lists(cells: Sequence[Int]) -> tuple[pa.ListArray, int]:
    """Return an Arrow array with one list of HEALPix cells per detector and an empty list at the end, and its index.

    The index is that of the empty list, which serves for all detectors that do not see the sky.
    """
    ends = np.cumsum([0, *map(len, cells), 0], dtype=np.int32)
    return pa.ListArray.from_arrays(ends, np.concatenate([*cells, np.empty(0, np.int64)])), len(cells)


class _Camera:
    """Detectors of a camera, and their properties that do not depend on the pointing.

    Attributes
    ----------
    detectors : tuple of Detector
        The detectors.
    names : list of str
        Their names.
    index : dict of str to int
        Index of each detector by name.
    x, y : float array, shape (n, 5)
        Centre and four corners of each detector on the tangent plane, in arcsec.
    margin : float
        Distance in arcsec beyond a detector up to which all sources are read from the catalogue.
    radius : float array, shape (n,)
        Radius in degrees of the circle that contains a detector and the margin.
    pixels, read_pixels : int array, shape (n,)
        Number of light-sensitive pixels, and number with prescan and overscan.
    area : float array, shape (n,)
        Area of each detector in deg2.
    """

    def __init__(self, camera: str, channel: str, mission: MissionConfiguration) -> None:
        self.detectors = camera_detectors.detectors(camera, mission)
        self.names = [detector.name for detector in self.detectors]
        self.index = {name: i for i, name in enumerate(self.names)}
        self.x, self.y = pointing.outline(self.detectors)
        self.margin = registry.CHANNELS[channel].margin(self.detectors[0].section, mission)
        # Distance of the farthest corner from the centre of each detector, arcsec. On the tangent plane, distortion can
        # make a detector larger than its nominal size.
        corner = np.hypot(self.x[:, 1:] - self.x[:, :1], self.y[:, 1:] - self.y[:, :1]).max(axis=1)
        reach = np.array([max(d.half_diagonal, c) for d, c in zip(self.detectors, corner, strict=True)])
        self.radius = (reach + self.margin) / 3600.0
        self.pixels = np.array([detector.nx * detector.ny for detector in self.detectors])
        layouts = [amplifiers.layout(detector, mission) for detector in self.detectors]
        raw_pixels = [layout and math.prod(layout.raw_shape) for layout in layouts]
        self.read_pixels = np.array([n or pixels for n, pixels in zip(raw_pixels, self.pixels, strict=True)])
        self.area = np.array([d.nx * d.ny * (d.pixel_scale / 3600.0) ** 2 for d in self.detectors])


def _places(camera_by_pointing: Mapping[tuple[Any, ...], _Camera], densities: Densities) -> Iterator[_Places]:
    """Yield the positions of the detectors of a camera on the sky, for each pointing in the given order."""
    first, waiting = 0, list(camera_by_pointing.items())
    while waiting:
        # Search sky cells for a group of close pointings at once: dithers share most of their cells.
        _, _, ra, dec, _ = waiting[0][0]
        close_flags = (float(sky.separation(ra, dec, *place[2:4])) < _GROUP_RADIUS for place, _ in waiting[:_MAX_GROUP])
        n_close = sum(1 for _ in takewhile(bool, close_flags))
        group, waiting = waiting[:n_close], waiting[n_close:]
        outlines = [pointing.sky_of_plane(camera.x, camera.y, *place[2:]) for place, camera in group]
        lon, lat = (np.concatenate([outline[axis] for outline in outlines]) for axis in (0, 1))
        radius = np.concatenate([camera.radius for _, camera in group])
        cells = sky.cells_in_cones(lon[:, 0], lat[:, 0], radius, GENERATION_ORDER)
        corners = np.stack([lon[:, 1:], lat[:, 1:]], axis=2).reshape(len(lon), -1).tolist()
        density = densities.at(lon[:, 0], lat[:, 0])
        start = 0
        for _, camera in group:
            in_camera = slice(start, start + len(camera.names))
            start = in_camera.stop
            yield _Places(
                first,
                camera.names,
                lon[in_camera, 0],
                lat[in_camera, 0],
                camera.radius,
                cells[in_camera],
                [_POLYGON % tuple(polygon) for polygon in corners[in_camera]],
                density[:, in_camera],
            )
            first += len(camera.names)


def _cost_of_exposure(row: ExposureRow, variant: Variant, truth: Sequence[str], files: OutputFiles) -> CostModel:
    """Return the model of CPU time, memory and file size for the detectors of an exposure.

    For an exposure of the sky, the CPU time of every detector effect is included, unless the request switches it off.
    For other exposures (such as darks) the light is known before rendering, so that effects without influence on the
    image are left out unless the request switches them on. `truth` has the names of the truth maps (images of true
    signals) to write.
    """
    channel, kind = row.channel, row.image_type
    sees_sky = kind in registry.CHANNELS[channel].sky_types
    effects = registry.CHANNELS[channel].with_readout(files.readout).effects.get(kind)
    ramp_load = RampLoad()
    if effects is not None:
        all_detectors = camera_detectors.detectors(row.camera, variant.mission)
        amplifiers.refuse_spread(all_detectors, variant.mission)
        scene = replace(
            scene_factory.from_exposure(row, all_detectors[0], variant.mission, variant.accuracy), forced=variant.forced
        )
        if row.lamp is not None and row.band in passbands.names():
            # The passband determines how bright the lamp is.
            scene = replace(scene, band=passbands.load(row.band))
        scene = scene_factory.with_non_source_light(scene, registry.CHANNELS[channel], effects)
        files = replace(files, has_32_bits=adc.pixel_type(scene) is np.int32)
        effects = tuple(e for e in effects if variant.forced.get(e.name, sees_sky or e.is_needed(scene)))
        ramp_load = _ramp_load(scene, effects)
    return cost_model(channel, sees_sky, effects, variant.accuracy, truth, files, ramp_load)


def _ramp_load(scene: Scene, effects: Sequence[Effect]) -> RampLoad:
    """Return the groups of reads of an exposure, and the frames that are drawn separately because of a bright lamp."""
    if ramp.EFFECT not in effects:
        return RampLoad()
    mode = ramp.mode_of_scene(scene)
    lamp_electrons = calibration_lamp.EFFECT.contribution(scene) if calibration_lamp.EFFECT in effects else 0.0
    is_bright = lamp_electrons * mode.frames / mode.integration_frames > ramp.LINEAR_BELOW
    return RampLoad(mode.groups, mode.frames if is_bright else 0)
