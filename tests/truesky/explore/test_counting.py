"""Counts of charts agree with DuckDB, also for missing and infinite values and values on an edge."""

import duckdb
import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lake_schema.errors import BadInput
from truesky.explore.counting import MAX_CELLS, Chart, count_rows, count_with_outside, inspect_columns, points, span

SPECIAL = [np.nan, np.inf, -np.inf, 0.0, -0.0, 1.0, 0.1, np.float32(0.3), -1.0, 3.4e38]


def rows(seed, number=20_000):
    rng = np.random.default_rng(seed)
    columns = [rng.normal(size=number).astype(np.float32) for _ in range(4)]
    for column in columns:
        column[rng.integers(number, size=200)] = rng.choice(np.array(SPECIAL, np.float32), 200)
    return columns


def by_duckdb(columns, chart, limits):
    """The slow reference: one query per chart."""
    table = pa.table({f"c{k}": pa.array(column, from_pandas=True) for k, column in enumerate(columns)})
    own = set(chart.columns) if chart.ignored_limits is None else chart.ignored_limits
    where = [f"c{k} BETWEEN {lo!r}::DOUBLE AND {hi!r}::DOUBLE" for k, (lo, hi) in limits.items() if k not in own]
    where += [
        f"c{k} BETWEEN {lo!r}::DOUBLE AND {hi!r}::DOUBLE"
        for k, (lo, hi) in zip(chart.columns, chart.spans, strict=True)
    ]
    bins = [
        f"least(floor((c{k}::DOUBLE - {lo!r}::DOUBLE) / ({hi!r}::DOUBLE - {lo!r}::DOUBLE) * {n}), {n - 1})::INT b{axis}"
        for axis, (k, (lo, hi), n) in enumerate(zip(chart.columns, chart.spans, chart.bins, strict=True))
    ]
    out = np.zeros(chart.bins, np.int64)
    with duckdb.connect() as session:
        session.register("t", table)
        text = f"SELECT {', '.join(bins)}, count(*) FROM t WHERE {' AND '.join(where)} GROUP BY ALL"
        for *place, count in session.sql(text).fetchall():
            out[tuple(place)] = count
    return out


CHARTS = [
    Chart((0,), ((-2.0, 2.0),), (100,)),
    Chart((1,), ((0.0, 1.0),), (10,)),
    Chart((2,), ((-1.0, 0.1),), (7,)),
    Chart((0, 3), ((-2.0, 2.0), (-1.0, 1.0)), (16, 9)),
    Chart((2, 3, 1), ((-2.0, 2.0), (-1.0, 1.0), (0.0, 0.3)), (4, 5, 6)),
    Chart((0, 1), ((-2.0, 2.0), (0.0, 1.0)), (5, 6), frozenset({1})),
]


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize(
    "limits", [{}, {1: (0.0, 1.0)}, {0: (-1.0, 0.1), 3: (float(np.float32(0.3)), 2.0), 2: (-9, 9)}]
)
def test_the_same_as_duckdb(limits, threads):
    columns = rows(1)
    for chart, counts in zip(CHARTS, count_rows(columns, CHARTS, limits, threads), strict=True):
        assert counts.sum() > 0
        np.testing.assert_array_equal(counts, by_duckdb(columns, chart, limits))


@given(st.lists(st.floats(width=32), max_size=30), st.integers(1, 5))
def test_every_value_counts_at_most_once(values, bins):
    column = np.array(values, np.float32)
    (counts,) = count_rows([column], [Chart((0,), ((-1.0, 1.0),), (bins,))], {})
    with np.errstate(invalid="ignore"):
        assert counts.sum() == ((column >= -1.0) & (column <= 1.0)).sum()


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("limits", [{}, {1: (0.0, 1.0)}, {0: (-1.0, 0.1), 3: (0.3, 2.0), 2: (-9, 9)}])
def test_rows_beyond_the_spans(limits, threads):
    """Rows that would count with infinite spans, for few bins and for more bins than rows."""
    columns, everything = rows(1), (-3.5e38, 3.5e38)
    grids = [*CHARTS, Chart((0, 3), ((-2.0, 2.0), (-1.0, 1.0)), (600, 700))]
    wide = [
        Chart(one.columns, (everything,) * len(one.columns), (1,) * len(one.columns), one.ignored_limits)
        for one in grids
    ]
    counts, beyond = count_with_outside(columns, grids, limits, threads)
    all_ = [int(one.sum()) for one in count_rows(columns, wide, limits)]
    assert beyond == [most - one.sum() for most, one in zip(all_, counts, strict=True)]
    assert min(beyond) > 100


