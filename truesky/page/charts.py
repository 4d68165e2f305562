"""Charts that filter each other: counts of all of them in one pass over kept columns."""

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

# Rows a core that are counted at every move; of more a part is counted first.
ROWS_PER_CORE = 25_000_000
SUBSAMPLING = 64
_MAX_AXES, _MAX_CHARTS, MAX_POINTS = 16, 16, 20_000
# Selections whose columns stay mapped.
_MAX_CACHED = 4
# That one thread counts as soon as several would.
_SINGLE_THREAD_ROWS = 1_000_000
Json = dict[str, Any]


async def count_rows(lake: LakeSession, question: Json) -> bytes:
    """4 bytes: length of the head; the head, JSON; then the counts of every chart, uint32, first axis slowest; then of
    every chart that wants them points, float32 [n, axes].

    Of the head: `spans` and `missing` are of each axis, the span that holds nearly all of its values and the rows that
    have none; of each chart `outside` rows lie beyond its spans, within the limits.

    question : source, where; axes, each an expression; charts, each with axes (numbers), bins, spans (or null) and,
               if need be, own (numbers of axes whose limits do not hold in it) and points (how many at most); limits,
               [axis, lowest, highest] each; part, one row in so many, or null
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

            cached_columns = await asyncio.to_thread(load_columns)
        # Compared with their checksums once, not at every move of a brush.
        while len(lake.cached_columns) >= _MAX_CACHED:
            lake.cached_columns.pop(next(iter(lake.cached_columns)))
        lake.cached_columns[(selection, *axes)] = cached_columns
    return await asyncio.to_thread(pack_counts, cached_columns, question, subsampling, lake.threads)


def _required_list(question: Json, name: str, max_length: int) -> list[Any]:
    items = question.get(name)
    if not isinstance(items, list) or not 0 < len(items) <= max_length:
        raise BadInput(f"charts: wanted a list of 1 to {max_length} {name}")
    return items


def _key_columns(lake: LakeSession, source: str) -> tuple[str, ...]:
    """What tells the rows of a table apart; of anything else than a table nothing."""
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
    """The answer of `counts`, of columns that are kept.

    question : as of `counts`, of which source and axes are in
    held : of the axes, in their order;  part : one row in so many, of which they are;  threads : for many rows
    """
    columns = cached_columns.columns
    try:
        charts = [_parse_chart(chart, cached_columns.spans) for chart in question["charts"]]
        max_points = [min(max(int(chart.get("points") or 0), 0), MAX_POINTS) for chart in question["charts"]]
        limits = {int(axis): (float(lo), float(hi)) for axis, lo, hi in question.get("limits") or ()}
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
    axes = tuple(int(axis) for axis in specification["axes"])
    requested_spans = specification.get("spans") or [None] * len(axes)
    unlimited_axes = specification.get("own")
    return Chart(
        axes,
        tuple(
            spans[axis] if span is None else (float(span[0]), float(span[1]))
            for axis, span in zip(axes, requested_spans, strict=True)
        ),
        tuple(int(bins) for bins in specification["bins"]),
        None if unlimited_axes is None else frozenset(int(axis) for axis in unlimited_axes),
    )
