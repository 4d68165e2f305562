"""Noise of a ramp's reads and drifts: widths, spectrum, independence; gains of the outputs."""

import numpy as np
import pytest

from lake_schema.errors import OutOfRange
from truesky.render.effects.readout import output_gain, ramp_noise


def test_reads():
    """Sample of 40,000 pixels; significance 7e-6 of the noise, 6e-7 of correlations (5 standard errors)."""
    groups = ramp_noise.apply(np.zeros((4, 200, 200), np.float32), 13.0, 16, np.random.default_rng(1))
    assert groups.dtype == np.float32
    assert groups.std() == pytest.approx(13.0 / 4.0, rel=4.5 / np.sqrt(2 * groups.size))
    shared = np.corrcoef(groups.reshape(4, -1)) - np.eye(4)
    assert np.abs(shared).max() < 5.0 / 200.0


def test_drift_is_linear_in_time_and_has_its_width():
    groups = ramp_noise.apply_drift(np.zeros((5, 2040, 2040), np.float32), 5.1, np.random.default_rng(1))
    assert (groups[0] == 0.0).all()
    np.testing.assert_allclose(groups[2], 0.5 * groups[4], rtol=1e-5, atol=1e-6)
    # Half of the power is in some ten frequencies of each of 32 outputs.
    assert groups[4].std() == pytest.approx(5.1, rel=0.06)


def test_spectrum():
    """Power falls as 1 / f along the order of reading."""
    streams = np.array([ramp_noise._one_over_f(2**14, np.random.default_rng(seed)) for seed in range(200)])
    power = (np.abs(np.fft.rfft(streams, axis=1)) ** 2).mean(axis=0)
    bands = [(2, 8), (8, 32), (32, 128), (128, 512), (512, 2048), (2048, 8192)]
    octaves = [float((power[lo:hi] * np.arange(lo, hi)).mean()) for lo, hi in bands]
    np.testing.assert_allclose(octaves, np.mean(octaves), rtol=0.1)


@pytest.mark.parametrize("columns", [1, 31, 33, 100])
def test_any_number_of_columns(columns):
    out = ramp_noise.apply_drift(np.zeros((2, 3, columns), np.float32), 1.0, np.random.default_rng(1))
    assert np.isfinite(out).all()


def test_without_noise_nothing_changes():
    frame = np.random.default_rng(2).normal(size=(3, 8, 64)).astype(np.float32)
    np.testing.assert_array_equal(ramp_noise.apply(frame, 0.0, 16, np.random.default_rng(1)), frame)
    np.testing.assert_array_equal(ramp_noise.apply_drift(frame, 0.0, np.random.default_rng(1)), frame)


def test_each_output_has_a_gain_of_its_own():
    """All columns of an output have one gain, within the spread and with a mean near 1; it is fixed for a detector."""
    charge = np.full((2, 3, 2040), 1000.0, np.float32)
    seen = output_gain.apply(charge, 0.01, np.random.default_rng(1))
    assert (seen == seen[0, 0]).all()
    gains = seen[0, 0] / 1000.0
    assert len(np.unique(gains)) == ramp_noise.OUTPUTS
    assert (np.diff(np.flatnonzero(np.diff(gains))) >= 63).all()
    assert np.abs(gains - 1.0).max() < 0.0051
    assert gains.mean() == pytest.approx(1.0, abs=0.002)
    assert output_gain.EFFECT.fixed
    with pytest.raises(OutOfRange, match="gains"):
        output_gain.apply(charge, 1.1, np.random.default_rng(1))
