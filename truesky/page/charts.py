"""Charts that filter each other: counts of all of them in one pass over kept columns."""

from __future__ import annotations

import asyncio
from typing import Any

from lake_schema import tables as declarations
from lake_schema.errors import BadInput
from truesky.explore import columns, counting
from truesky.explore.columns import Selection
from truesky.explore.counting import Chart, Held
from truesky.page.answers import packed
from truesky.page.opened import Lake

# Rows a core that are counted at every move; of more a part is counted first.
ROWS_A_CORE = 25_000_000
PART = 64
_MOST_AXES, _MOST_CHARTS, MOST_POINTS = 16, 16, 20_000
# Selections whose columns stay mapped.
_MOST_HELD = 4
# That one thread counts as soon as several would.
_FEW_ROWS = 1_000_000
Json = dict[str, Any]


async def counts(lake: Lake, question: Json) -> bytes:
    """4 bytes: length of the head; the head, JSON; then the counts of every chart, uint32, first axis slowest; then of
    every chart that wants them points, float32 [n, axes].

    Of the head: `spans` and `missing` are of each axis, the span that holds nearly all of its values and the rows that
    have none; of each chart `outside` rows lie beyond its spans, within the limits.

    question : source, where; axes, each an expression; charts, each with axes (numbers), bins, spans (or null) and,
               if need be, own (numbers of axes whose limits do not hold in it) and points (how many at most); limits,
               [axis, lowest, highest] each; part, one row in so many, or null
    """
    source, where = str(question.get("source", "")), str(question.get("where") or "true")
    axes = [str(axis) for axis in _list(question, "axes", _MOST_AXES)]
    _list(question, "charts", _MOST_CHARTS)
    keys = _keys(lake, source)
    part = _part(lake, source, keys, question.get("part"))
    selection = Selection(lake.key, source, where, keys, part)
    held = lake.held.get((selection, *axes))
    if held is None:
        async with lake.own.process() as process:

            def kept() -> Held:
                found = columns.kept(
                    selection, axes, lambda text, own: process.batches(text, {}, lake.timeout, expressions=own)
                )
                columns.trim()
                return counting.held(found)

            held = await asyncio.to_thread(kept)
        # Compared with their checksums once, not at every move of a brush.
        while len(lake.held) >= _MOST_HELD:
            lake.held.pop(next(iter(lake.held)))
        lake.held[(selection, *axes)] = held
    return await asyncio.to_thread(answered, held, question, part, lake.threads)


def _list(question: Json, name: str, most: int) -> list[Any]:
    found = question.get(name)
    if not isinstance(found, list) or not 0 < len(found) <= most:
        raise BadInput(f"charts: wanted a list of 1 to {most} {name}")
    return found


def _keys(lake: Lake, source: str) -> tuple[str, ...]:
    """What tells the rows of a table apart; of anything else than a table nothing."""
    source = source.replace('"', "")
    if source not in lake.versions:
        return ()
    version = lake.versions[source]
    known = declarations.find(version.table, version.schema.names)
    return tuple(f'"{name}"' for name in known.key) if known else ()


def _part(lake: Lake, source: str, keys: tuple[str, ...], asked: object) -> int:
    if isinstance(asked, int) and not isinstance(asked, bool) and asked in (1, PART):
        return asked if keys else 1
    table = source.replace('"', "")
    many = table in lake.versions and lake.versions[table].num_rows > ROWS_A_CORE * lake.threads
    return PART if many and keys else 1


def answered(held: Held, question: Json, part: int, threads: int) -> bytes:
    """The answer of `counts`, of columns that are kept.

    question : as of `counts`, of which source and axes are in
    held : of the axes, in their order;  part : one row in so many, of which they are;  threads : for many rows
    """
    columns = held.columns
    try:
        charts = [_chart(chart, held.spans) for chart in question["charts"]]
        most = [min(max(int(chart.get("points") or 0), 0), MOST_POINTS) for chart in question["charts"]]
        limits = {int(axis): (float(lo), float(hi)) for axis, lo, hi in question.get("limits") or ()}
        if any(not 0 <= axis < len(columns) for axis in [*limits, *(a for chart in charts for a in chart.columns)]):
            raise BadInput("charts: an axis has no expression")
    except (TypeError, ValueError, LookupError, OverflowError, AttributeError) as error:
        raise BadInput(f"charts: {error}") from None
    rows = len(columns[0])
    found, beyond = counting.tallied(columns, charts, limits, threads if rows > _FEW_ROWS else 1)
    sampled = [counting.points(columns, chart, limits, n) if n else None for chart, n in zip(charts, most, strict=True)]
    scattered = [one[0] for one in sampled if one is not None]
    head = {
        "rows": rows,
        "part": part,
        "missing": held.missing,
        "spans": held.spans,
        "charts": [
            {"axes": chart.columns, "bins": chart.bins, "spans": chart.spans}
            | {"outside": outside}
            | ({} if one is None else {"points": len(one[0]), "points_part": one[1]})
            for chart, outside, one in zip(charts, beyond, sampled, strict=True)
        ],
    }
    return packed(head, *(counts.astype("<u4") for counts in found), *(points.astype("<f4") for points in scattered))


def _chart(asked: Json, spans: list[tuple[float, float]]) -> Chart:
    axes = tuple(int(axis) for axis in asked["axes"])
    given = asked.get("spans") or [None] * len(axes)
    own = asked.get("own")
    return Chart(
        axes,
        tuple(
            spans[axis] if span is None else (float(span[0]), float(span[1]))
            for axis, span in zip(axes, given, strict=True)
        ),
        tuple(int(bins) for bins in asked["bins"]),
        None if own is None else frozenset(int(axis) for axis in own),
    )
