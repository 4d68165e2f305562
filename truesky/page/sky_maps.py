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
from truesky.page.answers import is_catalogue, pack, to_json_value
from truesky.page.lake_session import LakeSession, RequestTables

_CIRCLE_COLUMNS = ("exposure_id", "ra", "dec", "radius")
_TASK_COLUMNS = (*_CIRCLE_COLUMNS, "s_region")
MAX_CELLS, MAX_SOURCES = 200_000, 20_000
_MAX_ORDER = 16
MAX_EXPOSURES = 20_000
# Of a plan of more detectors those are looked up that are shown: of so many exposures, whose boresights lie so many deg
# at most from the edge of what is in view.
LARGE_PLAN, MAX_LOOKED_UP, MAX_CAMERA_RADIUS = 200_000, 1_000, 2.0
Json = dict[str, Any]
# Of the sources of a field: what is shown beside the place, where a table has it, and which come first: the smallest
# numbers of a magnitude, the largest of a mass.
_SORT_COLUMNS = (("mag_r01", 1), ("mag_h", 1), ("phot_g_mean_mag", 1), ("log_mass", -1))


def partition_density(lake: LakeSession, table: str) -> bytes:
    """Densities in the files' own cells, from the manifest: no row is read."""
    version = lake.find_version(table)
    if not is_catalogue(version):
        raise BadInput(f"table {table} has no positions")
    cell_rows = [(*layout.cell_of_file(part), version.partition_rows(part)) for part in version.partitions]
    corners = [sky.cell_corners(order, [cell]) for order, cell, _ in cell_rows]
    density = [rows / sky.cell_area(order) for order, _, rows in cell_rows]
    return _pack_cells(
        np.concatenate(corners) if corners else np.zeros((0, 4, 2)), np.array(density), {"rows": version.num_rows}
    )


async def density(
    lake: LakeSession, table: str, order: int, where: str, view: Float | None, value: str | None = None
) -> bytes:
    """4 bytes: length of the head; the head, JSON; float32 corners [n, 4, 2] deg; float32 number per deg2 [n].

    order : of the cells;  where : SQL condition of the rows that count;  view : ra, dec, radius deg; None: everything
    table : of the rows;  value : SQL whose mean over the rows of a cell is told instead of their number; rows that
            have no finite one are `missing` of the head, not of the mean
    """
    if not 0 <= order <= _MAX_ORDER:
        raise BadInput(f"order = {order} is outside [0, {_MAX_ORDER}]")
    shift = 2 * (sky.MAX_ORDER - order)
    aggregate = "count(*)::DOUBLE AS told, 0 AS lost"
    if value is not None:
        # One NaN would make a NaN of the mean of its cell.
        number = f"TRY_CAST(({value}\n) AS DOUBLE)"
        finite = f"FILTER (isfinite({number}))"
        aggregate = f"avg({number}) {finite} AS told, count(*) - count(*) {finite} AS lost"
    text = f"""SELECT _healpix_29 >> {shift} AS cell, count(*) AS n, {aggregate} FROM {_catalogue_name(lake, table)}
               WHERE ({where}\n) AND {_view_condition(view)} GROUP BY cell ORDER BY cell LIMIT {MAX_CELLS + 1}"""
    rows = await _run_query(lake, text, where, *([value] if value is not None else []))
    _refuse_many_cells(rows.num_rows)
    header = {"order": order, "rows": _sum(rows["n"]), "missing": _sum(rows["lost"])}
    rows = rows.filter(pc.is_finite(rows["told"]))
    area = sky.cell_area(order) if value is None else 1.0
    return _pack_cells(_corners(order, rows["cell"].to_numpy()), rows["told"].to_numpy() / area, header)


def _sum(column: pa.ChunkedArray) -> int:
    return int(pc.sum(column).as_py() or 0)


