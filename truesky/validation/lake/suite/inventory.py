"""Find the contents of a lake that can be validated: tables, raw images, known sources and properties of cameras."""

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
from lake_schema.store import layout, read, request_links
from truesky.validation.lake.measure import references
from truesky.validation.lake.measure.frame_context import SKY_TYPES
from truesky.validation.lake.measure.frames import Instrument, NonlinearityCurve
from truesky.validation.lake.measure.references import Catalogue
from truesky.validation.lake.measure.rows import Place

# Names of the tables that the checks read. If one changes, the table `validation` must be made again.
TABLES = (
    "galaxies", "stars", "mission", "galaxy_fluxes", "star_fluxes", "exposures", "products", "rendered_truth",
    "rendered_spectra", "depth", "randoms", "transients", "active_nuclei",
)  # fmt: skip


# Mission parameters of the nonlinearity of amplifiers, in the order of the fields of NonlinearityCurve.
_CURVE = ("nonlinearity.high", "nonlinearity.low", "nonlinearity.low_scale")


@dataclass(frozen=True, slots=True)
class ScienceFile:
    """A raw image of one detector in a lake (content "science", in contrast to truth maps).

    Attributes
    ----------
    path : str
        Path of the FITS file relative to the folder of the table `products`.
    place : Place
        Channel, band, exposure number and detector.
    exposure : mapping of str to object
        Row of the table `exposures` for this exposure, by column.
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
        Published tables by name; missing tables are left out.
    science_files : tuple of ScienceFile
        Raw images to validate, sorted by exposure number and detector.
    paths : mapping of (int, str, str) to str
        Paths of all image files by exposure number, detector and content (such as "science").
    """

    root: Path
    tables: Mapping[str, read.Version]
    science_files: tuple[ScienceFile, ...]
    paths: Mapping[tuple[int, str, str], str]

    @property
    def version_keys(self) -> dict[str, str]:
        """Return, by table name, the key of each table's version: a hash of everything on which its content depends."""
        return {name: version.key for name, version in self.tables.items()}


def read_contents(root: Path, request: str | None = None, exposures: Sequence[int] = ()) -> LakeContents:
    """Find the tables and raw images of a lake that can be validated.

    Parameters
    ----------
    root : Path
        Folder of the lake.
    request : str, optional
        Name of the request (simulation job) whose tables are read. It is required if requests have different tables.
    exposures : sequence of int
        Numbers of the exposures to validate; () for all.

    Returns
    -------
    LakeContents
        Tables and raw images. A lake without the table `products` has no images.

    Raises
    ------
    BadInput
        If the lake contains no table to validate or no such request, if its table `products` has no image of one of the
        given exposures, or if no request is given although requests have different tables.
    """
    if not (names := layout.table_names(root)):
        raise layout.missing_table(root)
    if request is not None:
        request_links.check_request(root, request)
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
    """Select pairs of frames of the same detector, from whose difference the gain is measured.

    For each detector, band, lamp and exposure time, the first two flats are a pair. For each detector of a ground
    camera, two frames of the sky are also a pair, if possible of the same band and with similar levels. The result has
    the first frame of each pair by the path of the second frame.
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
    """Return the planned sky level of an exposure in electrons per pixel."""
    return float(file.exposure["sky"] * file.exposure["exposure_time_s"])


def _level_difference(pair: tuple[ScienceFile, ScienceFile]) -> float:
    """Return the absolute difference of the natural logarithms of the sky levels of two frames."""
    return abs(float(np.log(max(_sky_level(pair[0]), 1e-9) / max(_sky_level(pair[1]), 1e-9))))


def _open_version(root: Path, name: str, request: str | None) -> read.Version:
    return read.version(root, name) if request is None else read.input_version(root, name, request)


def _exposure_rows(root: Path, products: read.Version) -> dict[int, Mapping[str, Any]]:
    """Return the rows of the table `exposures` for the exposures of all images, by exposure number."""
    condition = pc.field("exposure_id").isin(products.rows(["exposure_id"])["exposure_id"].unique())
    rows = read.version(root, "exposures", products.manifest["facts"]["inputs"]["exposures"]).rows(where=condition)
    return {row["exposure_id"]: row for row in rows.to_pylist()}


def instruments(contents: LakeContents) -> dict[str, Instrument]:
    """Return the known properties of each camera of the images: nonlinearity, vignetting and pixel response.

    They are read from the mission database of the lake, with one mean value for all amplifiers or pixels of a camera.
    Effects that the request switched off, or that the database does not contain, are assumed to be absent.
    """
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
    """Return the values of mission parameters by camera, in the order of `names`.

    Cameras without all parameters are left out. The result is empty if the request switched `effect` off, or if the
    lake has no mission database or no images.
    """
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
    """Return the rows of the table `rendered_truth` (true positions of sources) by exposure number and detector.

    Only the columns that `references.build_reference` requires are read. The result is empty without this table.
    """
    return _by_frame(contents, "rendered_truth", references.TRUTH)


def spectra(contents: LakeContents) -> dict[tuple[int, str], pa.Table]:
    """Return the rows of the table `rendered_spectra` by exposure number and detector, for the first order only.

    The result is empty without this table.
    """
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
    # Copy the rows of each frame: pickling a slice for another process would copy the whole table. Combine the chunks
    # first, because copying rows from a single chunk is faster.
    rows = rows.combine_chunks()
    by_frame = {key: rows.take(pa.array(index)) for key, index in groups.items() if key in frames}
    return by_frame


def star_catalogue(contents: LakeContents, rows: Mapping[tuple[int, str], pa.Table]) -> Catalogue:
    """Read positions and fluxes of the point sources in the images from the tables of stars.

    `rows` are the rows of `rendered_truth` by exposure number and detector.
    """
    points = [
        part["id"].to_numpy()[part["method"].to_numpy() == references.POINT] for part in rows.values() if len(part)
    ]
    ids = np.unique(np.concatenate([np.zeros(0, np.int64), *points]))
    bands = sorted({file.exposure["band"] for file in contents.science_files})
    return references.load_catalogue(contents.tables, ids, bands)
