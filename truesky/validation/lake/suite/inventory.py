"""Find the contents of a lake that can be validated: tables, science files, and what is known about their frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from lake_schema.errors import BadInput
from lake_schema.mission.parameter import SPACE_CAMERAS
from lake_schema.store import layout, read
from truesky.validation.lake.measure import references
from truesky.validation.lake.measure.frame_context import SKY_TYPES
from truesky.validation.lake.measure.frames import Instrument, NonlinearityCurve
from truesky.validation.lake.measure.references import Catalogue
from truesky.validation.lake.measure.rows import Place

# Input tables of the checks; the key of the table `validation` depends on their versions.
TABLES = (
    "galaxies", "stars", "mission", "galaxy_fluxes", "star_fluxes", "exposures", "products", "rendered_truth",
    "rendered_spectra",
)  # fmt: skip


_CURVE = ("nonlinearity.high", "nonlinearity.low", "nonlinearity.low_scale")


@dataclass(frozen=True, slots=True)
class ScienceFile:
    """A science file.

    Attributes
    ----------
    path : str
        Path in the version of table `products`.
    place : Place
        Channel, band, exposure and detector.
    exposure : mapping of str to object
        Row of table `exposures`.
    """

    path: str
    place: Place
    exposure: Mapping[str, Any]


@dataclass(frozen=True, slots=True, eq=False)
class LakeContents:
    """Contents of a lake that can be validated.

    Attributes
    ----------
    root : Path
        Folder of the lake.
    tables : mapping of str to Version
        Versions of the tables by name.
    science_files : tuple of ScienceFile
        Science files, by exposure and detector.
    paths : mapping of (int, str, str) to str
        Paths in table `products` by exposure, detector and content.
    """

    root: Path
    tables: Mapping[str, read.Version]
    science_files: tuple[ScienceFile, ...]
    paths: Mapping[tuple[int, str, str], str]

    @property
    def version_keys(self) -> dict[str, str]:
        """Keys of the table versions by table name."""
        return {name: version.key for name, version in self.tables.items()}


def read_contents(root: Path, request: str | None = None, exposures: Sequence[int] = ()) -> LakeContents:
    """Find the tables and science files of a lake.

    Parameters
    ----------
    root : Path
        Folder of the lake.
    request : str, optional
        Name of the request whose tables are read, if the lake contains several.
    exposures : sequence of int
        Exposures to validate; () for all.

    Returns
    -------
    LakeContents
        Tables and science files.

    Raises
    ------
    BadInput
        If the lake contains no table to validate, or has no images of a requested exposure.
    """
    names = layout.table_names(root)
    versions = {name: _open_version(root, name, request) for name in TABLES if name in names}
    if not versions:
        raise BadInput(f"lake {root}: no table to validate, expected one of {', '.join(TABLES)}")
    if "products" not in versions:
        return LakeContents(root, versions, (), {})
    rows = versions["products"].rows(["path", "content", "exposure_id", "detector", "channel", "band"]).to_pylist()
    paths = {(row["exposure_id"], row["detector"], row["content"]): row["path"] for row in rows}
    planned = _exposure_rows(root, versions["products"])
    science_files = []
    for row in sorted(rows, key=lambda row: (row["exposure_id"], row["detector"])):
        if row["content"] == "science" and (not exposures or row["exposure_id"] in exposures):
            place = Place(row["channel"], row["band"], row["exposure_id"], row["detector"])
            science_files.append(ScienceFile(row["path"], place, planned[row["exposure_id"]]))
    for number in exposures:
        if not any(file.place.exposure_id == number for file in science_files):
            raise BadInput(f"table products: no image of exposure {number}")
    return LakeContents(root, versions, tuple(science_files), paths)


def gain_partners(science_files: Sequence[ScienceFile]) -> dict[str, ScienceFile]:
    """Return the partner frame for a gain measurement, by the path of the other frame of the pair.

    Partners show the same detector. Two flats of one lamp are a pair. For ground cameras, two sky frames are also a
    pair: one per detector, if possible with the same band and similar levels.
    """
    flats: dict[tuple[Any, ...], list[ScienceFile]] = {}
    skies: dict[tuple[Any, ...], list[ScienceFile]] = {}
    for file in science_files:
        row, place = file.exposure, file.place
        if row["image_type"] == "flat":
            lamp = (row["lamp"], row["exposure_time_s"])
            flats.setdefault((row["camera"], place.detector, place.channel, place.band, *lamp), []).append(file)
        elif row["image_type"] in SKY_TYPES and place.channel == "EXT":
            skies.setdefault((row["camera"], place.detector), []).append(file)
    partner_of: dict[str, ScienceFile] = {}
    for group in flats.values():
        partner_of |= {second.path: first for first, second in list(pairwise(group))[:1]}
    for group in skies.values():
        by_band = sorted(group, key=lambda file: (str(file.place.band), _sky_level(file)))
        pairs = [*pairwise(by_band), *pairwise(sorted(group, key=_sky_level))]
        if pairs:
            first, second = min(
                pairs, key=lambda pair: (pair[0].place.band != pair[1].place.band, _level_difference(pair))
            )
            partner_of[second.path] = first
    return partner_of


def _sky_level(file: ScienceFile) -> float:
    """Sky level in electrons per pixel."""
    return float(file.exposure["sky"] * file.exposure["exposure_time_s"])


def _level_difference(pair: tuple[ScienceFile, ScienceFile]) -> float:
    """Absolute difference of the logarithms of two sky levels."""
    return abs(float(np.log(max(_sky_level(pair[0]), 1e-9) / max(_sky_level(pair[1]), 1e-9))))


def _open_version(root: Path, name: str, request: str | None) -> read.Version:
    return read.version(root, name) if request is None else read.input_version(root, name, request)


def _exposure_rows(root: Path, products: read.Version) -> dict[int, Mapping[str, Any]]:
    """Rows of the exposures of the images, by exposure."""
    condition = pc.field("exposure_id").isin(products.rows(["exposure_id"])["exposure_id"].unique())
    rows = read.version(root, "exposures", products.manifest["facts"]["inputs"]["exposures"]).rows(where=condition)
    return {row["exposure_id"]: row for row in rows.to_pylist()}


def instruments(contents: LakeContents) -> dict[str, Instrument]:
    """Return the instrument of each camera from the mission database; amplifiers and pixels share mean values."""
    curves = _mission_values(contents, (*_CURVE, "adc_max"), "nonlinearity")
    bowls, responses = (
        _mission_values(contents, ("illumination",), "illumination"),
        _mission_values(contents, ("prnu",), "pixel_response"),
    )
    return {
        camera: Instrument(
            NonlinearityCurve(*curves.get(camera, ())),
            *(parameters.get(camera, [0.0])[0] for parameters in (bowls, responses)),
        )
        for camera in {str(file.exposure["camera"]) for file in contents.science_files}
    }


def _mission_values(contents: LakeContents, names: Sequence[str], effect: str) -> dict[str, list[float]]:
    """Values of parameters in the mission database by camera; empty if `effect` is switched off in the request."""
    if "mission" not in contents.tables or "products" not in contents.tables:
        return {}
    facts = contents.tables["products"].manifest["facts"]
    if effect in facts.get("request", {}).get("effects", {}).get("off", ()):
        return {}
    rows = read.version(contents.root, "mission", facts["inputs"]["mission"]).rows(["name", "value", "chosen"])
    value = {row["name"]: row["value"] for row in rows.to_pylist() if row["chosen"]}
    values = {}
    for camera in {str(file.exposure["camera"]) for file in contents.science_files}:
        section = camera if camera in SPACE_CAMERAS else f"ext.{camera}"
        keys = [f"{section}.{name}" for name in names]
        if all(name in value for name in keys):
            values[camera] = [float(value[name]) for name in keys]
    return values


def truth(contents: LakeContents) -> dict[tuple[int, str], pa.Table]:
    """Return the rows of `rendered_truth` by exposure and detector, with the columns that references require."""
    return _by_frame(contents, "rendered_truth", references.TRUTH)


def spectra(contents: LakeContents) -> dict[tuple[int, str], pa.Table]:
    """Return the rows of `rendered_spectra` by exposure and detector; only first orders are measured."""
    return _by_frame(contents, "rendered_spectra", where=pc.field("order") == 1)


def _by_frame(
    contents: LakeContents, name: str, columns: Sequence[str] | None = None, where: pc.Expression | None = None
) -> dict[tuple[int, str], pa.Table]:
    if name not in contents.tables:
        return {}
    frames = {(file.place.exposure_id, file.place.detector) for file in contents.science_files}
    condition = pc.field("exposure_id").isin(sorted({number for number, _ in frames if number}))
    rows = contents.tables[name].rows(
        None if columns is None else ["exposure_id", "detector", *columns],
        where=condition if where is None else condition & where,
    )
    if not len(rows):
        return {}
    groups = rows.select(["exposure_id", "detector"]).to_pandas().groupby(["exposure_id", "detector"]).indices
    # A slice would be pickled with the whole table, so rows are copied. Taking rows from a single chunk is fast.
    rows = rows.combine_chunks()
    by_frame = {key: rows.take(pa.array(index)) for key, index in groups.items() if key in frames}
    return by_frame


def star_catalogue(contents: LakeContents, rows: Mapping[tuple[int, str], pa.Table]) -> Catalogue:
    """Read the stars that the frames show from the catalogue of the lake."""
    points = [
        part["id"].to_numpy()[part["method"].to_numpy() == references.POINT] for part in rows.values() if len(part)
    ]
    ids = np.unique(np.concatenate([np.zeros(0, np.int64), *points]))
    bands = sorted({file.exposure["band"] for file in contents.science_files})
    return references.load_catalogue(contents.tables, ids, bands)
