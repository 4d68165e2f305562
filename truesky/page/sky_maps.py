"""The sky of a lake: densities in HEALPix cells, sources of a small field, footprints of what is planned or done.

What is of the renderer is imported where it is used: the first sky is shown before that is loaded.
"""

from __future__ import annotations

import asyncio
from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from lake_schema import sky
from lake_schema.arrays import Float, Int
from lake_schema.errors import BadInput
from lake_schema.store import layout
from truesky.explore import adql
from truesky.page.answers import is_catalogue, packed, plain
from truesky.page.opened import Lake, Requested

_CIRCLE = ("exposure_id", "ra", "dec", "radius")
_TASK = (*_CIRCLE, "s_region")
MOST_CELLS, MOST_SOURCES = 200_000, 20_000
_DEEPEST_SHOWN = 16
MOST_EXPOSURES = 20_000
# Of a plan of more detectors those are looked up that are shown: of so many exposures, whose boresights lie so many deg
# at most from the edge of what is in view.
MOST_PLANNED, MOST_LOOKED_UP, WIDEST_CAMERA = 200_000, 1_000, 2.0
Json = dict[str, Any]
# Of the sources of a field: what is shown beside the place, where a table has it, and which come first: the smallest
# numbers of a magnitude, the largest of a mass.
_SIZES = (("mag_r01", 1), ("mag_h", 1), ("phot_g_mean_mag", 1), ("log_mass", -1))


def parts(lake: Lake, table: str) -> bytes:
    """Densities in the files' own cells, from the manifest: no row is read."""
    version = lake.version(table)
    if not is_catalogue(version):
        raise BadInput(f"table {table} has no positions")
    own = [(*layout.cell_of_file(part), version.part_rows(part)) for part in version.parts]
    corners = [sky.cell_corners(order, [cell]) for order, cell, _ in own]
    density = [rows / sky.cell_area(order) for order, _, rows in own]
    return _packed(
        np.concatenate(corners) if corners else np.zeros((0, 4, 2)), np.array(density), {"rows": version.num_rows}
    )


async def density(
    lake: Lake, table: str, order: int, where: str, view: Float | None, value: str | None = None
) -> bytes:
    """4 bytes: length of the head; the head, JSON; float32 corners [n, 4, 2] deg; float32 number per deg2 [n].

    order : of the cells;  where : SQL condition of the rows that count;  view : ra, dec, radius deg; None: everything
    table : of the rows;  value : SQL whose mean over the rows of a cell is told instead of their number; rows that
            have no finite one are `missing` of the head, not of the mean
    """
    if not 0 <= order <= _DEEPEST_SHOWN:
        raise BadInput(f"order = {order} is outside [0, {_DEEPEST_SHOWN}]")
    shift = 2 * (sky.DEEPEST - order)
    told = "count(*)::DOUBLE AS told, 0 AS lost"
    if value is not None:
        # One NaN would make a NaN of the mean of its cell.
        number = f"TRY_CAST(({value}\n) AS DOUBLE)"
        finite = f"FILTER (isfinite({number}))"
        told = f"avg({number}) {finite} AS told, count(*) - count(*) {finite} AS lost"
    text = f"""SELECT _healpix_29 >> {shift} AS cell, count(*) AS n, {told} FROM {_table(lake, table)}
               WHERE ({where}\n) AND {_within(view)} GROUP BY cell ORDER BY cell LIMIT {MOST_CELLS + 1}"""
    found = await _asked(lake, text, where, *([value] if value is not None else []))
    _refuse_many(found.num_rows)
    head = {"order": order, "rows": _sum(found["n"]), "missing": _sum(found["lost"])}
    found = found.filter(pc.is_finite(found["told"]))
    area = sky.cell_area(order) if value is None else 1.0
    return _packed(_corners(order, found["cell"].to_numpy()), found["told"].to_numpy() / area, head)


def _sum(column: pa.ChunkedArray) -> int:
    return int(pc.sum(column).as_py() or 0)


