"""What a lake holds that can be checked.

Held       its tables and its frames
look       of a lake
partners   frames that are looked at with another one
"""

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
from truesky.validation.lake.measure.frames import Curve, Instrument
from truesky.validation.lake.measure.references import Catalogue
from truesky.validation.lake.measure.rows import Place
from truesky.validation.lake.measure.seen import SKY_TYPES

# What verdicts may come from; their versions name the version of `validation`.
TABLES = (
    "galaxies", "stars", "mission", "galaxy_fluxes", "star_fluxes", "exposures", "products", "rendered_truth",
    "rendered_spectra",
)  # fmt: skip


_CURVE = ("nonlinearity.high", "nonlinearity.low", "nonlinearity.low_scale")


@dataclass(frozen=True, slots=True)
class Shot:
    """A science file: its path in the version of `products`, where it was taken, the row of its exposure."""

    path: str
    place: Place
    exposure: Mapping[str, Any]


@dataclass(frozen=True, slots=True, eq=False)
class Held:
    """Tables by name, science files, and where files of a content are: (exposure, detector, content) -> path."""

    root: Path
    tables: Mapping[str, read.Version]
    shots: tuple[Shot, ...]
    paths: Mapping[tuple[int, str, str], str]

    @property
    def keys(self) -> dict[str, str]:
        """Of the versions that were read."""
        return {name: version.key for name, version in self.tables.items()}


def look(root: Path, request: str | None = None, exposures: Sequence[int] = ()) -> Held:
    """Of a lake.

    root : of it;  request : whose tables, where it has those of several;  exposures : only these, () = all
    Errors : BadInput where there is nothing to check, and for exposures that it has no images of
    """
    names = layout.tables(root)
    found = {name: _own(root, name, request) for name in TABLES if name in names}
    if not found:
        raise BadInput(f"lake {root}: none of {', '.join(TABLES)} is there to be validated")
    if "products" not in found:
        return Held(root, found, (), {})
    rows = found["products"].rows(["path", "content", "exposure_id", "detector", "channel", "band"]).to_pylist()
    paths = {(row["exposure_id"], row["detector"], row["content"]): row["path"] for row in rows}
    planned = _planned(root, found["products"])
    shots = []
    for row in sorted(rows, key=lambda row: (row["exposure_id"], row["detector"])):
        if row["content"] == "science" and (not exposures or row["exposure_id"] in exposures):
            place = Place(row["channel"], row["band"], row["exposure_id"], row["detector"])
            shots.append(Shot(row["path"], place, planned[row["exposure_id"]]))
    for number in exposures:
        if not any(shot.place.exposure_id == number for shot in shots):
            raise BadInput(f"table products: no image of exposure {number}")
    return Held(root, found, tuple(shots), paths)


def partners(shots: Sequence[Shot]) -> dict[str, Shot]:
    """Path of a frame -> another one of its detector that its gain is told with, where there is one: flats of one lamp.

    Of ground cameras two of the sky, too, of levels that are alike; of one band, where there are such.
    """
    flats: dict[tuple[Any, ...], list[Shot]] = {}
    skies: dict[tuple[Any, ...], list[Shot]] = {}
    for shot in shots:
        row, place = shot.exposure, shot.place
        if row["image_type"] == "flat":
            lamp = (row["lamp"], row["exposure_time_s"])
            flats.setdefault((row["camera"], place.detector, place.channel, place.band, *lamp), []).append(shot)
        elif row["image_type"] in SKY_TYPES and place.channel == "EXT":
            skies.setdefault((row["camera"], place.detector), []).append(shot)
    found: dict[str, Shot] = {}
    for own in flats.values():
        found |= {other.path: one for one, other in list(pairwise(own))[:1]}
    for own in skies.values():
        by_band = sorted(own, key=lambda shot: (str(shot.place.band), _level(shot)))
        pairs = [*pairwise(by_band), *pairwise(sorted(own, key=_level))]
        if pairs:
            one, other = min(pairs, key=lambda pair: (pair[0].place.band != pair[1].place.band, _apart(pair)))
            found[other.path] = one
    return found


def _level(shot: Shot) -> float:
    """Electrons of the sky."""
    return float(shot.exposure["sky"] * shot.exposure["exposure_time_s"])


