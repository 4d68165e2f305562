"""The signal of a ramp: against its definition in exact arithmetic, and its bias, width and quality."""

from decimal import Decimal, getcontext
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from truesky.render.effects.charge.ramp import Mode
from truesky.render.effects.readout import macc

PHOTOMETRIC, SPECTROSCOPIC = Mode(4, 16, 4), Mode(15, 16, 11)


def exact(groups, mode, read_noise):
    """As printed, with 80 digits."""
    getcontext().prec = 80
    a = 1 + Decimal(1 - mode.reads**2) / (3 * mode.reads * (mode.reads + mode.drops))
    offset = 2 * Decimal(read_noise) ** 2 / (mode.reads * a)
    differences = [Decimal(float(y)) - Decimal(float(x)) + offset for x, y in pairwise(groups)]
    n = len(differences)
    square, mean = sum(d * d for d in differences) / n, sum(differences) / n
    x = a / 2 * ((1 + 4 * square / a**2).sqrt() - 1)
    return float(n * (x - offset)), float(2 * n * (square.sqrt() - mean) / a)


@given(
    groups=st.lists(st.floats(-1e5, 1e6, width=32), min_size=4, max_size=4),
    read_noise=st.sampled_from([0.0, 1e-6, 13.0, 200.0]),
)
def test_against_exact_arithmetic(groups, read_noise):
    frame = np.array(groups)[:, None, None]
    signal, quality = macc.apply(frame, PHOTOMETRIC, read_noise, np.random.default_rng(1))[:, 0, 0]
    expected, chi2 = exact(groups, PHOTOMETRIC, read_noise)
    # The read noise's share is subtracted again.
    scale = 1.0 + max(abs(value) for value in groups) + 2.0 * read_noise**2 / PHOTOMETRIC.reads
    assert signal == pytest.approx(expected, abs=1e-13 * scale, rel=1e-13)
    assert quality == pytest.approx(chi2, abs=1e-12 * scale, rel=1e-12)


def test_a_straight_ramp_gives_its_own_signal():
    """No read noise: x^2 + A x = D^2, whose root is D (1 - A / 2 D) for a large D."""
    frame = np.linspace(0.0, 30_000.0, 4)[:, None, None]
    signal, quality = macc.apply(frame, PHOTOMETRIC, 0.0, np.random.default_rng(1))[:, 0, 0]
    assert signal == pytest.approx(30_000.0 - 3 * 0.734375 / 2, abs=1e-3)
    assert quality == 0.0


@pytest.mark.parametrize("mode", [Mode(2, 1, 0), PHOTOMETRIC, SPECTROSCOPIC, Mode(100, 1, 0)], ids=str)
def test_an_empty_ramp(mode):
    assert (macc.apply(np.zeros((mode.groups, 2, 2)), mode, 0.0, np.random.default_rng(1)) == 0.0).all()


def test_two_groups_have_no_quality():
    groups = np.random.default_rng(1).normal(1000.0, 30.0, (2, 5, 5))
    groups[1] += 200.0
    assert (macc.apply(groups, Mode(2, 1, 0), 13.0, np.random.default_rng(1))[1] == 0.0).all()


def test_zero_point_of_the_estimator():
    """beta of the two modes at 13 e- a read."""
    assert macc.beta(PHOTOMETRIC, 13.0) == pytest.approx(28.77, abs=0.01)
    assert macc.beta(SPECTROSCOPIC, 13.0) == pytest.approx(26.30, abs=0.01)