def coverage(lake: Lake, order: int, view: Float | None, band: str | None) -> bytes:
    """The same with how many of the planned exposures see the centre of each cell.

    lake : whose plan;  order : of the cells
    view : ra, dec, radius deg; None: everything;  band : of the exposures, None = all
    """
    from truesky.render.camera import footprints

    if not 0 <= order <= _DEEPEST_SHOWN:
        raise BadInput(f"order = {order} is outside [0, {_DEEPEST_SHOWN}]")
    cells, rows = np.zeros(0, np.int64), 0
    if view is not None:
        cells = sky.cells_in_cone(float(view[0]), float(view[1]), min(float(view[2]), 180.0), order)
    else:
        for tasks in _tasks(lake, band, _CIRCLE):
            circles = np.unique(np.stack([tasks[name].to_numpy() for name in _CIRCLE[1:]], axis=1), axis=0)
            for ra, dec, radius in circles:
                cells = np.union1d(cells, sky.cells_in_cone(ra, dec, radius, order))
                _refuse_many(len(cells))
    seen, centres = np.zeros(len(cells), np.int64), sky.cell_centres(order, cells) if len(cells) else None
    for tasks in _tasks(lake, band, _TASK):
        rows += tasks.num_rows
        if centres is not None:
            seen += footprints.counts(tasks, *centres)
    cells, seen = cells[seen > 0], seen[seen > 0]
    _refuse_many(len(cells))
    return _packed(_corners(order, cells), seen.astype(float), {"order": order, "rows": rows})


def _tasks(lake: Lake, band: str | None, columns: Sequence[str]) -> Iterator[pa.Table]:
    """What is planned in a band, None = in all, a part of a plan after the other.

    What several requests have of one version counts once.
    """
    for own in {own.versions["tasks"].key: own for own in lake.observed if "tasks" in own.versions}.values():
        numbers = None
        if band is not None:
            exposures = own.versions["exposures"].rows(("exposure_id", "band"))
            numbers = exposures.filter(pc.equal(exposures["band"], band))["exposure_id"].combine_chunks()
        for rows in own.pieces("tasks", columns):
            yield rows if numbers is None else rows.filter(pc.is_in(rows["exposure_id"], numbers))


def bands(lake: Lake) -> list[str]:
    """Passbands in which exposures are planned."""
    pieces = (rows for own in lake.observed for rows in own.pieces("exposures", ("band",)))
    return sorted({band for rows in pieces for band in rows["band"].unique().to_pylist()})


def _refuse_many(cells: int) -> None:
    if cells > MOST_CELLS:
        raise BadInput(f"more than {MOST_CELLS:,} cells hold something: look at a part, or at larger cells")


def _corners(order: int, cells: Int) -> Float:
    return sky.cell_corners(order, cells) if len(cells) else np.zeros((0, 4, 2))


async def sources(lake: Lake, table: str, view: Float, where: str) -> Json:
    """Rows of a catalogue in a field: places, identifiers, a magnitude, a kind; of `total` the brightest `most`.

    view : ra, dec, radius deg;  where : SQL condition

    `by` is the column of the magnitude, which a mass may stand for; `sense` 1 where small numbers come first, else -1.
    """
    version = lake.version(table)
    names = version.schema.names
    lon, lat, radius = (float(number) for number in view)
    mag, sense = next((size for size in _SIZES if size[0] in names), (None, 1))
    key = "id" if "id" in names else names[0]
    chosen = [f'"{key}" AS id', "ra", "dec", f"{mag or 'NULL'} AS mag"]
    chosen += ["kind" if "kind" in names else "NULL AS kind", "count(*) OVER () AS total"]
    text = f"""SELECT {", ".join(chosen)} FROM {_table(lake, table)} WHERE ({where}\n) AND {_within(view)}
               AND separation(ra, dec, {lon!r}, {lat!r}) <= {radius!r}
               ORDER BY {("mag DESC" if sense < 0 else "mag") if mag else "1"} NULLS LAST LIMIT {MOST_SOURCES}"""
    found = await _asked(lake, text, where)
    columns = {name: found[name].to_pylist() for name in ("ra", "dec", "mag", "kind")}
    return {**columns, "id": [str(value) for value in found["id"].to_pylist()], "by": mag, "sense": sense} | {
        "total": found["total"][0].as_py() if found.num_rows else 0, "most": MOST_SOURCES,
    }  # fmt: skip


async def _asked(lake: Lake, text: str, *expressions: str) -> pa.Table:
    async with lake.own.process() as process:

        def ask() -> pa.Table:
            return pa.Table.from_batches(list(process.batches(text, {}, lake.timeout, expressions=expressions)))

        return await asyncio.to_thread(ask)


def _table(lake: Lake, table: str) -> str:
    if not is_catalogue(lake.version(table)):
        raise BadInput(f"table {table} has no positions")
    return ".".join(f'"{name}"' for name in table.split("."))


