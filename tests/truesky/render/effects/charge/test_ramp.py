"""Ramps: the law of the groups against counts of every frame drawn with numpy; hits, full well and nonlinearity."""

import numpy as np
import pytest
from scipy import stats

from lake_schema.errors import BadInput, OutOfRange
from truesky.render.effects.charge import ramp
from truesky.render.effects.readout import macc

PHOTOMETRIC, SPECTROSCOPIC = ramp.Mode(4, 16, 4), ramp.Mode(15, 16, 11)
FRAME_TIME, READ_NOISE = 1.454, 13.0


def every_frame(mode, per_frame, count, rng, charge=0.0, moment=0.0, bend=0.0, full=130_000.0):
    """Draw groups (groups, count) by their definition: a count per frame.

    `charge` and `moment` are of a cosmic ray in each pixel. `bend` is b of the nonlinearity, and `full` the full well.
    """
    held = np.cumsum(rng.poisson(per_frame, (count, mode.frames)).astype(np.float32), axis=1)
    hit = np.arange(mode.frames) >= np.floor(np.reshape(moment, (-1, 1)) * mode.frames)
    held = np.minimum(held + hit * np.reshape(charge, (-1, 1)), full)
    seen = held * (1.0 - np.reshape(bend, (-1, 1)) * held)
    starts = np.arange(mode.groups) * (mode.reads + mode.drops)
    return np.array([seen[:, start : start + mode.reads].mean(axis=1) for start in starts])


def fast(mode, per_frame, count, rng, **more):
    light = np.full((1, count), per_frame * mode.integration_frames)
    return ramp.apply(light, mode, 130_000.0, **more, rng=rng)[:, 0]


def read(groups, mode, rng):
    noisy = groups + rng.normal(0.0, READ_NOISE / np.sqrt(mode.reads), groups.shape)
    return macc.apply(noisy[:, None, :], mode, READ_NOISE, rng)[:, 0]


def test_modes():
    assert (PHOTOMETRIC.frames, SPECTROSCOPIC.frames) == (76, 394)
    assert PHOTOMETRIC.integration_frames * FRAME_TIME == pytest.approx(87.2, abs=0.05)
    assert SPECTROSCOPIC.integration_frames * FRAME_TIME == pytest.approx(549.6, abs=0.05)
    assert (PHOTOMETRIC.alpha, SPECTROSCOPIC.alpha) == (-0.265625, pytest.approx(-0.196759, abs=1e-6))
    assert PHOTOMETRIC.third_moments() == pytest.approx((52.03, 24.06, 12.52), abs=0.005)
    assert SPECTROSCOPIC.third_moments() == pytest.approx((370.03, 274.54, 217.16), abs=0.005)


@pytest.mark.parametrize("mode", [PHOTOMETRIC, SPECTROSCOPIC, ramp.Mode(2, 1, 0), ramp.Mode(30, 1, 0)], ids=str)
def test_moments_of_the_groups(mode):
    """Means and covariances of all groups, as sums of independent counts have them.

    Sample of 40,000 pixels; significance 7e-6 of each moment (4.5 standard errors).
    """
    weights, count, per_frame = mode.weights(), 40_000, 2.0
    groups = fast(mode, per_frame, count, np.random.default_rng(1)).astype(float)
    first = np.clip(mode.reads - np.arange(mode.frames), 0, mode.reads) / mode.reads
    everything = np.cumsum(np.vstack([first, weights]), axis=0)
    expected = per_frame * everything @ everything.T
    sd = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(groups.mean(axis=1), per_frame * everything.sum(axis=1), atol=4.5 * sd.max() / 200)
    error = (np.cov(groups) - expected) / np.outer(sd, sd)
    assert np.abs(error).max() < 4.5 * np.sqrt(2.0 / count)


RATES = [(PHOTOMETRIC, rate) for rate in (0.02, 0.3, 1.5, 5.0, 10.0)]
RATES += [(SPECTROSCOPIC, rate) for rate in (0.02, 0.3, 1.5, 3.0, 5.0)]


# By day the lowest and the highest of short ramps, and one between them of long ramps.
SOME = [
    pytest.param(*case, marks=[] if case[1] in {4: (0.02, 10.0), 15: (1.5,)}[case[0].groups] else pytest.mark.nightly)
    for case in RATES
]


@pytest.mark.parametrize(("mode", "rate"), SOME, ids=lambda x: str(x))
def test_law_of_signal_and_quality(mode, rate):
    """The sample is short: the standard error of the width is 0.5 %."""
    hold_together(mode, rate, 30_000, 60_000, 0.015)


