"""Count rows for several linked histograms (charts) in one pass; limits set in one chart select rows in the others.

A chart is a grid of bins in one to three columns. A row counts in a chart if it lies in the ranges of the chart's axes
and within the limits of all other columns. Limits of the columns on the axes are ignored, unless the chart declares
otherwise. Missing values (NaN) are in no bin and within no limits.
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

# Number of rows that are counted at a time. A few columns of this length fit into the cache of a processor.
_BLOCK = 32768
# Largest number of columns that can be counted together: each column needs a bit of an int32.
_MAX_COLUMNS = 30
# Largest number of bins of all charts (histograms) together.
MAX_CELLS = 8_000_000
_MAX_AXES = 3
# Largest number of bins in all threads together (128 MB). Each thread counts in its own copy of the bins of all charts.
_MAX_COUNTS = 2 * MAX_CELLS
# Rows of a block are usually counted in separate bins, which are then added to those of the chart. If a chart has more
# than this number of bins per row of the block, rows are counted in its own bins, because adding would take longer.
_SPARSE = 4
# The default range of an axis is estimated from every n-th value. n is the largest integer that leaves this number of
# values or more.
_SPAN_SAMPLE = 200_000
# Fraction of the values that the default range of an axis cuts off at each end.
_OUTSIDE = 2e-3
# `points` first examines this number of rows per requested point.
_ROWS_PER_POINT = 8

# Number of values that `_missing` examines at a time, so that it needs little memory.
_PIECE = 1 << 22
# Each row has a bit field: bit c is set if the row violates the limits of column c. The bit _OUTSIDE_BIT is set if a
# finite value of the row lies outside the range of an axis of the chart.
_OUTSIDE_BIT = 1 << _MAX_COLUMNS

Limits = Mapping[int, tuple[float, float]]


@dataclass(frozen=True, slots=True)
class Chart:
    """Definition of a histogram with one to three axes and bins of equal width.

    BadInput is raised if there are no axes or more than three, a range is empty or not finite, or the number of bins is
    below 1 or above 8 million.

    Attributes
    ----------
    columns : tuple of int
        Index of the column on each axis.
    spans : tuple of (float, float)
        Range of each axis: lowest and highest value, both included.
    bins : tuple of int
        Number of bins of each axis.
    ignored_limits : frozenset of int, optional
        Indices of the columns whose limits do not apply to this chart; by default the columns on its axes.
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
        """Total number of bins: the product of the numbers of bins of the axes."""
        # Convert to Python integers, which have any size; a product of 64-bit integers could overflow to a small one.
        return math.prod(int(bins) for bins in self.bins)


def count_rows(columns: Sequence[Float32], charts: Sequence[Chart], limits: Limits, threads: int = 1) -> list[Int]:
    """Count the rows in each bin of several charts (histograms) in one pass.

    Parameters
    ----------
    columns : sequence of float32 arrays, shape (n,)
        Values of 1 to 30 columns for the same rows.
    charts : sequence of Chart
        Histograms to compute.
    limits : mapping of int to (float, float)
        Lowest and highest value, both included, that select rows, by index of the column. A chart ignores the limits of
        the columns on its axes by default.
    threads : int, optional
        Number of threads; fewer are used if their counts would need more than 128 MB.

    Returns
    -------
    list of int arrays, shape (bins of the first axis, bins of the second axis, ...)
        Number of rows in each bin, one array per chart.

    Notes
    -----
    BadInput is raised if there are no columns, more than 30, or columns of different lengths; if a chart or a limit
    refers to a column that does not exist; or if the charts have more than 8 million bins together.
    """
    return count_with_outside(columns, charts, limits, threads)[0]