def test_inspect_columns():
    columns = rows(3)
    found = inspect_columns(columns)
    assert found.missing == [int((~np.isfinite(column)).sum()) for column in columns]
    assert min(found.missing) > 0
    assert found.spans == [span(column) for column in columns]


def test_refusals():
    for axes, spans, bins in [
        ((), (), ()),
        ((0,), ((0.0, 0.0),), (5,)),
        ((0,), ((0.0, np.nan),), (5,)),
        ((0,), ((0.0, 1.0),), (0,)),
        ((0, 1), ((0.0, 1.0),), (3, 3)),
        ((0, 1), ((0.0, 1.0),) * 2, (10_000, 10_000)),
        # The products are 0 or 1 in 64 bits.
        ((0, 1), ((0.0, 1.0),) * 2, (2**40, 2**24)),
        ((0, 1), ((0.0, 1.0),) * 2, (np.int64(2**40), np.int64(2**24))),
        ((0, 1), ((0.0, 1.0),) * 2, (2**64 - 1, 2**64 - 1)),
    ]:
        with pytest.raises(BadInput):
            Chart(axes, spans, bins)
    with pytest.raises(BadInput, match="columns of equal length"):
        count_rows([np.zeros(2, np.float32), np.zeros(3, np.float32)], CHARTS[:1], {})
    column = [np.zeros(2, np.float32)]
    for charts, limits in ((CHARTS[1:2], {}), ([Chart((-1,), ((0.0, 1.0),), (3,))], {}), (CHARTS[:1], {1: (0.0, 1.0)})):
        with pytest.raises(BadInput, match="none of the 1"):
            count_rows(column, charts, limits)


def test_all_charts_share_a_bound_of_bins():
    column, wide = [np.full(3, 0.5, np.float32)], Chart((0,), ((0.0, 1.0),), (MAX_CELLS // 2,))
    assert [counts.sum() for counts in count_rows(column, [wide] * 2, {}, threads=64)] == [3, 3]
    with pytest.raises(BadInput, match="together"):
        count_rows(column, [wide] * 3, {})


def test_span():
    assert span(np.array([np.nan, np.inf], np.float32)) == (0.0, 1.0)
    assert span(np.full(5, 2.0, np.float32)) == (1.5, 2.5)
    lo, hi = span(rows(2)[0])
    assert -6.0 < lo < -2.0
    assert 2.0 < hi < 6.0


@pytest.mark.parametrize("limits", [{}, {2: (-0.5, 0.3), 0: (0.0, 3.0)}, {3: (9.0, 9.1)}])
@pytest.mark.parametrize("most", [1, 100, 5_000, 10**6])
def test_points_are_rows_that_count(limits, most):
    """Sample of 100,000 rows; significance 2e-9 for the estimated number of rows (6 standard errors)."""
    columns = rows(4, 100_000)
    chart = Chart((0, 1), ((-1.0, 1.0), (0.0, 0.3)), (1, 1))
    places, step = points(columns, chart, limits, most)
    (((total,),),) = count_rows(columns, [chart], limits)
    assert places.shape[1] == 2
    assert len(places) <= most
    found = {tuple(place) for place in places.tolist()}
    assert found <= {*zip(columns[0].tolist(), columns[1].tolist(), strict=True)}
    if total <= most:
        # If there is room for all points, all are returned.
        assert (len(places), step) == (total, 1)
    else:
        # Their number times the step estimates the number of rows.
        assert len(places) * step == pytest.approx(total, abs=6 * np.sqrt(total * step))
