"""From exposures to render tasks: one a detector, with its cells and what it will cost.

table      rows of the table `tasks`, longest first
part       those of them that are to be rendered now
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyarrow as pa

from jobs.accuracy import SURVEY, Accuracy
from jobs.render.camera import amplifiers, pointing
from jobs.render.camera import detectors as camera_detectors
from jobs.render.channels import registry
from jobs.render.effects.readout import adc
from jobs.render.exposure import scene_of
from jobs.render.exposure.records import Variant
from jobs.render.planning import variants
from jobs.render.planning.prices import Files, Price, price
from jobs.render.planning.source_counts import Densities
from jobs.request.schema import Request
from lake_schema import sky
from lake_schema.arrays import Float
from lake_schema.errors import BadInput
from lake_schema.ids import GENERATION_ORDER
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.tables.exposures import ExposureRow
from lake_schema.tables.tasks import TASKS

_ITS_OWN = Files()

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
    shared: dict[tuple[Any, ...], _Places] = {}
    prices: dict[tuple[Any, ...], Price] = {}
    columns: dict[str, list[Any]] = {name: [] for name in TASKS.names}
    for row, wanted in zip(map(ExposureRow.of, exposures.to_pylist()), detectors, strict=True):
        camera = cameras[row.camera, row.channel]
        where = (row.camera, camera.margin, row.ra, row.dec, row.position_angle)
        if where not in shared:
            shared[where] = camera.places(*where[2:], densities)
        kind = (row.camera, row.channel, row.image_type, row.exposure_time_s, row.lamp, row.settings)
        if kind not in prices:
            own = variants.variant(row.settings, mission, accuracy, forced or {})
            prices[kind] = _price(row, own, truth, files)
        _append(columns, row, wanted, camera, shared[where], prices[kind])
    seconds = np.array(columns["seconds"], float)
    numbers = np.array(columns["exposure_id"], np.int64)
    order = np.lexsort((np.array(columns["detector"]), numbers, -seconds)) if numbers.size else np.empty(0, np.int64)
    return TASKS.build({name: [values[i] for i in order] for name, values in columns.items()})


def part(tasks: pa.Table, request: Request) -> list[dict[str, Any]]:
    """Rows of the request's detectors, the first so many of them by exposure and name where it has a limit.

    Errors : BadInput where no exposure has a detector of that name, or the limit leaves none
    """
    rows: list[dict[str, Any]] = tasks.to_pylist()
    if unknown := sorted({*request.detectors} - {row["detector"] for row in rows}):
        some = ", ".join(sorted({row["detector"] for row in rows})[:4])
        raise BadInput(f"detectors: {unknown[0]} is not in the plan of request {request.name}, which has {some}, ...")
    if request.limit is not None and request.limit < 1:
        raise BadInput(f"limit = {request.limit} leaves no detector")
    if request.detectors:
        rows = [row for row in rows if row["detector"] in request.detectors]
    first = sorted((row["exposure_id"], row["detector"]) for row in rows)[: request.limit]
    chosen = {*first}
    return [row for row in rows if (row["exposure_id"], row["detector"]) in chosen]


@dataclass(frozen=True, slots=True)
class _Places:
    ra: list[float]
    dec: list[float]
    cells: list[list[int]]
    regions: list[str]
    density: Float


class _Camera:
    """Detectors of a camera, and what of them does not depend on the pointing.

    margin : arcsec beyond a detector, as far as the channel reads all sources
    """

    def __init__(self, camera: str, channel: str, mission: MissionConfiguration) -> None:
        self.detectors = camera_detectors.detectors(camera, mission)
        self.index = {detector.name: i for i, detector in enumerate(self.detectors)}
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

    def places(self, ra: float, dec: float, angle: float, densities: Densities) -> _Places:
        lon, lat = pointing.sky_of_plane(self.x, self.y, ra, dec, angle)
        cells = [
            sky.cells_in_cone(x, y, radius, GENERATION_ORDER).tolist()
            for x, y, radius in zip(lon[:, 0].tolist(), lat[:, 0].tolist(), self.radius.tolist(), strict=True)
        ]
        regions = [
            "POLYGON ICRS " + " ".join(f"{value:.7f}" for value in corners)
            for corners in np.stack([lon[:, 1:], lat[:, 1:]], axis=2).reshape(len(lon), -1).tolist()
        ]
        return _Places(lon[:, 0].tolist(), lat[:, 0].tolist(), cells, regions, densities.at(lon[:, 0], lat[:, 0]))


def _append(
    columns: dict[str, list[Any]],
    row: ExposureRow,
    wanted: tuple[str, ...],
    camera: _Camera,
    places: _Places,
    cost: Price,
) -> None:
    looks = row.image_type in registry.CHANNELS[row.channel].sky_types
    for i in [camera.index[name] for name in dict.fromkeys(wanted)] or range(len(camera.detectors)):
        galaxies, stars = (places.density[:, i] * (camera.area[i] * looks)).tolist()
        pixels = int(camera.pixels[i])
        columns["exposure_id"].append(row.exposure_id)
        columns["detector"].append(camera.detectors[i].name)
        columns["channel"].append(row.channel)
        columns["ra"].append(places.ra[i])
        columns["dec"].append(places.dec[i])
        columns["radius"].append(float(camera.radius[i]))
        columns["cells"].append(places.cells[i] if looks else [])
        columns["s_region"].append(places.regions[i])
        columns["sources"].append(math.ceil(galaxies + stars))
        columns["seconds"].append(cost.seconds(pixels, galaxies, stars))
        columns["memory"].append(cost.memory(pixels))
        columns["bytes"].append(cost.bytes(pixels, int(camera.read[i])))


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