def _apart(pair: tuple[Shot, Shot]) -> float:
    """How unlike the sky of two frames is, in the logarithm."""
    return abs(float(np.log(max(_level(pair[0]), 1e-9) / max(_level(pair[1]), 1e-9))))


def _own(root: Path, name: str, request: str | None) -> read.Version:
    return read.version(root, name) if request is None else read.for_request(root, name, request)


def _planned(root: Path, products: read.Version) -> dict[int, Mapping[str, Any]]:
    """Rows of the exposures that the images were made of."""
    here = pc.field("exposure_id").isin(products.rows(["exposure_id"])["exposure_id"].unique())
    rows = read.version(root, "exposures", products.manifest["facts"]["inputs"]["exposures"]).rows(where=here)
    return {row["exposure_id"]: row for row in rows.to_pylist()}


def instruments(held: Held) -> dict[str, Instrument]:
    """Of each camera that images are of, by the mission database; of amplifiers and pixels their mean."""
    curves = _told(held, (*_CURVE, "adc_max"), "nonlinearity")
    bowls, responses = _told(held, ("illumination",), "illumination"), _told(held, ("prnu",), "pixel_response")
    return {
        camera: Instrument(
            Curve(*curves.get(camera, ())), *(found.get(camera, [0.0])[0] for found in (bowls, responses))
        )
        for camera in {str(shot.exposure["camera"]) for shot in held.shots}
    }


def _told(held: Held, names: Sequence[str], effect: str) -> dict[str, list[float]]:
    """Camera -> values of these names in the mission database that images are of; none where an effect is off."""
    if "mission" not in held.tables or "products" not in held.tables:
        return {}
    facts = held.tables["products"].manifest["facts"]
    if effect in facts.get("request", {}).get("effects", {}).get("off", ()):
        return {}
    rows = read.version(held.root, "mission", facts["inputs"]["mission"]).rows(["name", "value", "chosen"])
    value = {row["name"]: row["value"] for row in rows.to_pylist() if row["chosen"]}
    found = {}
    for camera in {str(shot.exposure["camera"]) for shot in held.shots}:
        section = camera if camera in SPACE_CAMERAS else f"ext.{camera}"
        own = [f"{section}.{name}" for name in names]
        if all(name in value for name in own):
            found[camera] = [float(value[name]) for name in own]
    return found


def truth(held: Held) -> dict[tuple[int, str], pa.Table]:
    """Rows of `rendered_truth` by exposure and detector, of it what references are made of."""
    return _by_frame(held, "rendered_truth", references.TRUTH)


def spectra(held: Held) -> dict[tuple[int, str], pa.Table]:
    """The same of `rendered_spectra`: of first orders, which are measured."""
    return _by_frame(held, "rendered_spectra", where=pc.field("order") == 1)


def _by_frame(
    held: Held, name: str, columns: Sequence[str] | None = None, where: pc.Expression | None = None
) -> dict[tuple[int, str], pa.Table]:
    if name not in held.tables:
        return {}
    wanted = {(shot.place.exposure_id, shot.place.detector) for shot in held.shots}
    here = pc.field("exposure_id").isin(sorted({number for number, _ in wanted if number}))
    rows = held.tables[name].rows(
        None if columns is None else ["exposure_id", "detector", *columns],
        where=here if where is None else here & where,
    )
    if not len(rows):
        return {}
    groups = rows.select(["exposure_id", "detector"]).to_pandas().groupby(["exposure_id", "detector"]).indices
    # Not sliced: a slice goes to another process with all that it was cut from. Of one chunk taking rows is fast.
    rows = rows.combine_chunks()
    found = {key: rows.take(pa.array(index)) for key, index in groups.items() if key in wanted}
    return found


def stars_of(held: Held, rows: Mapping[tuple[int, str], pa.Table]) -> Catalogue:
    """Stars that the frames show, from the catalogue of the lake."""
    points = [
        part["id"].to_numpy()[part["method"].to_numpy() == references.POINT] for part in rows.values() if len(part)
    ]
    ids = np.unique(np.concatenate([np.zeros(0, np.int64), *points]))
    bands = sorted({shot.exposure["band"] for shot in held.shots})
    return references.catalogue(held.tables, ids, bands)