def coverage(lake: LakeSession, order: int, view: Float | None, band: str | None) -> bytes:
    """The same with how many of the planned exposures see the centre of each cell.

    lake : whose plan;  order : of the cells
    view : ra, dec, radius deg; None: everything;  band : of the exposures, None = all
    """
    from truesky.render.camera import footprints

    if not 0 <= order <= _MAX_ORDER:
        raise BadInput(f"order = {order} is outside [0, {_MAX_ORDER}]")
    cells, rows = np.zeros(0, np.int64), 0
    if view is not None:
        cells = sky.cells_in_cone(float(view[0]), float(view[1]), min(float(view[2]), 180.0), order)
    else:
        for tasks in _planned_tasks(lake, band, _CIRCLE_COLUMNS):
            circles = np.unique(np.stack([tasks[name].to_numpy() for name in _CIRCLE_COLUMNS[1:]], axis=1), axis=0)
            for ra, dec, radius in circles:
                cells = np.union1d(cells, sky.cells_in_cone(ra, dec, radius, order))
                _refuse_many_cells(len(cells))
    exposure_counts, centres = np.zeros(len(cells), np.int64), sky.cell_centres(order, cells) if len(cells) else None
    for tasks in _planned_tasks(lake, band, _TASK_COLUMNS):
        rows += tasks.num_rows
        if centres is not None:
            exposure_counts += footprints.counts(tasks, *centres)
    cells, exposure_counts = cells[exposure_counts > 0], exposure_counts[exposure_counts > 0]
    _refuse_many_cells(len(cells))
    return _pack_cells(_corners(order, cells), exposure_counts.astype(float), {"order": order, "rows": rows})


def _planned_tasks(lake: LakeSession, band: str | None, columns: Sequence[str]) -> Iterator[pa.Table]:
    """What is planned in a band, None = in all, a part of a plan after the other.

    What several requests have of one version counts once.
    """
    for request_tables in {
        request_tables.versions["tasks"].key: request_tables
        for request_tables in lake.observed_requests
        if "tasks" in request_tables.versions
    }.values():
        numbers = None
        if band is not None:
            exposures = request_tables.versions["exposures"].rows(("exposure_id", "band"))
            numbers = exposures.filter(pc.equal(exposures["band"], band))["exposure_id"].combine_chunks()
        for rows in request_tables.iterate_rows("tasks", columns):
            yield rows if numbers is None else rows.filter(pc.is_in(rows["exposure_id"], numbers))


def bands(lake: LakeSession) -> list[str]:
    """Passbands in which exposures are planned."""
    tables = (
        rows
        for request_tables in lake.observed_requests
        for rows in request_tables.iterate_rows("exposures", ("band",))
    )
    return sorted({band for rows in tables for band in rows["band"].unique().to_pylist()})


def _refuse_many_cells(cells: int) -> None:
    if cells > MAX_CELLS:
        raise BadInput(f"more than {MAX_CELLS:,} cells hold something: look at a part, or at larger cells")


def _corners(order: int, cells: Int) -> Float:
    return sky.cell_corners(order, cells) if len(cells) else np.zeros((0, 4, 2))


async def sources_in_view(lake: LakeSession, table: str, view: Float, where: str) -> Json:
    """Rows of a catalogue in a field: places, identifiers, a magnitude, a kind; of `total` the brightest `most`.

    view : ra, dec, radius deg;  where : SQL condition

    `by` is the column of the magnitude, which a mass may stand for; `sense` 1 where small numbers come first, else -1.
    """
    version = lake.find_version(table)
    names = version.schema.names
    lon, lat, radius = (float(number) for number in view)
    mag, sort_sign = next((sort_column for sort_column in _SORT_COLUMNS if sort_column[0] in names), (None, 1))
    key = "id" if "id" in names else names[0]
    selected_columns = [f'"{key}" AS id', "ra", "dec", f"{mag or 'NULL'} AS mag"]
    selected_columns += ["kind" if "kind" in names else "NULL AS kind", "count(*) OVER () AS total"]
    text = f"""SELECT {", ".join(selected_columns)} FROM {_catalogue_name(lake, table)}
               WHERE ({where}\n) AND {_view_condition(view)}
               AND separation(ra, dec, {lon!r}, {lat!r}) <= {radius!r}
               ORDER BY {("mag DESC" if sort_sign < 0 else "mag") if mag else "1"} NULLS LAST LIMIT {MAX_SOURCES}"""
    rows = await _run_query(lake, text, where)
    columns = {name: rows[name].to_pylist() for name in ("ra", "dec", "mag", "kind")}
    return {**columns, "id": [str(value) for value in rows["id"].to_pylist()], "by": mag, "sense": sort_sign} | {
        "total": rows["total"][0].as_py() if rows.num_rows else 0,
        "most": MAX_SOURCES,
    }


