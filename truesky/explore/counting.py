"""Count many rows for several linked charts at once; limits set in one chart apply to the others.

A row counts in a chart if it lies within the limits of every column, except those on the chart's axes, and within
the spans of the chart. Missing values (NaN) are in no bin and within no limits.
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

# Number of rows per block; a few columns of a block fit into the cache of a processor.
_BLOCK = 32768
_MAX_COLUMNS, MAX_CELLS = 30, 8_000_000
_MAX_AXES = 3
# Largest number of counts of all threads together: 128 MB.
_MAX_COUNTS = 2 * MAX_CELLS
# A grid with more cells per row of a block than this is counted in directly.
_SPARSE = 4
# Number of rows from which a span is estimated, and the fraction that may lie outside on each side.
_SPAN_SAMPLE, _OUTSIDE = 200_000, 2e-3
# Initial number of rows that are examined per point.
_ROWS_PER_POINT = 8

# Number of values that are checked for missing ones at a time.
_PIECE = 1 << 22
# Bit of a row that has values on all axes but lies outside of the spans; lower bits are for the columns.
_OUTSIDE_BIT = 1 << _MAX_COLUMNS

Limits = Mapping[int, tuple[float, float]]


@dataclass(frozen=True, slots=True)
class Chart:
    """Counts in a grid of equal bins.

    Attributes
    ----------
    columns : tuple of int
        Numbers of the columns along its axes, one to three.
    spans : tuple of (float, float)
        Lowest and highest value of each axis.
    bins : tuple of int
        Number of bins of each axis.
    ignored_limits : frozenset of int, optional
        Columns whose limits do not apply to this chart; by default those of its axes.
    """

    columns: tuple[int, ...]
    spans: tuple[tuple[float, float], ...]
    bins: tuple[int, ...]
    ignored_limits: frozenset[int] | None = None

    def __post_init__(self) -> None:
        if not 1 <= len(self.columns) == len(self.spans) == len(self.bins) <= _MAX_AXES:
            raise BadInput("a chart has one to three axes, each with a span and a number of bins")
        if not all(np.isfinite([lo, hi]).all() and lo < hi for lo, hi in self.spans):
            raise BadInput(f"spans must be from a finite number to a larger one, got {self.spans}")
        if not (min(self.bins) >= 1 and self.cells <= MAX_CELLS):
            raise BadInput(f"bins must be at least 1 per axis and at most {MAX_CELLS} in total, got {self.bins}")

    @property
    def cells(self) -> int:
        """Total number of bins."""
        # Python integers have any size; a 64-bit product could wrap around to a small number.
        return math.prod(int(bins) for bins in self.bins)


def count_rows(columns: Sequence[Float32], charts: Sequence[Chart], limits: Limits, threads: int = 1) -> list[Int]:
    """Count rows for several charts in one pass.

    Parameters
    ----------
    columns : sequence of float32 arrays, shape (n,)
        Columns.
    charts : sequence of Chart
        Charts to count.
    limits : mapping of int to (float, float)
        Lowest and highest value, both included, by number of the column.
    threads : int
        Number of threads; fewer are used if their counts would need much memory.

    Returns
    -------
    list of int arrays, shape (bins of the first axis, bins of the second axis, ...)
        Counts of each chart.
    """
    return count_with_outside(columns, charts, limits, threads)[0]


def count_with_outside(
    columns: Sequence[Float32], charts: Sequence[Chart], limits: Limits, threads: int = 1
) -> tuple[list[Int], list[int]]:
    """Count rows for several charts, and rows outside of their spans, in one pass.

    Parameters
    ----------
    columns : sequence of float32 arrays, shape (n,)
        Columns.
    charts : sequence of Chart
        Charts to count.
    limits : mapping of int to (float, float)
        Lowest and highest value, both included, by number of the column.
    threads : int
        Number of threads; fewer are used if their counts would need much memory.

    Returns
    -------
    counts : list of int arrays
        Counts of each chart, see `count_rows`.
    outside : list of int
        For each chart, rows within the limits that have a finite value on every axis and lie outside of a span.

    Raises
    ------
    BadInput
        If the number of columns is wrong, a number of a column does not exist, or there are too many bins.
    """
    if not 1 <= len(columns) <= _MAX_COLUMNS or len({len(column) for column in columns}) != 1:
        raise BadInput(f"counting requires 1 to {_MAX_COLUMNS} columns of equal length")
    _check(len(columns), charts, limits)
    tables = _tables(len(columns), charts, limits)
    rows = len(columns[0])
    threads = max(1, min(threads, _MAX_COUNTS // max(1, sum(chart.cells for chart in charts))))
    edges = np.linspace(0, rows, threads + 1).astype(np.int64)

    cells = sum(chart.cells for chart in charts)

    def count_part(number: int) -> Int:
        # The numbers of rows outside of each chart's spans follow the counts.
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
    """Refuse numbers that would lead compiled loops outside of their arrays, since they do not check bounds."""
    if any(not 0 <= column < number for column in [*limits, *(c for chart in charts for c in chart.columns)]):
        raise BadInput(f"a chart or a limit refers to a column that is none of the {number}")
    if sum(chart.cells for chart in charts) > MAX_CELLS:
        raise BadInput(f"the charts have more than {MAX_CELLS} bins together")


def _tables(number: int, charts: Sequence[Chart], limits: Limits) -> tuple[Float32, Bool, Int, Float, Int, Int, Int]:
    """Arrays for the compiled loops: limits of columns, which of them are set, and properties of each chart.

    They have the shapes (column, 2), (column,), and (chart, axis, ...) for axes, spans, bins, limits that apply and
    starts.
    """
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
    """Nearest float32 that is not below (up) or not above a limit; float32 values compare the same with both."""
    with np.errstate(over="ignore"):
        rounded = np.float32(limit)
    is_past = float(rounded) < limit if up else float(rounded) > limit
    return np.nextafter(rounded, np.float32(np.inf if up else -np.inf)) if is_past else rounded


@exact_jit
def _count_block(
    values: Float32, bounds: Float32, is_set: Bool, axes: Int, spans: Float, bins: Int, heeded: Int, starts: Int,
    counts: Int, outside: Int,
) -> None:  # fmt: skip
    """Add the rows of a block, shape (column, n), to the counts and to the numbers of rows outside of the spans.

    Loops over rows have no branches, so that the compiler can vectorise them. Rows that do not count are added to an
    extra cell, which is discarded.
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
                # Missing and infinite values are not counted anywhere.
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
    """Return the positions of rows that count in a chart, at most `max_points`.

    If more rows count, rows at equal steps are returned; the step is a power of two.

    Parameters
    ----------
    columns : sequence of float32 arrays, shape (n,)
        Columns.
    chart : Chart
        The chart.
    limits : mapping of int to (float, float)
        Lowest and highest value, both included, by number of the column.
    max_points : int
        Largest number of points, at least 1.

    Returns
    -------
    positions : float32 array, shape (m, axes)
        Values on the axes of the chart.
    step : int
        One row in this number was examined.
    """
    ignored = frozenset(chart.columns) if chart.ignored_limits is None else chart.ignored_limits
    bounds = [(column, limit) for column, limit in limits.items() if column not in ignored]
    bounds += zip(chart.columns, chart.spans, strict=True)
    step = 1
    # Few rows of a large table are examined at first, and more only if these are not enough.
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
    """Return a range that contains nearly all finite values of a column, from a sample; (0, 1) if there are none."""
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
    """Columns of the same rows with their properties.

    Attributes
    ----------
    columns : list of float32 arrays, shape (n,)
        Columns.
    spans : list of (float, float)
        Range that contains nearly all values of each column.
    missing : list of int
        Number of rows without a finite value, for each column.
    """

    columns: list[Float32]
    spans: list[tuple[float, float]]
    missing: list[int]


def inspect_columns(columns: Sequence[Float32]) -> ChartColumns:
    """Determine the spans and missing values of columns once; this takes as long as counting."""
    return ChartColumns([*columns], [span(column) for column in columns], [_missing(column) for column in columns])


def _missing(column: Float32) -> int:
    """Number of values that are NaN or infinite."""
    pieces = (column[first : first + _PIECE] for first in range(0, len(column), _PIECE))
    return len(column) - sum(int(np.count_nonzero(np.isfinite(piece))) for piece in pieces)
