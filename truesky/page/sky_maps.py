"""Data of the sky maps of the web page: densities in HEALPix cells, sources in a field, footprints of exposures.

The modules of the renderer take long to import. They are imported inside the functions, so that the first map, which
does not need them, is shown early.
"""

from __future__ import annotations

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
# Largest number of HEALPix cells of a map.
MAX_CELLS = 200_000
# Largest number of sources that `sources_in_view` returns.
MAX_SOURCES = 20_000
# Largest HEALPix order of a map.
_MAX_ORDER = 16
# Largest number of exposures whose footprints are returned at once.
MAX_EXPOSURES = 20_000
# If a request plans more detector images than this, the map reads only the planned exposures that may be in view.
LARGE_PLAN = 200_000
# Largest number of exposures in view whose detectors are read if the request plans more than LARGE_PLAN images.
MAX_LOOKED_UP = 1_000
# An exposure may be in view if its pointing is within this angle (deg) of the edge of the view.
MAX_CAMERA_RADIUS = 2.0
Json = dict[str, Any]
# Columns by which the sources in a field can be sorted, brightest or most massive first: the name, and 1 for ascending
# order (magnitudes) or -1 for descending order (masses). The first column that the table has is used.
_SORT_COLUMNS = (("mag_r01", 1), ("mag_h", 1), ("phot_g_mean_mag", 1), ("log_mass", -1))


def partition_density(lake: LakeSession, table: str) -> bytes:
    """Return a coarse density map of a catalogue: the mean density in the HEALPix cell of each of its files.

    This is fast, because the numbers of rows are in the manifest (the list of the files), and no file is read.

    Parameters
    ----------
    lake : LakeSession
        The open lake.
    table : str
        Name of a catalogue.

    Returns
    -------
    bytes
        The length of the header (4 bytes), the header (JSON), the corners of the cells in degrees (float32
        [n, 4, 2]), and the number of sources per deg2 (float32 [n]). The header has `cells` (n) and `rows` (the number
        of sources).

    Raises
    ------
    BadInput
        If the lake has no such table, or the table has no positions.
    """
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
    """Return the density of a catalogue, or the mean of an expression, in HEALPix cells.

    Parameters
    ----------
    lake : LakeSession
        The open lake.
    table : str
        Name of a catalogue.
    order : int
        HEALPix order of the cells, 0 to 16.
    where : str
        SQL condition that selects rows; "true" for all rows.
    view : float array, shape (3,), or None
        RA, Dec and radius of the field in degrees; None for the whole sky.
    value : str, optional
        SQL expression whose mean per cell is returned; by default the density is returned.

    Returns
    -------
    bytes
        The length of the header (4 bytes), the header (JSON), the corners of the cells in degrees (float32
        [n, 4, 2]), and the number of rows per deg2 or the mean (float32 [n]). The header has `cells` (n), `order`,
        `rows` (the number of rows) and `missing` (the number of rows without a finite value, which do not enter the
        mean).

    Raises
    ------
    BadInput
        If the order is outside its limits, the lake has no such table, the table has no positions, `where` or `value`
        is not exactly one valid SQL expression, or more than 200,000 cells contain rows.
    """
    if not 0 <= order <= _MAX_ORDER:
        raise BadInput(f"order = {order} is outside [0, {_MAX_ORDER}]")
    shift = 2 * (sky.MAX_ORDER - order)
    aggregate = "count(*)::DOUBLE AS told, 0 AS lost"
    if value is not None:
        # Values that are not finite are left out: a single NaN would make the mean of its cell NaN.
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
    """Return the number of planned exposures that cover the centre of each HEALPix cell.

    Parameters
    ----------
    lake : LakeSession
        The open lake.
    order : int
        HEALPix order of the cells, 0 to 16.
    view : float array, shape (3,), or None
        RA, Dec and radius of the field in degrees; None for the whole sky.
    band : str or None
        Passband of the exposures; None for all exposures.

    Returns
    -------
    bytes
        The length of the header (4 bytes), the header (JSON), the corners of the covered cells in degrees (float32
        [n, 4, 2]), and their numbers of exposures (float32 [n]). The header has `cells` (n), `order` and `rows` (the
        number of planned detector images, on the whole sky).

    Raises
    ------
    BadInput
        If the order is outside its limits, or more than 200,000 cells are covered. For the whole sky, also if the
        circles around all planned detectors touch more cells.
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
    """Yield the planned detector images in a passband (None for all), as rows of the table `tasks`.

    Each yielded table contains the rows of one file of the plan. A plan that several requests share is read once.
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
    """Return the sorted names of the passbands of all planned exposures, each once."""
    tables = (
        rows
        for request_tables in lake.observed_requests
        for rows in request_tables.iterate_rows("exposures", ("band",))
    )
    return sorted({band for rows in tables for band in rows["band"].unique().to_pylist()})