async def _run_query(lake: LakeSession, text: str, *expressions: str) -> pa.Table:
    async with lake.page_queries.process() as process:

        def fetch_rows() -> pa.Table:
            return pa.Table.from_batches(list(process.batches(text, {}, lake.timeout, expressions=expressions)))

        return await asyncio.to_thread(fetch_rows)


def _catalogue_name(lake: LakeSession, table: str) -> str:
    if not is_catalogue(lake.find_version(table)):
        raise BadInput(f"table {table} has no positions")
    return ".".join(f'"{name}"' for name in table.split("."))


def _view_condition(view: Float | None) -> str:
    """The condition that a row lies in cells that the view touches: files and row groups outside are not read."""
    if view is None:
        return "true"
    return adql.cone_condition("_healpix_29", *(float(number) for number in view))


def _pack_cells(corners: Float, density: Float, header: Json) -> bytes:
    return pack({**header, "cells": len(density)}, np.asarray(corners, "<f4"), np.asarray(density, "<f4"))


# ------------------------------------------------------------------------------------------------ footprints


def regions(lake: LakeSession) -> list[Json]:
    """Footprints of detectors: what was planned, what is done, what failed; images by number, each with its content.

    Each has the request whose exposure it is of, None where the lake has no other.
    """
    failures = _failure_messages(lake)
    return [_current_region(place, region, failures) for place, region in _known_regions(lake).items()]


# A request, one of its exposures, and a detector: by these a footprint is found.
_DetectorKey = tuple[str | None, int, str]


@lru_cache(maxsize=4)
def _known_regions(lake: LakeSession) -> Mapping[_DetectorKey, Json]:
    """What was planned, of a large plan with exposures of which something is done; and what is done.

    That does not change while the lake is open.
    """
    from truesky.page import pictures

    regions_by_key: dict[_DetectorKey, Json] = {}
    for request_tables in lake.observed_requests:
        begun = {
            image.row["exposure_id"]
            for image in pictures.pictures(lake)
            if image.request_tables.request == request_tables.request
        }
        regions_by_key |= _planned_regions(request_tables, begun if _is_large(request_tables) else None)
    for number, image in enumerate(pictures.pictures(lake)):
        new_region = {**_detector_region(image.request_tables, image.row), "images": [], "contents": []}
        region = regions_by_key.setdefault(image.detector_key, new_region)
        region |= {"state": "observed", "band": image.row["band"]}
        region["images"].append(number)
        region["contents"].append(image.row["content"])
    return regions_by_key


def _is_large(request_tables: RequestTables) -> bool:
    return "tasks" in request_tables.versions and request_tables.versions["tasks"].num_rows > LARGE_PLAN


