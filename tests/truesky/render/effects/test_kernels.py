"""The effects' kernels: statistics, limits, and that none writes its argument."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy import stats

from lake_schema.errors import OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.effects import pixel_random
from truesky.render.effects.charge import dark_current, poisson
from truesky.render.effects.light import background
from truesky.render.effects.readout import adc, read_noise

SIDE = 400
FRAMES = hnp.arrays(float, (4, 5), elements=st.floats(-10, 1e12))


def rng():
    return np.random.default_rng(7)


@given(FRAMES)
def test_no_kernel_writes_its_argument_or_loses_a_number(frame):
    before = frame.copy()
    calls = (
        lambda: background.apply(frame, 120.0),
        lambda: poisson.apply(frame, rng=rng()),
        lambda: dark_current.apply(frame, 0.3, rng=rng()),
        lambda: read_noise.apply(frame, 4.4, rng=rng()),
        lambda: adc.apply(frame, 3.48, 1000.0, 65535.0),
    )
    for call in calls:
        after = call()
        assert after.shape == frame.shape
        assert np.isfinite(after).all()
        np.testing.assert_array_equal(frame, before)


@pytest.mark.parametrize("mean", [0.0, 0.3, 130.0, 1e6, 3e9])
def test_shot_noise(mean):
    """Sample of 160,000 pixels; significance 6e-7 of the mean and of the variance (5 standard errors)."""
    counted = poisson.apply(np.full((SIDE, SIDE), mean), rng=rng())
    assert (counted == np.rint(counted)).all()
    assert (counted >= 0).all()
    assert counted.mean() == pytest.approx(mean, abs=5 * np.sqrt(mean) / SIDE)
    assert counted.var() == pytest.approx(mean, rel=5 * np.sqrt(2) / SIDE + (mean == 0.3) * 0.01)


def test_a_pixel_s_noise_is_its_own():
    mean = np.geomspace(0.1, 3e9, 400).reshape(20, 20)
    changed = mean.copy()
    changed[5, 7] *= 3.0
    same = poisson.apply(mean, rng=rng()) == poisson.apply(changed, rng=rng())
    assert list(zip(*np.nonzero(~same), strict=True)) == [(5, 7)]


@pytest.mark.parametrize("mean", [0.5, 7.0, 12.0, 130.0])
def test_counts_are_distributed_as_poisson_s_law_says(mean):
    """Sample of 160,000 pixels; significance 1e-3 of the law (chi^2), 6e-7 of the rare counts (5 standard errors)."""
    counted = poisson.apply(np.full(SIDE**2, mean), rng=rng())
    found = np.bincount(counted.astype(int), minlength=400)
    expected = stats.poisson.pmf(np.arange(len(found)), mean) * counted.size
    often = expected > 20
    chi2 = ((found - expected)[often] ** 2 / expected[often]).sum()
    assert stats.chi2.sf(chi2, often.sum() - 1) > 1e-3
    rare = expected[~often].sum()
    assert abs(found[~often].sum() - rare) < 5 * np.sqrt(rare) + 1


@jit
def drawn(means, key):
    """Return counts that are drawn pixel by pixel, without blocks."""
    counts = np.empty(len(means))
    for i in range(len(means)):
        p_zero = np.exp(-means[i]) if means[i] < 10.0 else 0.0
        counts[i] = poisson.draw_count(means[i], p_zero, pixel_random.pixel_bits(key, i))
    return counts


@pytest.mark.parametrize("least", [0.01, 10.0, 300.0])
def test_counts_of_blocks_of_pixels_are_those_of_each_pixel(least):
    means = least * np.random.default_rng(3).uniform(1.0, 1e3, 100_001)
    found = poisson.apply(means, rng=rng())
    np.testing.assert_array_equal(found, drawn(means, pixel_random.draw_key(rng())))


def test_negative_expectations_count_nothing():
    assert (poisson.apply(np.full((5, 5), -3.0), rng=rng()) == 0).all()


@pytest.mark.parametrize("mean", [0.0, 0.3, 50.0])
def test_dark_current_is_counted(mean):
    """Sample of 160,000 pixels; significance 6e-7 of the mean (5 standard errors)."""
    extra = dark_current.apply(np.full((SIDE, SIDE), 2.5), mean, rng=rng()) - 2.5
    assert (extra == np.rint(extra)).all()
    assert extra.mean() == pytest.approx(mean, abs=5 * np.sqrt(mean) / SIDE)
    assert extra.var() == pytest.approx(mean, rel=0.03)


def test_read_noise_is_gaussian():
    """Sample of 160,000 pixels; significance 2e-8 of the width (1 %), 5e-8 of the mean (0.06 e-)."""
    noise = read_noise.apply(np.zeros((SIDE, SIDE)), 4.4, rng=rng())
    assert noise.std() == pytest.approx(4.4, rel=0.01)
    assert noise.mean() == pytest.approx(0, abs=0.06)
    assert (np.abs(noise) > 2 * 4.4).mean() == pytest.approx(0.0455, abs=0.003)


@given(st.floats(-1e4, 1e7), st.floats(0.1, 10), st.floats(0, 2000))
def test_conversion(electrons, gain, bias):
    (adu,) = adc.apply(np.array([[electrons]]), gain, bias, 65535.0).ravel()
    assert 0 <= adu <= 65535
    assert adu == int(adu)
    exact = electrons / gain + bias
    if 0 <= exact <= 65535:
        assert abs(adu - exact) <= 0.5


def test_conversion_rounds_halves_up_and_saturates():
    found = adc.apply(np.array([[0.5, 1.5, -0.5, -1e9, 1e9]]), 1.0, 0.0, 65535.0)
    np.testing.assert_array_equal(found, [[1, 2, 0, 0, 65535]])


@pytest.mark.parametrize(
    ("call", "name"),
    [
        (lambda x: background.apply(x, -1.0), "sky"),
        (lambda x: background.apply(x, float("nan")), "sky"),
        (lambda x: dark_current.apply(x, -1.0, rng=rng()), "dark"),
        (lambda x: read_noise.apply(x, -1.0, rng=rng()), "read noise"),
        (lambda x: adc.apply(x, 0.0, 0.0, 1.0), "gain"),
        (lambda x: adc.apply(x, float("inf"), 0.0, 1.0), "gain"),
    ],
)
def test_unphysical_numbers_are_refused_by_name(call, name):
    with pytest.raises(OutOfRange, match=name):
        call(np.zeros((2, 2)))
