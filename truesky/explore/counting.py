"""Counts of many rows for several charts at once, each under the limits that are set in the others.

Chart       what is counted of which columns
counted     all charts in one pass over kept columns
tallied     the same with the rows that lie outside of each chart's spans
held        columns, with what is told of each at every question
points      some of the rows that count in a chart
span        a range that holds nearly all of a column

A row counts in a chart if it lies within the limits of every column that is not the chart's own, and within the
chart's spans. A missing value (NaN) is in no bin, and within no limits.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import reduce

import numpy as np

from lake_schema.arrays import Bool, Float, Float32, Int
from lake_schema.errors import BadInput
from truesky.numerics.compiling import exact_jit

# Rows that are counted at a time: a few columns of them stay in a processor's own cache.
_BLOCK = 32768
_MAX_COLUMNS, MAX_CELLS = 30, 8_000_000
_MAX_AXES = 3
# Counts of all threads together: 128 MB.
_MAX_COUNTS = 2 * MAX_CELLS
# A grid of more cells than so many a row of a block is counted in directly.
_SPARSE = 4
# Rows that tell a span, and the part of them that may lie outside on each side.
_SPAN_SAMPLE, _OUTSIDE = 200_000, 2e-3
# Rows that are looked at for a point, at first.
_ROWS_PER_POINT = 8

# Values of which missing ones are counted at a time.
_PIECE = 1 << 22
# The bit of a row that has a value on every axis, one of them outside of the spans; those below are of the columns.
_OUTSIDE_BIT = 1 << _MAX_COLUMNS

Limits = Mapping[int, tuple[float, float]]


@dataclass(frozen=True, slots=True)
class Chart:
    """Counts in a grid of equal bins.

    columns : numbers of the kept columns along its axes, one to three;  spans : lowest and highest value of each
    bins    : of each axis;  own : columns whose limits do not hold here, None = those of its axes
    """

    columns: tuple[int, ...]
    spans: tuple[tuple[float, float], ...]
    bins: tuple[int, ...]
    ignored_limits: frozenset[int] | None = None

    def __post_init__(self) -> None:
        if not 1 <= len(self.columns) == len(self.spans) == len(self.bins) <= _MAX_AXES:
            raise BadInput("a chart has one to three axes, each with a span and a number of bins")
        if not all(np.isfinite([lo, hi]).all() and lo < hi for lo, hi in self.spans):
            raise BadInput(f"spans = {self.spans} are not from a finite number to a larger one")
        if not (min(self.bins) >= 1 and self.cells <= MAX_CELLS):
            raise BadInput(f"bins = {self.bins} are not between 1 and {MAX_CELLS} in all")

    @property
    def cells(self) -> int:
        # Whole numbers of any size: a product of 64 bits would wrap around, and pass for a small one.
        return math.prod(int(bins) for bins in self.bins)


def count_rows(columns: Sequence[Float32], charts: Sequence[Chart], limits: Limits, threads: int = 1) -> list[Int]:
    """int64[bins of the first axis, of the second ...] of each chart.

    columns : float32[n] each;  charts : what to count
    limits  : number of a column -> lowest and highest value that count, both included
    threads : that count side by side, fewer where the counts of each would fill much memory
    """
    return count_with_outside(columns, charts, limits, threads)[0]


def count_with_outside(
    columns: Sequence[Float32], charts: Sequence[Chart], limits: Limits, threads: int = 1
) -> tuple[list[Int], list[int]]:
    """(Counts as of `counted`; of each chart the rows within the limits that have a value on each of its axes, one of
    them outside of the spans).

    columns, charts, limits, threads : as of `counted`
    """
    if not 1 <= len(columns) <= _MAX_COLUMNS or len({len(column) for column in columns}) != 1:
        raise BadInput(f"counting wants 1 to {_MAX_COLUMNS} columns of the same rows")
    _check(len(columns), charts, limits)
    tables = _tables(len(columns), charts, limits)
    rows = len(columns[0])
    threads = max(1, min(threads, _MAX_COUNTS // max(1, sum(chart.cells for chart in charts))))
    edges = np.linspace(0, rows, threads + 1).astype(np.int64)

    cells = sum(chart.cells for chart in charts)

    def count_part(number: int) -> Int:
        # Behind the counts, of each chart the rows outside of its spans.
        counts = np.zeros(cells + len(charts), np.int64)
        for first in range(int(edges[number]), int(edges[number + 1]), _BLOCK):
            last = min(first + _BLOCK, int(edges[number + 1]))
            _count_block(np.stack([column[first:last] for column in columns]), *tables, counts[:cells], counts[cells:])
        return counts

    if threads == 1:
        total = count_part(0)
    else:
        with ThreadPoolExecutor(threads) as pool:
            total = reduce(np.add, pool.map(count_part, range(threads)))
    *pieces, outside = np.split(total, np.cumsum([chart.cells for chart in charts]))
    counts_by_chart = [piece.reshape(chart.bins) for piece, chart in zip(pieces, charts, strict=True)]
    return counts_by_chart, [int(rows) for rows in outside]


def _check(number: int, charts: Sequence[Chart], limits: Limits) -> None:
    """Refuse what the compiled loops, which look at no bounds, would read or write outside of their arrays."""
    if any(not 0 <= column < number for column in [*limits, *(c for chart in charts for c in chart.columns)]):
        raise BadInput(f"a chart or a limit is of a column that is none of the {number}")
    if sum(chart.cells for chart in charts) > MAX_CELLS:
        raise BadInput(f"the charts have more than {MAX_CELLS} bins together")


def _tables(number: int, charts: Sequence[Chart], limits: Limits) -> tuple[Float32, Bool, Int, Float, Int, Int, Int]:
    """Limits [column, 2], which of them are set [column], and of each chart: axes, spans, bins, the limits it heeds."""
    bounds, is_set = np.zeros((number, 2), np.float32), np.zeros(number, np.bool_)
    for column, (lo, hi) in limits.items():
        bounds[column], is_set[column] = (_next_float32(lo, up=True), _next_float32(hi, up=False)), True
    axes = np.full((len(charts), _MAX_AXES), -1, np.int64)
    spans, bins = np.zeros((len(charts), _MAX_AXES, 2)), np.ones((len(charts), _MAX_AXES), np.int64)
    heeded = np.zeros(len(charts), np.int64)
    for k, chart in enumerate(charts):
        size = len(chart.columns)
        axes[k, :size], spans[k, :size], bins[k, :size] = chart.columns, chart.spans, chart.bins
        ignored = frozenset(chart.columns) if chart.ignored_limits is None else chart.ignored_limits
        heeded[k] = sum(1 << column for column in range(number) if column not in ignored)
    starts = np.append(0, np.cumsum([chart.cells for chart in charts])[:-1]).astype(np.int64)
    return bounds, is_set, axes, spans, bins, heeded, starts


def _next_float32(limit: float, up: bool) -> np.float32:
    """The float32 next to a limit, not below or not above it: float32 values are on the same side of both."""
    with np.errstate(over="ignore"):
        rounded = np.float32(limit)
    is_past = float(rounded) < limit if up else float(rounded) > limit
    return np.nextafter(rounded, np.float32(np.inf if up else -np.inf)) if is_past else rounded


@exact_jit
def _count_block(
    values: Float32, bounds: Float32, is_set: Bool, axes: Int, spans: Float, bins: Int, heeded: Int, starts: Int,
    counts: Int, outside: Int,
) -> None:  # fmt: skip
    """Add the rows of a block, float32[column, n], to the counts, and those outside of a chart's spans to `beyond`.

    Loops over rows have no branches, so that several are done at a time: what does not count is counted in a cell that
    is thrown away.
    """
    rows = values.shape[1]
    fails = np.zeros(rows, np.int32)
    for c in range(values.shape[0]):
        if is_set[c]:
            lo, hi, bit = bounds[c, 0], bounds[c, 1], np.int32(1 << c)
            for i in range(rows):
                fails[i] |= np.int32(0) if (values[c, i] >= lo) & (values[c, i] <= hi) else bit
    cell, out = np.empty(rows, np.int32), np.empty(rows, np.int32)
    for k in range(axes.shape[0]):
        heeded_bits, cells = np.int32(heeded[k]), np.int32(1)
        for i in range(rows):
            cell[i] = 0
            out[i] = fails[i] & heeded_bits
        for a in range(axes.shape[1]):
            c = axes[k, a]
            if c < 0:
                continue
            low, high, n = spans[k, a, 0], spans[k, a, 1], np.int32(bins[k, a])
            width, size, last = high - low, np.float64(n), np.float64(n - 1)
            for i in range(rows):
                x = np.float64(values[c, i])
                inside = (x >= low) & (x <= high)
                place = (x - low) / width * size
                place = place if place < last else last
                cell[i] = cell[i] * n + np.int32(place if inside else 0.0)
                # A missing value, and an infinite one, is nowhere.
                out[i] |= np.int32(0) if inside else (np.int32(_OUTSIDE_BIT) if abs(x) < np.inf else np.int32(1))
            cells *= n
        if cells > _SPARSE * rows:
            for i in range(rows):
                if out[i] == 0:
                    counts[starts[k] + cell[i]] += 1
                elif out[i] == _OUTSIDE_BIT:
                    outside[k] += 1
        else:
            for i in range(rows):
                cell[i] = cell[i] if out[i] == 0 else (cells + 1 if out[i] == _OUTSIDE_BIT else cells)
            block_counts = np.zeros(cells + 2, np.int32)
            for i in range(rows):
                block_counts[cell[i]] += 1
            for m in range(cells):
                counts[starts[k] + m] += block_counts[m]
            outside[k] += block_counts[cells + 1]


def points(columns: Sequence[Float32], chart: Chart, limits: Limits, max_points: int) -> tuple[Float32, int]:
    """(float32[n, axes] places of rows that count in a chart, n <= most; one row in how many was looked at).

    columns, limits : as of `counted`;  chart : which;  most : how many points at most, > 0
    All rows that count where they are no more; else rows at equal steps, the step a power of two.
    """
    ignored = frozenset(chart.columns) if chart.ignored_limits is None else chart.ignored_limits
    bounds = [(column, limit) for column, limit in limits.items() if column not in ignored]
    bounds += zip(chart.columns, chart.spans, strict=True)
    step = 1
    # Of many rows few are looked at, and more only where these are not enough.
    while len(columns[0]) > step * max_points * _ROWS_PER_POINT:
        step *= 2
    while True:
        sample = [column[::step] for column in columns]
        inside = np.ones(len(sample[0]), bool)
        for column, (low, high) in bounds:
            inside &= (sample[column] >= _next_float32(low, up=True)) & (
                sample[column] <= _next_float32(high, up=False)
            )
        indices = np.flatnonzero(inside)
        if step == 1 or 2 * len(indices) > max_points:
            break
        step //= 2
    while len(indices) > max_points:
        step *= 2
        indices = indices[indices % 2 == 0] // 2
        sample = [column[::2] for column in sample]
    return np.stack([sample[column][indices] for column in chart.columns], axis=1), step


def span(column: Float32) -> tuple[float, float]:
    """A range that holds nearly all finite values of a column, judged by some of its rows; (0, 1) where it has none.

    column : float32[n]
    """
    sample = np.asarray(column[:: max(len(column) // _SPAN_SAMPLE, 1)], float)
    sample = sample[np.isfinite(sample)]
    if not len(sample):
        return 0.0, 1.0
    lo, hi = np.quantile(sample, [_OUTSIDE, 1.0 - _OUTSIDE])
    margin = 0.02 * (hi - lo)
    lo, hi = max(lo - margin, sample.min()), min(hi + margin, sample.max())
    return (float(lo), float(hi)) if hi > lo else (float(lo) - 0.5, float(hi) + 0.5)


@dataclass(frozen=True, slots=True)
class ChartColumns:
    """Kept columns of the same rows, float32[n] each; of each its span and how many rows have no value."""

    columns: list[Float32]
    spans: list[tuple[float, float]]
    missing: list[int]


def inspect_columns(columns: Sequence[Float32]) -> ChartColumns:
    """Columns, looked at once: at every move of a brush this would take as long as counting."""
    return ChartColumns([*columns], [span(column) for column in columns], [_missing(column) for column in columns])


def _missing(column: Float32) -> int:
    """How many values are NaN or infinite."""
    pieces = (column[first : first + _PIECE] for first in range(0, len(column), _PIECE))
    return len(column) - sum(int(np.count_nonzero(np.isfinite(piece))) for piece in pieces)