@pytest.mark.nightly
@pytest.mark.parametrize(("mode", "rate"), RATES, ids=lambda x: str(x))
def test_law_of_signal_and_quality_of_many(mode, rate):
    """Standard error of the width: 0.3 %."""
    hold_together(mode, rate, 60_000, 240_000, 0.01)


def hold_together(mode, rate, slow_count, count, width):
    """rate : e-/s.  Two samples: Kolmogorov-Smirnov, significance 1 %; the width of the signal; chi^2 within 2 %."""
    rng = np.random.default_rng(int(100 * rate) + mode.groups)
    slow = read(every_frame(mode, rate * FRAME_TIME, slow_count, rng), mode, rng)
    quick = read(fast(mode, rate * FRAME_TIME, count, rng), mode, rng)
    for i in range(2):
        assert stats.ks_2samp(slow[i], quick[i]).pvalue > 0.01
    assert quick[0].std() == pytest.approx(slow[0].std(), rel=width)
    assert quick[1].mean() == pytest.approx(slow[1].mean(), rel=0.02)
    assert np.corrcoef(quick)[0, 1] == pytest.approx(np.corrcoef(slow)[0, 1], abs=0.02)


def pixels(mode, count, rng, electrons, charge=0.0, bend=0.0):
    """Signal and quality [2, 2, count], of the slow law and of ours; electrons : at the end of the ramp."""
    per_frame, moment = electrons / mode.frames, rng.random(count)
    slow = every_frame(mode, per_frame, count, rng, charge, moment, bend)
    frame = np.array(
        [np.full(count, per_frame * mode.integration_frames), np.full(count, charge), moment, np.full(count, bend)]
    )
    quick = ramp.apply(frame[:, None, :], mode, 130_000.0, rng=rng)[:, 0]
    return np.array([read(groups, mode, rng) for groups in (slow, quick)])


CASES = {
    "hit": (100.0, 1000.0, 6e-7), "strong hit": (100.0, 3000.0, 0.0), "hit that fills": (2000.0, 3e5, 6e-7),
    "not linear": (4e4, 0.0, 6e-7), "saturated": (2e5, 0.0, 6e-7), "saturated at once": (1e8, 0.0, 0.0),
}  # fmt: skip


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("mode", [PHOTOMETRIC, SPECTROSCOPIC], ids=str)
def test_law_of_pixels_that_are_not_linear(mode, case):
    """Signal and quality, with photon noise, against counts of every frame.

    Two samples of 4000 pixels; significance 1 % of the law, 7e-6 of the mean (4.5 standard errors).
    """
    electrons, charge, bend = CASES[case]
    slow, quick = pixels(mode, 4000, np.random.default_rng(5), electrons, charge, bend)
    for i in range(2):
        assert stats.ks_2samp(slow[i], quick[i]).pvalue > 0.01
        assert quick[i].mean() == pytest.approx(slow[i].mean(), abs=4.5 * slow[i].std() * (2 / 4000) ** 0.5)


@pytest.mark.parametrize(("mode", "more", "seen"), [(PHOTOMETRIC, 3600.0, 0.84), (SPECTROSCOPIC, 8800.0, 0.96)])
def test_a_hit_is_not_its_charge_in_the_signal(mode, more, seen):
    """The estimator squares differences: 3000 e- add more than these.  100 e- are found by their quality at 1e-3."""
    rng, sky = np.random.default_rng(6), 1.5 * FRAME_TIME * mode.frames
    limit = stats.chi2.isf(1e-3, mode.groups - 2)
    without = pixels(mode, 4000, rng, sky)[1]
    strong, weak = (pixels(mode, 4000, rng, sky, charge)[1] for charge in (3000.0, 100.0))
    assert strong[0].mean() - without[0].mean() == pytest.approx(more, rel=0.03)
    assert (weak[1] > limit).mean() == pytest.approx(seen, abs=0.03)
    assert (without[1] > limit).mean() < 0.003


@pytest.mark.parametrize("mode", [PHOTOMETRIC, SPECTROSCOPIC], ids=str)
def test_drawing_every_frame_is_the_same_law(mode):
    """Two samples of 40,000 pixels; significance 1 % (Kolmogorov-Smirnov)."""
    rng, count = np.random.default_rng(3), 40_000
    quick = read(fast(mode, 1.0, count, rng), mode, rng)
    slow = read(fast(mode, 1.0, count, rng, linear_below=0.0), mode, rng)
    for i in range(2):
        assert stats.ks_2samp(slow[i], quick[i]).pvalue > 0.01