def _within(view: Float | None) -> str:
    """The condition that a row lies in cells that the view touches: files and row groups outside are not read."""
    if view is None:
        return "true"
    return adql.in_cone("_healpix_29", *(float(number) for number in view))


def _packed(corners: Float, density: Float, head: Json) -> bytes:
    return packed({**head, "cells": len(density)}, np.asarray(corners, "<f4"), np.asarray(density, "<f4"))


# ------------------------------------------------------------------------------------------------ footprints


def regions(lake: Lake) -> list[Json]:
    """Footprints of detectors: what was planned, what is done, what failed; images by number, each with its content.

    Each has the request whose exposure it is of, None where the lake has no other.
    """
    failed = _failed(lake)
    return [_now(place, region, failed) for place, region in _regions(lake).items()]


# A request, one of its exposures, and a detector: by these a footprint is found.
_Place = tuple[str | None, int, str]


@lru_cache(maxsize=4)
def _regions(lake: Lake) -> Mapping[_Place, Json]:
    """What was planned, of a large plan with exposures of which something is done; and what is done.

    That does not change while the lake is open.
    """
    from truesky.page import pictures

    found: dict[_Place, Json] = {}
    for own in lake.observed:
        begun = {one.row["exposure_id"] for one in pictures.pictures(lake) if one.own.request == own.request}
        found |= _planned(own, begun if _is_large(own) else None)
    for number, one in enumerate(pictures.pictures(lake)):
        empty = {**_polygon(one.own, one.row), "images": [], "contents": []}
        region = found.setdefault(one.place, empty)
        region |= {"state": "observed", "band": one.row["band"]}
        region["images"].append(number)
        region["contents"].append(one.row["content"])
    return found


def _is_large(own: Requested) -> bool:
    return "tasks" in own.versions and own.versions["tasks"].num_rows > MOST_PLANNED


def _planned(own: Requested, numbers: Collection[int] | None = None) -> dict[_Place, Json]:
    """Detectors of a request's exposures, None = of all of them."""
    bands_ = {row["exposure_id"]: row["band"] for row in own.rows("exposures", ("exposure_id", "band"), numbers)}
    found = {}
    for row in own.rows("tasks", ("exposure_id", "detector", "channel", "s_region"), numbers):
        about: Json = {"state": "planned", "images": [], "contents": [], "band": bands_.get(row["exposure_id"])}
        found[own.request, row["exposure_id"], row["detector"]] = {**_polygon(own, row), **about}
    return found


def _in_view(lake: Lake, view: Float | None) -> dict[_Place, Json]:
    """Of large plans the detectors that may be in view.  Errors: BadInput where they are too many"""
    found: dict[_Place, Json] = {}
    for own in filter(_is_large, lake.observed):
        exposures = own.versions["exposures"].rows(("exposure_id", "ra", "dec"))
        exposures = exposures.filter(pc.is_valid(exposures["ra"]))
        if view is not None:
            ra, dec = (exposures[name].to_numpy() for name in ("ra", "dec"))
            far = sky.separation(ra, dec, float(view[0]), float(view[1]))
            exposures = exposures.filter(pa.array(far <= float(view[2]) + WIDEST_CAMERA))
        _refuse_crowd(exposures.num_rows, MOST_LOOKED_UP)
        found |= _planned(own, exposures["exposure_id"].to_pylist())
    return found


def _refuse_crowd(exposures: int, most: int) -> None:
    if exposures > most:
        raise BadInput(f"more than {most:,} exposures are here: look at a part")


def _failed(lake: Lake) -> dict[tuple[str | None, str], str]:
    """Why a part of a request's images could not be made: runs of other processes may say so at any time."""
    from truesky.page import pictures

    return {
        (own.request, str(row["part"])): str(row["error"])
        for own in lake.observed
        for row in pictures.failures(lake, own)
    }


def _now(place: _Place, region: Json, failed: Mapping[tuple[str | None, str], str]) -> Json:
    request, exposure, detector = place
    error = failed.get((request, f"{exposure:06d}-{detector}.parquet".lower())) if failed else None
    return {**region, "state": "failed", "error": error} if error and region["state"] == "planned" else region