def _planned_regions(
    request_tables: RequestTables, exposure_ids: Collection[int] | None = None
) -> dict[_DetectorKey, Json]:
    """Detectors of a request's exposures, None = of all of them."""
    band_by_exposure = {
        row["exposure_id"]: row["band"]
        for row in request_tables.rows("exposures", ("exposure_id", "band"), exposure_ids)
    }
    regions_by_key = {}
    for row in request_tables.rows("tasks", ("exposure_id", "detector", "channel", "s_region"), exposure_ids):
        details: Json = {
            "state": "planned",
            "images": [],
            "contents": [],
            "band": band_by_exposure.get(row["exposure_id"]),
        }
        regions_by_key[request_tables.request, row["exposure_id"], row["detector"]] = {
            **_detector_region(request_tables, row),
            **details,
        }
    return regions_by_key


def _regions_in_view(lake: LakeSession, view: Float | None) -> dict[_DetectorKey, Json]:
    """Of large plans the detectors that may be in view.  Errors: BadInput where they are too many"""
    regions_by_key: dict[_DetectorKey, Json] = {}
    for request_tables in filter(_is_large, lake.observed_requests):
        exposures = request_tables.versions["exposures"].rows(("exposure_id", "ra", "dec"))
        exposures = exposures.filter(pc.is_valid(exposures["ra"]))
        if view is not None:
            ra, dec = (exposures[name].to_numpy() for name in ("ra", "dec"))
            distance = sky.separation(ra, dec, float(view[0]), float(view[1]))
            exposures = exposures.filter(pa.array(distance <= float(view[2]) + MAX_CAMERA_RADIUS))
        _refuse_many_exposures(exposures.num_rows, MAX_LOOKED_UP)
        regions_by_key |= _planned_regions(request_tables, exposures["exposure_id"].to_pylist())
    return regions_by_key


def _refuse_many_exposures(exposures: int, max_exposures: int) -> None:
    if exposures > max_exposures:
        raise BadInput(f"more than {max_exposures:,} exposures are here: look at a part")


def _failure_messages(lake: LakeSession) -> dict[tuple[str | None, str], str]:
    """Why a part of a request's images could not be made: runs of other processes may say so at any time."""
    from truesky.page import pictures

    return {
        (request_tables.request, str(row["part"])): str(row["error"])
        for request_tables in lake.observed_requests
        for row in pictures.failed_detectors(lake, request_tables)
    }


def _current_region(detector_key: _DetectorKey, region: Json, failures: Mapping[tuple[str | None, str], str]) -> Json:
    request, exposure, detector = detector_key
    error = failures.get((request, f"{exposure:06d}-{detector}.parquet".lower())) if failures else None
    return {**region, "state": "failed", "error": error} if error and region["state"] == "planned" else region


def _detector_region(request_tables: RequestTables, row: Mapping[str, Any]) -> Json:
    numbers = [float(text) for text in row["s_region"].split()[2:]]
    polygon = [numbers[k : k + 2] for k in range(0, len(numbers), 2)]
    identity = {key: row[key] for key in ("exposure_id", "detector", "channel")}
    return {"request": request_tables.request, **identity, "polygon": polygon}


def exposure_footprints(lake: LakeSession, view: Float | None = None) -> list[Json]:
    """Footprints of exposures, each the convex hull of its detectors: how many of these are done, and how many failed.

    view   : ra, dec, radius deg, None = all;  returns: of each exposure its state, what it is, and `outline`, polygons
    Errors : BadInput where they are more than are shown
    """
    regions_by_key, (descriptions, detector_keys, circles) = _known_regions(lake), _cached_outlines(lake)
    if added_regions := _regions_in_view(lake, view):
        regions_by_key = {**added_regions, **regions_by_key}
        descriptions, detector_keys, circles = _outline_exposures(lake, regions_by_key)
    # A circle about all corners meets the one in view.
    in_view = np.full(len(descriptions), True)
    if view is not None:
        in_view = sky.separation(circles[:, 0], circles[:, 1], view[0], view[1]) <= circles[:, 2] + view[2]
    _refuse_many_exposures(int(np.count_nonzero(in_view)), MAX_EXPOSURES)
    failures, footprints = _failure_messages(lake), []
    for k in np.flatnonzero(in_view):
        exposure_regions = [
            _current_region(detector_key, regions_by_key[detector_key], failures) for detector_key in detector_keys[k]
        ]
        states = [region["state"] for region in exposure_regions]
        done, failed = states.count("observed"), states.count("failed")
        corners = np.array([corner for region in exposure_regions for corner in region["polygon"]])
        footprints.append(
            {
                **descriptions[k],
                "state": _state(done, failed, len(exposure_regions)),
                "done": done,
                "failed": failed,
                "all": len(exposure_regions),
            }
            | {"outline": [_convex_hull(corners).tolist()]}
        )
    return footprints


