"""Counts for the linked histograms (charts) of the web page: limits set in one chart select the rows of all others.

The columns on the axes are cached as arrays, and one pass over them fills all charts.
"""

from __future__ import annotations

import asyncio
from typing import Any

from lake_schema import tables as declarations
from lake_schema.errors import BadInput
from truesky.explore import columns, counting
from truesky.explore.columns import Selection
from truesky.explore.counting import Chart, ChartColumns
from truesky.page.answers import pack
from truesky.page.lake_session import LakeSession

# Tables with more rows per thread (one thread per processor core, but at most 8) are subsampled by default, because all
# rows are counted again at every movement of the limits in a chart.
ROWS_PER_CORE = 25_000_000
# In a subsampled table one row in this number is counted.
SUBSAMPLING = 64
# Largest number of SQL expressions (axes of charts) in one HTTP request of the page.
_MAX_AXES = 16
# Largest number of charts in one HTTP request of the page.
_MAX_CHARTS = 16
# Largest number of points that are returned for one chart.
MAX_POINTS = 20_000
# Number of sets of columns that stay memory-mapped; the oldest set is dropped first.
_MAX_CACHED = 4
# Up to this number of rows one thread is used, because several threads are not faster.
_SINGLE_THREAD_ROWS = 1_000_000
Json = dict[str, Any]


async def count_rows(lake: LakeSession, question: Json) -> bytes:
    """Count the rows of a table in the bins of several linked charts.

    Parameters
    ----------
    lake : LakeSession
        The open lake.
    question : dict
        The question of the page, with these keys. `source` : name of a table, or other SQL after FROM. `where` : SQL
        condition that selects rows. `axes` : list of 1 to 16 SQL expressions. `charts` : list of 1 to 16 dictionaries
        with `axes` (indices into the list of expressions), `bins` (number of bins of each axis), `spans` (lowest and
        highest value of each axis, or null for the default), and optionally `own` (indices of expressions whose limits
        do not apply to this chart; by default those on its axes) and `points` (largest number of rows to return as
        points). `limits` : list of [index of an expression, lowest, highest] that select rows. `part` : 1 for all rows,
        64 for one row in 64, or null for 64 in large tables only. All rows are counted if `source` is not a single
        table with columns that identify a row.

    Returns
    -------
    bytes
        The length of the header (4 bytes), the header (JSON), the counts of every chart (uint32, first axis slowest),
        and the points of every chart that requests them (float32 [n, axes]). The header has `rows` (number of rows that
        were counted), `part` (1, or 64 for a subsample), `spans` (for each expression the range of nearly all values),
        `missing` (for each expression the number of rows without a finite value) and `charts`. In each chart, `outside`
        is the number of rows within the limits but outside the ranges of its axes.

    Raises
    ------
    BadInput
        If the question is invalid, or a text is not exactly one valid SQL expression.
    """
    source, where = str(question.get("source", "")), str(question.get("where") or "true")
    axes = [str(axis) for axis in _required_list(question, "axes", _MAX_AXES)]
    _required_list(question, "charts", _MAX_CHARTS)
    key_columns = _key_columns(lake, source)
    subsampling = _choose_subsampling(lake, source, key_columns, question.get("part"))
    selection = Selection(lake.key, source, where, key_columns, subsampling)
    cached_columns = lake.cached_columns.get((selection, *axes))
    if cached_columns is None:
        async with lake.page_queries.process() as process:

            def load_columns() -> ChartColumns:
                loaded = columns.load(
                    selection, axes, lambda text, own: process.batches(text, {}, lake.timeout, expressions=own)
                )
                columns.trim()
                return counting.inspect_columns(loaded)

            cached_columns = await lake.page_queries.threads.run(load_columns)
        # Keep the columns in memory, so that their checksums are verified once and not at every movement of a limit.
        while len(lake.cached_columns) >= _MAX_CACHED:
            lake.cached_columns.pop(next(iter(lake.cached_columns)))
        lake.cached_columns[(selection, *axes)] = cached_columns
    return await asyncio.to_thread(pack_counts, cached_columns, question, subsampling, lake.threads)


def _required_list(question: Json, name: str, max_length: int) -> list[Any]:
    items = question.get(name)
    if not isinstance(items, list) or not 0 < len(items) <= max_length:
        raise BadInput(f"charts: {name} must be a list of 1 to {max_length} entries")
    return items