def _polygon(own: Requested, row: Mapping[str, Any]) -> Json:
    numbers = [float(text) for text in row["s_region"].split()[2:]]
    polygon = [numbers[k : k + 2] for k in range(0, len(numbers), 2)]
    about = {key: row[key] for key in ("exposure_id", "detector", "channel")}
    return {"request": own.request, **about, "polygon": polygon}


def exposures(lake: Lake, view: Float | None = None) -> list[Json]:
    """Footprints of exposures, each the convex hull of its detectors: how many of these are done, and how many failed.

    view   : ra, dec, radius deg, None = all;  returns: of each exposure its state, what it is, and `outline`, polygons
    Errors : BadInput where they are more than are shown
    """
    known, (about, places, circles) = _regions(lake), _exposures(lake)
    if more := _in_view(lake, view):
        known = {**more, **known}
        about, places, circles = _outlined(lake, known)
    # A circle about all corners meets the one in view.
    near = np.full(len(about), True)
    if view is not None:
        near = sky.separation(circles[:, 0], circles[:, 1], view[0], view[1]) <= circles[:, 2] + view[2]
    _refuse_crowd(int(np.count_nonzero(near)), MOST_EXPOSURES)
    failures, found = _failed(lake), []
    for k in np.flatnonzero(near):
        own = [_now(place, known[place], failures) for place in places[k]]
        states = [region["state"] for region in own]
        done, failed = states.count("observed"), states.count("failed")
        corners = np.array([corner for region in own for corner in region["polygon"]])
        found.append(
            {**about[k], "state": _state(done, failed, len(own)), "done": done, "failed": failed, "all": len(own)}
            | {"outline": [_hull(corners).tolist()]}
        )
    return found


_EXPOSURE = ("exposure_id", "channel", "camera", "band", "image_type", "mjd")


@lru_cache(maxsize=4)
def _exposures(lake: Lake) -> tuple[list[Json], list[list[_Place]], Float]:
    return _outlined(lake, _regions(lake))


def _outlined(lake: Lake, known: Mapping[_Place, Json]) -> tuple[list[Json], list[list[_Place]], Float]:
    """Of every exposure what it is, its detectors, and a circle about their corners: ra, dec, radius deg [n, 3]."""
    detectors = dict[tuple[str | None, int], list[_Place]]()
    for place in known:
        detectors.setdefault(place[:2], []).append(place)
    rows = {
        (own.request, row["exposure_id"]): {name: plain(value) for name, value in row.items()}
        for own in lake.observed
        for row in own.rows("exposures", _EXPOSURE, {number for request, number in detectors if request == own.request})
    }
    about, places, circles = [], [], []
    for (request, number), own_places in sorted(detectors.items(), key=lambda item: (item[0][0] or "", item[0][1])):
        own = [known[place] for place in own_places]
        first = {"channel": own[0]["channel"], "camera": None, "band": own[0]["band"], "image_type": None, "mjd": None}
        about.append({"request": request, "exposure_id": number, **first, **rows.get((request, number), {})})
        places.append(own_places)
        corners = np.array([corner for region in own for corner in region["polygon"]])
        ra, dec = _middle(corners)
        circles.append((ra, dec, sky.separation(corners[:, 0], corners[:, 1], ra, dec).max()))
    return about, places, np.array(circles).reshape(-1, 3)


def _state(done: int, failed: int, number: int) -> str:
    if done:
        return "observed" if done == number else "partly"
    return "failed" if failed else "planned"


def _middle(corners: Float) -> tuple[float, float]:
    """ra, dec of the mean of unit vectors, deg."""
    x, y, z = sky.unit_vectors(corners[:, 0], corners[:, 1]).mean(0)
    return float(np.degrees(np.arctan2(y, x)) % 360.0), float(np.degrees(np.arctan2(z, np.hypot(x, y))))


def _hull(corners: Float) -> Float:
    """Those of the places [n, 2] deg that no great circle cuts off, counter-clockwise with north up and east left.

    In the tangent plane of their middle great circles are straight lines. Of places on one line its ends are left.
    """
    from scipy.spatial import ConvexHull, QhullError

    from truesky.page import pictures

    plane = np.stack(pictures.tangent(corners[:, 0], corners[:, 1], *_middle(corners)), axis=1)
    try:
        # East is to the left of north.
        hull: Float = corners[ConvexHull(plane).vertices[::-1]]
    except QhullError:
        hull = corners[np.lexsort((plane[:, 1], plane[:, 0]))[[-1, 0]]]
    return hull