@pytest.mark.parametrize("mode", [PHOTOMETRIC, SPECTROSCOPIC, ramp.Mode(2, 1, 0)], ids=str)
def test_pixels_that_are_not_linear_against_every_frame(mode):
    """A hit, saturation and non-linearity without noise in the light: every pixel by its definition."""
    rng, count = np.random.default_rng(4), 1_300
    charge, moment = rng.uniform(0.0, 2e5, count), rng.uniform(0.0, 1.0, count)
    bend = rng.uniform(0.0, 1e-6, count)
    frame = np.array([np.zeros(count), charge, moment, bend])[:, None, :]
    found = ramp.apply(frame, mode, 130_000.0, rng=rng)[:, 0]
    k = np.arange(mode.frames)
    held = np.where(k[None] >= np.floor(moment * mode.frames)[:, None], charge[:, None], 0.0).clip(max=130_000.0)
    seen = held * (1.0 - bend[:, None] * held)
    starts = np.arange(mode.groups) * (mode.reads + mode.drops)
    expected = [seen[:, start : start + mode.reads].mean(axis=1) for start in starts]
    np.testing.assert_allclose(found, expected, rtol=2e-7, atol=0)


def test_non_linearity_is_the_same_where_the_law_changes():
    """Mean signal just below and just above the limit of the linear law.

    Sample of 40,000 pixels; significance 7e-6 (4.5 standard errors).
    """
    bend, count = 6e-7, 40_000
    light = np.full((1, count), 2990.0 * PHOTOMETRIC.integration_frames / PHOTOMETRIC.frames)
    bent = ramp.with_planes(light, 4)
    bent[3] = bend
    law = ramp.apply(bent, PHOTOMETRIC, 1.3e5, rng=np.random.default_rng(1))
    drawn = ramp.apply(bent, PHOTOMETRIC, 1.3e5, 0.0, rng=np.random.default_rng(2))
    linear = ramp.apply(light, PHOTOMETRIC, 1.3e5, 0.0, rng=np.random.default_rng(2))
    error = 4.5 * np.sqrt(2.0 * 2990.0 / count)
    assert law[-1].mean() == pytest.approx(drawn[-1].mean(), abs=error)
    assert (drawn[-1] - linear[-1]).mean() == pytest.approx(-bend * 2470.0**2, rel=0.3)


def test_each_pixel_has_its_own_nonlinearity_in_the_linear_law():
    """More pixels than the blocks in which they are drawn."""
    rng, count = np.random.default_rng(5), 1_300
    light = rng.uniform(0.0, 2000.0, (1, count))
    bent = ramp.with_planes(light, 4)
    bent[3] = rng.uniform(0.0, 1e-6, count)
    law, linear = (ramp.apply(frame, PHOTOMETRIC, 1.3e5, rng=np.random.default_rng(6)) for frame in (bent, light))
    rate = light / PHOTOMETRIC.integration_frames
    starts = np.arange(PHOTOMETRIC.groups) * (PHOTOMETRIC.reads + PHOTOMETRIC.drops)
    squares = ((starts[:, None] + np.arange(1, PHOTOMETRIC.reads + 1)) ** 2.0).mean(axis=1)
    expected = bent[3] * rate**2 * squares[:, None, None]
    np.testing.assert_allclose(linear - law, expected, rtol=1e-3, atol=5e-4)


def test_the_same_pixel_has_the_same_ramp_whatever_its_neighbours_hold():
    light = np.random.default_rng(1).uniform(0, 500.0, (6, 7))
    changed = light.copy()
    changed[2, 3] = 1e6
    first, second = (ramp.apply(frame, PHOTOMETRIC, 1.3e5, rng=np.random.default_rng(9)) for frame in (light, changed))
    different = (first != second).any(axis=0)
    assert different[2, 3]
    assert different.sum() == 1


def test_extremes():
    zero = np.zeros((2, 2))
    assert (ramp.apply(zero, PHOTOMETRIC, 1.3e5, rng=np.random.default_rng(1)) == 0.0).all()
    full = ramp.apply(zero + 1e15, PHOTOMETRIC, 1.3e5, rng=np.random.default_rng(1))
    np.testing.assert_array_equal(full, np.float32(1.3e5))
    faint = ramp.apply(zero + 1e-300, SPECTROSCOPIC, 1.3e5, rng=np.random.default_rng(1))
    assert np.isfinite(faint).all()


@pytest.mark.parametrize("numbers", [(1, 16, 4), (4, 0, 4), (4, 16, -1), (1001, 1, 0), (4, 16, 2000)])
def test_impossible_modes_are_refused(numbers):
    with pytest.raises(OutOfRange, match="of a ramp"):
        ramp.Mode(*numbers)
    with pytest.raises(BadInput, match="more than 4000"):
        ramp.Mode(100, 30, 30)