def _key_columns(lake: LakeSession, source: str) -> tuple[str, ...]:
    """Return the quoted names of the columns that identify a row of a table; () if `source` is not a known table."""
    source = source.replace('"', "")
    if source not in lake.versions:
        return ()
    version = lake.versions[source]
    declaration = declarations.find_table(version.table, version.schema.names)
    return tuple(f'"{name}"' for name in declaration.key) if declaration else ()


def _choose_subsampling(lake: LakeSession, source: str, key_columns: tuple[str, ...], requested: object) -> int:
    if isinstance(requested, int) and not isinstance(requested, bool) and requested in (1, SUBSAMPLING):
        return requested if key_columns else 1
    table = source.replace('"', "")
    is_large = table in lake.versions and lake.versions[table].num_rows > ROWS_PER_CORE * lake.threads
    return SUBSAMPLING if is_large and key_columns else 1


def pack_counts(cached_columns: ChartColumns, question: Json, subsampling: int, threads: int) -> bytes:
    """Count the rows of cached columns in the bins of several charts, and pack the answer of `count_rows`.

    Parameters
    ----------
    cached_columns : ChartColumns
        Columns with the values of the question's SQL expressions, in their order.
    question : dict
        The question of the page, see `count_rows`; only `charts` and `limits` are used.
    subsampling : int
        Subsampling of the columns: they contain one row of the table in this number. The header repeats it as `part`.
    threads : int
        Number of threads; up to a million rows only one is used.

    Returns
    -------
    bytes
        Header, counts and points, see `count_rows`.

    Raises
    ------
    BadInput
        If the charts or limits are invalid, refer to an expression that does not exist, or have too many bins.
    """
    columns = cached_columns.columns
    try:
        charts = [_parse_chart(chart, cached_columns.spans) for chart in question["charts"]]
        max_points = [
            min(max(_parse_integer("points", chart.get("points") or 0), 0), MAX_POINTS) for chart in question["charts"]
        ]
        limits = {
            _parse_integer("limits", axis): (float(lo), float(hi)) for axis, lo, hi in question.get("limits") or ()
        }
        if any(not 0 <= axis < len(columns) for axis in [*limits, *(a for chart in charts for a in chart.columns)]):
            raise BadInput("charts: an axis has no expression")
    except (TypeError, ValueError, LookupError, OverflowError, AttributeError) as error:
        raise BadInput(f"charts: {error}") from None
    rows = len(columns[0])
    chart_counts, outside_counts = counting.count_with_outside(
        columns, charts, limits, threads if rows > _SINGLE_THREAD_ROWS else 1
    )
    samples = [
        counting.points(columns, chart, limits, n) if n else None for chart, n in zip(charts, max_points, strict=True)
    ]
    chart_points = [sample[0] for sample in samples if sample is not None]
    header = {
        "rows": rows,
        "part": subsampling,
        "missing": cached_columns.missing,
        "spans": cached_columns.spans,
        "charts": [
            {"axes": chart.columns, "bins": chart.bins, "spans": chart.spans}
            | {"outside": outside}
            | ({} if sample is None else {"points": len(sample[0]), "points_part": sample[1]})
            for chart, outside, sample in zip(charts, outside_counts, samples, strict=True)
        ],
    }
    return pack(
        header, *(counts.astype("<u4") for counts in chart_counts), *(points.astype("<f4") for points in chart_points)
    )


def _parse_chart(specification: Json, spans: list[tuple[float, float]]) -> Chart:
    axes = tuple(_parse_integer("axes", axis) for axis in specification["axes"])
    requested_spans = specification.get("spans") or [None] * len(axes)
    unlimited_axes = specification.get("own")
    return Chart(
        axes,
        tuple(
            spans[axis] if span is None else (float(span[0]), float(span[1]))
            for axis, span in zip(axes, requested_spans, strict=True)
        ),
        tuple(_parse_integer("bins", bins) for bins in specification["bins"]),
        None if unlimited_axes is None else frozenset(_parse_integer("own", axis) for axis in unlimited_axes),
    )


def _parse_integer(name: str, value: Any) -> int:
    try:
        return int(value)
    except (TypeError, ValueError, OverflowError) as error:
        raise BadInput(f"charts: {name}: {error}") from None