_EXPOSURE_COLUMNS = ("exposure_id", "channel", "camera", "band", "image_type", "mjd")


@lru_cache(maxsize=4)
def _cached_outlines(lake: LakeSession) -> tuple[list[Json], list[list[_DetectorKey]], Float]:
    return _outline_exposures(lake, _known_regions(lake))


def _outline_exposures(
    lake: LakeSession, regions_by_key: Mapping[_DetectorKey, Json]
) -> tuple[list[Json], list[list[_DetectorKey]], Float]:
    """Of every exposure what it is, its detectors, and a circle about their corners: ra, dec, radius deg [n, 3]."""
    detectors = dict[tuple[str | None, int], list[_DetectorKey]]()
    for detector_key in regions_by_key:
        detectors.setdefault(detector_key[:2], []).append(detector_key)
    rows = {
        (request_tables.request, row["exposure_id"]): {name: to_json_value(value) for name, value in row.items()}
        for request_tables in lake.observed_requests
        for row in request_tables.rows(
            "exposures",
            _EXPOSURE_COLUMNS,
            {number for request, number in detectors if request == request_tables.request},
        )
    }
    descriptions, detector_keys, circles = [], [], []
    for (request, number), exposure_keys in sorted(detectors.items(), key=lambda item: (item[0][0] or "", item[0][1])):
        exposure_regions = [regions_by_key[detector_key] for detector_key in exposure_keys]
        defaults = {
            "channel": exposure_regions[0]["channel"],
            "camera": None,
            "band": exposure_regions[0]["band"],
            "image_type": None,
            "mjd": None,
        }
        descriptions.append({"request": request, "exposure_id": number, **defaults, **rows.get((request, number), {})})
        detector_keys.append(exposure_keys)
        corners = np.array([corner for region in exposure_regions for corner in region["polygon"]])
        ra, dec = _mean_position(corners)
        circles.append((ra, dec, sky.separation(corners[:, 0], corners[:, 1], ra, dec).max()))
    return descriptions, detector_keys, np.array(circles).reshape(-1, 3)


def _state(done: int, failed: int, number: int) -> str:
    if done:
        return "observed" if done == number else "partly"
    return "failed" if failed else "planned"


def _mean_position(corners: Float) -> tuple[float, float]:
    """ra, dec of the mean of unit vectors, deg."""
    x, y, z = sky.unit_vectors(corners[:, 0], corners[:, 1]).mean(0)
    return float(np.degrees(np.arctan2(y, x)) % 360.0), float(np.degrees(np.arctan2(z, np.hypot(x, y))))


def _convex_hull(corners: Float) -> Float:
    """Those of the places [n, 2] deg that no great circle cuts off, counter-clockwise with north up and east left.

    In the tangent plane of their middle great circles are straight lines. Of places on one line its ends are left.
    """
    from scipy.spatial import ConvexHull, QhullError

    from truesky.page import pictures

    plane = np.stack(pictures.to_tangent_plane(corners[:, 0], corners[:, 1], *_mean_position(corners)), axis=1)
    try:
        # East is to the left of north.
        hull: Float = corners[ConvexHull(plane).vertices[::-1]]
    except QhullError:
        hull = corners[np.lexsort((plane[:, 1], plane[:, 0]))[[-1, 0]]]
    return hull