def count_with_outside(
    columns: Sequence[Float32], charts: Sequence[Chart], limits: Limits, threads: int = 1
) -> tuple[list[Int], list[int]]:
    """Count the rows in each bin of several charts (histograms), and the rows outside their axes, in one pass.

    Parameters
    ----------
    columns : sequence of float32 arrays, shape (n,)
        Values of 1 to 30 columns for the same rows.
    charts : sequence of Chart
        Histograms to compute.
    limits : mapping of int to (float, float)
        Lowest and highest value, both included, that select rows, by index of the column. A chart ignores the limits of
        the columns on its axes by default.
    threads : int, optional
        Number of threads; fewer are used if their counts would need more than 128 MB.

    Returns
    -------
    counts : list of int arrays
        Number of rows in each bin, one array per chart with one dimension per axis.
    outside : list of int
        For each chart, number of rows within the limits whose values on the axes are all finite, but at least one of
        them is outside the range of its axis.

    Raises
    ------
    BadInput
        If there are no columns, more than 30, or columns of different lengths; if a chart or a limit refers to a column
        that does not exist; or if the charts have more than 8 million bins together.
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
        # One array holds the counts of all bins of all charts, and then the number of rows outside each chart's axes.
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
    """Raise BadInput if a chart or a limit refers to a column that does not exist, or there are too many bins.

    `number` is the number of columns. The check is necessary because the compiled loops do not check array bounds.
    """
    if any(not 0 <= column < number for column in [*limits, *(c for chart in charts for c in chart.columns)]):
        raise BadInput(f"a chart or a limit refers to a column that is none of the {number}")
    if sum(chart.cells for chart in charts) > MAX_CELLS:
        raise BadInput(f"the charts have more than {MAX_CELLS} bins together")


def _tables(number: int, charts: Sequence[Chart], limits: Limits) -> tuple[Float32, Bool, Int, Float, Int, Int, Int]:
    """Return the limits and the charts as arrays, for the compiled function `_count_block`.

    `number` is the number of columns. The arrays are: limits (column, 2); True if a column has limits (column,);
    columns on the axes (chart, axis), -1 for missing axes; ranges of the axes (chart, axis, 2); numbers of bins (chart,
    axis); bits of the columns whose limits apply (chart,); position of the chart's first bin in the counts (chart,).
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
    """Round a limit to float32: up to the next number that is not below the limit, or down to one not above it.

    A float32 value is within the rounded limit exactly if it is within the original one.
    """
    with np.errstate(over="ignore"):
        rounded = np.float32(limit)
    is_past = float(rounded) < limit if up else float(rounded) > limit
    return np.nextafter(rounded, np.float32(np.inf if up else -np.inf)) if is_past else rounded


@exact_jit
def _count_block(
    values: Float32, bounds: Float32, is_set: Bool, axes: Int, spans: Float, bins: Int, heeded: Int, starts: Int,
    counts: Int, outside: Int,
) -> None:  # fmt: skip
    """Add the rows in `values`, shape (column, n), to the arrays `counts` and `outside`.

    `counts` holds the numbers of rows in the bins of all charts, one chart after another. `outside` holds the number of
    rows outside each chart's axes. The function `_tables` makes the arrays from `bounds` to `starts`. Most loops over
    rows have no branches, so that the compiler can vectorise them. Rows that do not count are therefore added to an
    extra bin, which is discarded.
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
                # Rows with a NaN or infinite value on an axis are counted neither in a bin nor as outside.
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
    """Return the rows in a chart as points for a scatter plot, at most `max_points`.

    If the chart may contain more rows, only every `step`-th row of the table is used; the step is a power of two. It is
    chosen so that more than half of `max_points` are usually returned.

    Parameters
    ----------
    columns : sequence of float32 arrays, shape (n,)
        Values of the columns for the same rows.
    chart : Chart
        Chart with the columns and the ranges of the axes; its numbers of bins are not used.
    limits : mapping of int to (float, float)
        Lowest and highest value, both included, that select rows, by index of the column. The chart ignores the limits
        of the columns on its axes by default. Indices in `chart` and `limits` are not checked.
    max_points : int
        Largest number of points, at least 1; this is not checked.

    Returns
    -------
    positions : float32 array, shape (m, axes)
        Values of the chart's columns for each point; m is 0 if no row counts.
    step : int
        Distance of the examined rows in the table: rows 0, step, 2 step and so on were examined; 1 means all rows.
    """
    ignored = frozenset(chart.columns) if chart.ignored_limits is None else chart.ignored_limits
    bounds = [(column, limit) for column, limit in limits.items() if column not in ignored]
    bounds += zip(chart.columns, chart.spans, strict=True)
    step = 1
    # A few rows of a large table are examined first. The step is halved until more than half of the points are found.
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
    """Return the range (lowest, highest) of an axis that shows nearly all finite values of a column.

    It is estimated from 200,000 to 400,000 evenly spaced values, or from all if there are fewer. 0.2 % of them are cut
    off at each end, and then a margin of 2 % of the range is added, but not beyond their extremes. The range is 1 wide
    if its ends are equal. The result is (0, 1) if no value is finite.
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
    """Columns of the same rows, with default ranges of axes and numbers of missing values.

    Attributes
    ----------
    columns : list of float32 arrays, shape (n,)
        Values of each column.
    spans : list of (float, float)
        Range that contains nearly all finite values of each column, see `span`.
    missing : list of int
        Number of values of each column that are NaN or infinite.
    """

    columns: list[Float32]
    spans: list[tuple[float, float]]
    missing: list[int]


def inspect_columns(columns: Sequence[Float32]) -> ChartColumns:
    """Return columns with their default ranges of axes and their numbers of NaN or infinite values.

    Call this once per set of columns, since it takes as long as counting a chart.
    """
    return ChartColumns([*columns], [span(column) for column in columns], [_missing(column) for column in columns])


def _missing(column: Float32) -> int:
    """Return the number of values that are NaN or infinite."""
    pieces = (column[first : first + _PIECE] for first in range(0, len(column), _PIECE))
    return len(column) - sum(int(np.count_nonzero(np.isfinite(piece))) for piece in pieces)