def _refuse_many_cells(cells: int) -> None:
    if cells > MAX_CELLS:
        raise BadInput(f"more than {MAX_CELLS:,} cells contain rows: use a smaller field or larger cells")


def _corners(order: int, cells: Int) -> Float:
    return sky.cell_corners(order, cells) if len(cells) else np.zeros((0, 4, 2))


async def sources_in_view(lake: LakeSession, table: str, view: Float, where: str) -> Json:
    """Return the brightest (or most massive) sources of a catalogue in a circular field, at most 20,000.

    Parameters
    ----------
    lake : LakeSession
        The open lake.
    table : str
        Name of a catalogue.
    view : float array, shape (3,)
        RA, Dec and radius of the field in degrees.
    where : str
        SQL condition that selects rows; "true" for all rows.

    Returns
    -------
    dict
        Lists with one value per source: `ra`, `dec` (deg), `id` (text), `mag`, and `kind` (code of the source type, or
        None). `by` is the name of the table's column in `mag`, a magnitude or a log10 mass, or None if the table has
        neither. `sense` is 1 if sources are in ascending order of `mag`, and -1 if in descending order. `total` is the
        number of sources in the field, and `most` the largest number that is returned.

    Raises
    ------
    BadInput
        If the lake has no such table, the table has no positions, or `where` is not exactly one valid SQL expression.
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

        return await lake.page_queries.threads.run(fetch_rows)


def _catalogue_name(lake: LakeSession, table: str) -> str:
    if not is_catalogue(lake.find_version(table)):
        raise BadInput(f"table {table} has no positions")
    return ".".join(f'"{name}"' for name in table.split("."))


def _view_condition(view: Float | None) -> str:
    """Return an SQL condition on the HEALPix cell of a row, with which DuckDB skips files outside the view.

    `view` is RA, Dec and radius of a circle in degrees. The condition is true for all rows in the circle and for some
    outside it; it is "true" if `view` is None.
    """
    if view is None:
        return "true"
    return adql.cone_condition("_healpix_29", *(float(number) for number in view))


def _pack_cells(corners: Float, density: Float, header: Json) -> bytes:
    return pack({**header, "cells": len(density)}, np.asarray(corners, "<f4"), np.asarray(density, "<f4"))


def regions(lake: LakeSession) -> list[Json]:
    """Return the footprint on the sky of each planned or rendered detector image, with its state.

    Parameters
    ----------
    lake : LakeSession
        The open lake.

    Returns
    -------
    list of dict
        One entry per detector and exposure: `request` (None unless requests have different plans or images),
        `exposure_id`, `detector`, `channel`, `band`, `polygon` (RA and Dec of the corners in degrees), `state`
        ("planned", "observed" or "failed"), `error` (only if failed), `images` (numbers of the image files, see
        `pictures.pictures`) and `contents` (content of each file, such as "science"). Images without a plan are listed,
        too. If a request plans more than 200,000 detector images, only exposures that have an image are listed.
    """
    failures = _failure_messages(lake)
    return [_current_region(place, region, failures) for place, region in _known_regions(lake).items()]


# Identifies a detector image: name of the request (or None), number of the exposure, name of the detector.
_DetectorKey = tuple[str | None, int, str]


@lru_cache(maxsize=4)
def _known_regions(lake: LakeSession) -> Mapping[_DetectorKey, Json]:
    """Return the footprints of planned and rendered detector images, with the state "planned" or "observed".

    The result is cached, because it does not change while the lake is open. If a request plans more than 200,000
    detector images, only exposures that have an image are included.
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
    """Return the footprints of the planned detector images of a request.

    `exposure_ids` selects exposures by number; None selects all.
    """
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
    """Return the footprints of planned detector images that may be in view, for requests with large plans only.

    `view` is RA, Dec and radius of a circle in degrees; None is the whole sky. A plan is large if it has more than
    200,000 detector images. BadInput is raised if more than 1,000 exposures of such a plan may be in view.
    """
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
        raise BadInput(f"more than {max_exposures:,} exposures are in view: use a smaller field")


