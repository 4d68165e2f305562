"""Tests of damped random walks: law, independence of the dates, and refused arguments."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lake_schema.errors import BadInput, OutOfRange
from truesky.randomness import compiled_draws, per_source
from truesky.variability import damped_random_walk as walks

_N = 40_000


def _keys(n: int, name: str = "test") -> np.ndarray:
    return per_source.keys(np.arange(n), 7, name)


def _slow_values(key: np.uint64, tau: float, mjd: float) -> float:
    """Return one value by recursion with numpy, without the shared path of successive dates."""

    def draw(number: int) -> float:
        out = np.empty(1)
        compiled_draws.normals(np.array([key]), number, out)
        return float(out[0])

    n_0, n_1 = draw(0), draw(1)
    rho = np.exp(-walks.LENGTH / tau)
    ends, start, length, node = (n_0, rho * n_0 + np.sqrt(1.0 - rho**2) * n_1), walks.FIRST_MJD, walks.LENGTH, 1
    while length > walks.RESOLUTION:
        half = 0.5 * length
        r, whole = np.exp(-half / tau), np.exp(-length / tau)
        # Regression of the middle on both ends, from the covariance of three values.
        weight = r / (1.0 + whole)
        middle = weight * sum(ends) + np.sqrt(1.0 - 2.0 * weight * r) * draw(node + 1)
        later = mjd >= start + half
        ends, start = ((middle, ends[1]), start + half) if later else ((ends[0], middle), start)
        length, node = half, 2 * node + int(later)
    part = (mjd - start) / length
    return float((1.0 - part) * ends[0] + part * ends[1])


@given(st.floats(walks.FIRST_MJD, walks.LAST_MJD), st.floats(30.0, 1e4), st.integers(0, 1000))
@settings(max_examples=30)
def test_agrees_with_the_recursion_by_covariances(mjd: float, tau: float, source: int) -> None:
    """The formulas with cosh and tanh are the regression on the two ends; the shortest variances lose 8 digits."""
    key = per_source.keys(np.array([source]), 3, "test")
    fast = walks.values(key, tau, mjd)
    assert fast[0] == pytest.approx(_slow_values(key[0], tau, mjd), abs=2e-5)


@given(st.lists(st.floats(55000.0, 65000.0), min_size=1, max_size=20), st.integers(0, 19))
@settings(max_examples=30)
def test_a_value_does_not_depend_on_other_dates_and_sources(dates: list[float], which: int) -> None:
    """The bits are equal for a date alone and in any list, for a source alone and among others."""
    which %= len(dates)
    keys = _keys(3)
    together = walks.values(keys, 200.0, np.array(dates))
    assert together.shape == (3, len(dates))
    assert walks.values(keys[1:2], 200.0, dates[which])[0] == together[1, which]
    each = walks.values(keys, 200.0, np.broadcast_to(np.array(dates), (3, len(dates))))
    np.testing.assert_array_equal(each, together)


@pytest.mark.parametrize("tau", [5.0, 200.0, 1500.0])
def test_structure_function_is_that_of_the_law(tau: float) -> None:
    """sqrt(1 - exp(-dt / tau)) for 1 to 1000 days, from dates on both sides of a large node.

    Sample: 40,000 independent walks, one pair of dates for each lag. Significance: the mean square has the relative
    standard deviation sqrt(2 / 40,000) = 0.7 %; 4.5 of them are allowed (1e-5 for each of the 18 numbers).
    """
    middle = walks.FIRST_MJD + 0.375 * walks.LENGTH
    lags = np.array([1.0, 10.0, 30.0, 100.0, 300.0, 1000.0])
    dates = np.concatenate([[middle - 0.3], middle - 0.3 + lags])
    x = walks.values(_keys(_N), tau, dates)
    mean_square = ((x[:, 1:] - x[:, :1]) ** 2).mean(0)
    assert mean_square == pytest.approx(2.0 * (1.0 - np.exp(-lags / tau)), rel=4.5 * np.sqrt(2.0 / _N))


def test_covariance_of_irregular_dates_is_exponential() -> None:
    """All pairs of 11 dates, tau = 300 days.

    Sample: 40,000 walks. Significance: a mean product has a standard deviation of at most sqrt(2 / 40,000); 4.8 of
    them are allowed, 1.6e-6 for each of the 66 numbers.
    """
    dates = np.array(
        [60000.0, 60000.02, 60003.7, 60050.1, 60111.0, 60400.3, 61000.0, 58000.9, 65536.0, 65535.9, 4e4, 9e4]
    )
    x = walks.values(_keys(_N), 300.0, dates)
    measured = np.array([[(x[:, i] * x[:, j]).mean() for i in range(dates.size)] for j in range(dates.size)])
    expected = np.exp(-np.abs(dates[:, None] - dates) / 300.0)
    assert measured == pytest.approx(expected, abs=4.8 * np.sqrt(2.0 / _N))


def test_values_are_normal() -> None:
    """First four moments at one date between two nodes.

    Sample: 40,000 walks. Significance: 4.5 standard deviations for each moment, sqrt(1, 2, 15, 96 / 40,000).
    """
    x = walks.values(_keys(_N), 150.0, 61234.567)
    moments = [(x**order).mean() for order in (1, 2, 3, 4)]
    limits = 4.5 * np.sqrt(np.array([1.0, 2.0, 15.0, 96.0]) / _N)
    assert (np.abs(np.array(moments) - [0.0, 1.0, 0.0, 3.0]) < limits).all()


def test_two_bands_of_a_source_are_strongly_correlated() -> None:
    """g and i of a quasar at z = 1 differ by 8 % in tau: correlation above 0.99, and each has its own law.

    Sample: 40,000 walks. Significance: the scatter of the correlation is below 1e-4, 100 times less than the margin.
    """
    keys, tau_g = _keys(_N), 400.0
    tau_i = tau_g * (7620.0 / 4770.0) ** 0.17
    lag = np.array([60000.0, 60200.0])
    g, i = walks.values(keys, tau_g, lag), walks.values(keys, tau_i, lag)
    assert 0.99 < (g[:, 0] * i[:, 0]).mean() < 1.02
    for x, tau in ((g, tau_g), (i, tau_i)):
        square = ((x[:, 1] - x[:, 0]) ** 2).mean()
        assert square == pytest.approx(2.0 * (1.0 - np.exp(-200.0 / tau)), rel=4.5 * np.sqrt(2.0 / _N))


@pytest.mark.parametrize("mjd", [32767.9, 98304.1, np.nan])
def test_dates_outside_are_refused(mjd: float) -> None:
    with pytest.raises(OutOfRange, match="mjd"):
        walks.values(_keys(1), 100.0, np.array([60000.0, mjd]))


@pytest.mark.parametrize("tau", [0.0, -1.0, np.inf, np.nan])
def test_impossible_time_scales_are_refused(tau: float) -> None:
    with pytest.raises(BadInput, match="tau"):
        walks.values(_keys(1), tau, 60000.0)


def test_ends_of_the_interval_are_inside() -> None:
    assert np.isfinite(walks.values(_keys(2), 100.0, np.array([walks.FIRST_MJD, walks.LAST_MJD]))).all()
