"""From exposures to render tasks: one a detector, with its cells and what it will cost.

table      rows of the table `tasks`, longest first
Densities  how many sources there are where: of the lake's catalogues, or of the mission's count models
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from jobs.accuracy import SURVEY, Accuracy
from jobs.render import exposure, focal_plane, survey
from jobs.render.costs import Price, price
from jobs.render.exposing import sees_sky
from jobs.request import Universe
from lake_schema import layout, sky
from lake_schema.errors import BadInput
from lake_schema.ids import GENERATION_ORDER
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.read import Version
from lake_schema.tables.tasks import TASKS

Float = npt.NDArray[np.float64]
Row = Mapping[str, Any]

# ------------------------------------------------------------------------------------------------ sources


class Densities:
    """Sources a square degree at a place.

    catalogues : published galaxies and stars, both or none
    Error: without them a limit in another band than I_E is taken for one in I_E
    """

    def __init__(self, mission: MissionConfiguration, universe: Universe, catalogues: Sequence[Version] = ()) -> None:
        self.published = [_published(version) for version in catalogues]
        counts = np.array(mission.numbers("survey.galaxy_counts"))
        self.galaxies = float(np.exp(np.interp(universe.galaxy_limit, counts[:, 0], np.log(counts[:, 1]))))
        stars = np.array(mission.numbers("survey.star_counts"))
        # Columns: l, |b|, then counts to H = 8, 10, .., 26.
        limits = 8.0 + 2.0 * np.arange(stars.shape[1] - 2)
        at_limit = [np.interp(universe.star_limit, limits, np.log(row)) for row in stars[:, 2:]]
        self.lon, self.lat = np.unique(stars[:, 0]), np.unique(stars[:, 1])
        self.stars = np.reshape(at_limit, (self.lon.size, self.lat.size))

    def at(self, ra: Float, dec: Float) -> Float:
        """[2, n] deg-2, galaxies and stars; of the published catalogues where they reach, else of the count models."""
        model = self._model(ra, dec)
        if not self.published:
            return model
        cells = [int(cell) for cell in sky.cell_of(ra, dec, GENERATION_ORDER)]
        found = np.array([[table.get(cell, np.nan) for cell in cells] for table in self.published])
        return np.where(np.isfinite(found).all(axis=0), found, model)

    def _model(self, ra: Float, dec: Float) -> Float:
        lon, lat = sky.galactic(ra, dec)
        folded, height = np.abs((lon + 180.0) % 360.0 - 180.0), np.abs(lat)
        i = np.clip(np.searchsorted(self.lon, folded, "right") - 1, 0, self.lon.size - 2)
        j = np.clip(np.searchsorted(self.lat, height, "right") - 1, 0, self.lat.size - 2)
        s = (folded - self.lon[i]) / (self.lon[i + 1] - self.lon[i])
        t = (height - self.lat[j]) / (self.lat[j + 1] - self.lat[j])
        low = (1 - s) * self.stars[i, j] + s * self.stars[i + 1, j]
        high = (1 - s) * self.stars[i, j + 1] + s * self.stars[i + 1, j + 1]
        return np.stack([np.full(lon.shape, self.galaxies), np.exp((1 - t) * low + t * high)])


def _published(version: Version) -> dict[int, float]:
    """Density of each generation cell that a catalogue covers: that of its file."""
    density: dict[int, float] = {}
    for part in version.manifest["parts"]:
        cells = part["facts"]["generation_cells"]
        order, file = layout.cell_of_file(part["name"])
        if any(cell >> 2 * (GENERATION_ORDER - order) != file for cell in cells):
            raise BadInput(f"table {version.table}: part {part['name']} names cells of another file")
        mean = version.part_rows(part["name"]) / (len(cells) * sky.cell_area(GENERATION_ORDER))
        density.update(dict.fromkeys(cells, mean))
    return density


# ------------------------------------------------------------------------------------------------ tasks


def table(
    exposures: pa.Table,
    detectors: Sequence[tuple[str, ...]],
    mission: MissionConfiguration,
    densities: Densities,
    truth: Sequence[str] = (),
    accuracy: Accuracy = SURVEY,
    forced: Mapping[str, bool] | None = None,
) -> pa.Table:
    """Rows of the table `tasks`.

    exposures  : rows of the table `exposures`;  detectors : of each exposure, () = all of its camera
    truth      : truth maps that are wanted
    forced     : effects that the request forces on or off
    """
    cameras = {camera: _Camera(camera, mission) for camera in set(exposures["camera"].to_pylist())}
    shared: dict[tuple[Any, ...], _Places] = {}
    prices: dict[tuple[Any, ...], Price] = {}
    columns: dict[str, list[Any]] = {name: [] for name in TASKS.names}
    for row, wanted in zip(exposures.to_pylist(), detectors, strict=True):
        camera = cameras[row["camera"]]
        where = (row["camera"], row["ra"], row["dec"], row["position_angle"])
        if where not in shared:
            shared[where] = camera.places(*where[1:], densities)
        kind = tuple(row[name] for name in ("camera", "channel", "image_type", "exposure_time_s", "lamp", "settings"))
        if kind not in prices:
            prices[kind] = _price(row, survey.variant(row["settings"], mission, accuracy, forced or {}), truth)
        _append(columns, row, wanted, camera, shared[where], prices[kind])
    seconds = np.array(columns["seconds"], float)
    numbers = np.array(columns["exposure_id"], np.int64)
    order = np.lexsort((np.array(columns["detector"]), numbers, -seconds)) if numbers.size else np.empty(0, np.int64)
    return TASKS.build({name: [values[i] for i in order] for name, values in columns.items()})


@dataclass(frozen=True, slots=True)
class _Places:
    ra: list[float]
    dec: list[float]
    cells: list[list[int]]
    regions: list[str]
    density: Float


class _Camera:
    """Detectors of a camera, and what of them does not depend on the pointing."""

    def __init__(self, camera: str, mission: MissionConfiguration) -> None:
        self.detectors = focal_plane.detectors(camera, mission)
        self.index = {detector.name: i for i, detector in enumerate(self.detectors)}
        self.x, self.y = focal_plane.outline(self.detectors)
        margin = mission.value("survey.selection_margin", "arcsec")
        # On the tangent plane, where a detector that the optics distort is larger than it is.
        corner = np.hypot(self.x[:, 1:] - self.x[:, :1], self.y[:, 1:] - self.y[:, :1]).max(axis=1)
        reach = np.array([max(d.half_diagonal, c) for d, c in zip(self.detectors, corner, strict=True)])
        self.radius = (reach + margin) / 3600.0
        self.pixels = np.array([detector.nx * detector.ny for detector in self.detectors])
        self.area = np.array([d.nx * d.ny * (d.pixel_scale / 3600.0) ** 2 for d in self.detectors])

    def places(self, ra: float, dec: float, angle: float, densities: Densities) -> _Places:
        lon, lat = focal_plane.sky_of_plane(self.x, self.y, ra, dec, angle)
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
    columns: dict[str, list[Any]], row: Row, wanted: tuple[str, ...], camera: _Camera, places: _Places, cost: Price
) -> None:
    looks = sees_sky(row["channel"], row["image_type"])
    for i in [camera.index[name] for name in dict.fromkeys(wanted)] or range(len(camera.detectors)):
        galaxies, stars = (places.density[:, i] * (camera.area[i] * looks)).tolist()
        pixels = int(camera.pixels[i])
        columns["exposure_id"].append(row["exposure_id"])
        columns["detector"].append(camera.detectors[i].name)
        columns["channel"].append(row["channel"])
        columns["ra"].append(places.ra[i])
        columns["dec"].append(places.dec[i])
        columns["radius"].append(float(camera.radius[i]))
        columns["cells"].append(places.cells[i] if looks else [])
        columns["s_region"].append(places.regions[i])
        columns["sources"].append(math.ceil(galaxies + stars))
        columns["seconds"].append(cost.seconds(pixels, galaxies, stars))
        columns["memory"].append(cost.memory(pixels))
        columns["bytes"].append(cost.bytes(pixels))


def _price(row: Row, own: survey.Variant, truth: Sequence[str]) -> Price:
    """Of the detectors of an exposure.

    Somewhere on a detector there is light enough for every effect; of a frame without a sky the scene is known.
    """
    channel, kind = str(row["channel"]), str(row["image_type"])
    looks, effects = sees_sky(channel, kind), exposure.EFFECTS.get(channel, {}).get(kind)
    if effects is not None:
        first = focal_plane.detectors(str(row["camera"]), own.mission)[0]
        scene = replace(exposure.scene_of(row, first, own.mission, own.accuracy), forced=own.forced)
        scene = exposure.with_own_light(scene, effects)
        effects = tuple(e for e in effects if own.forced.get(e.name, looks or e.needed_if(scene)))
    return price(channel, looks, effects, own.accuracy, truth)