def _failure_messages(lake: LakeSession) -> dict[tuple[str | None, str], str]:
    """Return the error messages of detectors whose rendering failed.

    The keys are the name of the request (or None) and the name of the detector's table file in lower case, such as
    "000012-det22.parquet" for exposure 12. The logs are read at each call, because rendering may be in progress.
    """
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
    """Return the footprints of exposures on the sky, each the convex hull of its detectors.

    Parameters
    ----------
    lake : LakeSession
        The open lake.
    view : float array, shape (3,), optional
        RA, Dec and radius of the field in degrees. The default is the whole sky.

    Returns
    -------
    list of dict
        One entry per exposure: `request`, columns of the table `exposures`, `state` ("planned", "partly", "observed" or
        "failed"), the numbers of detector images that are `done`, that `failed`, and of `all`, and `outline` (a list
        with one polygon: RA and Dec of the corners in degrees).

    Raises
    ------
    BadInput
        If more than 20,000 exposures are in view, or more than 1,000 of a plan with more than 200,000 detector images.
    """
    regions_by_key, (descriptions, detector_keys, circles) = _known_regions(lake), _cached_outlines(lake)
    if added_regions := _regions_in_view(lake, view):
        regions_by_key = {**added_regions, **regions_by_key}
        descriptions, detector_keys, circles = _outline_exposures(lake, regions_by_key)
    # Select exposures whose circle (around the corners of all detectors) overlaps the circle in view.
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
    """Group the footprints of detector images by exposure.

    Return for each exposure its description, the keys of its detector images in `regions_by_key`, and a circle that
    contains their corners. The circles are an array [n, 3]: RA, Dec and radius in degrees.
    """
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
    """Return RA and Dec (deg) of the mean of the unit vectors of positions [n, 2], given as RA and Dec in deg."""
    x, y, z = sky.unit_vectors(corners[:, 0], corners[:, 1]).mean(0)
    return float(np.degrees(np.arctan2(y, x)) % 360.0), float(np.degrees(np.arctan2(z, np.hypot(x, y))))


def _convex_hull(corners: Float) -> Float:
    """Return the corners of the convex hull of positions on the sphere, [n, 2] RA and Dec in deg.

    The order is counter-clockwise with north up and east to the left. If all positions lie on one great circle, its
    two ends are returned. The hull is computed in a tangent plane, where great circles are straight lines.
    """
    from scipy.spatial import ConvexHull, QhullError

    from truesky.page import pictures

    plane = np.stack(pictures.to_tangent_plane(corners[:, 0], corners[:, 1], *_mean_position(corners)), axis=1)
    try:
        # ConvexHull returns corners counter-clockwise with east to the right. On the sky east is to the left, so the
        # order is reversed.
        hull: Float = corners[ConvexHull(plane).vertices[::-1]]
    except QhullError:
        hull = corners[np.lexsort((plane[:, 1], plane[:, 0]))[[-1, 0]]]
    return hull
