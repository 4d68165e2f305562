"""The shipped spectrum of CAMB is close to the fitting formula, and other cosmologies need the package."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from lake_schema.errors import BadInput
from truesky.catalogue.matter import boltzmann, linear_theory
from truesky.cosmology import FIDUCIAL

CAMB, FIT = (replace(FIDUCIAL, power=power) for power in ("camb", "eisenstein98"))


def test_the_shipped_table_has_the_requested_sigma_8():
    k = np.geomspace(1e-5, 1e3, 50_000)
    x = 8.0 * k
    window = 3.0 * (np.sin(x) - x * np.cos(x)) / x**3
    variance = np.trapezoid(linear_theory.power(CAMB, k) * window**2 * k**3 / (2.0 * np.pi**2), np.log(k))
    assert np.sqrt(variance) == pytest.approx(FIDUCIAL.sigma_8, rel=1e-5)


def test_the_fitting_formula_has_wiggles_that_are_too_strong():
    """Ratio of the formula to CAMB at fixed sigma_8, measured with CAMB 2.0.5 before the table was shipped."""
    k = np.array([0.01, 0.02, 0.04, 0.06, 0.08, 0.1, 0.15, 0.2, 0.3, 0.5, 1.0, 10.0])
    expected = [0.979, 0.976, 0.995, 0.994, 1.019, 1.032, 1.013, 0.993, 0.992, 0.982, 0.984, 1.013]
    ratio = linear_theory.power(FIT, k) / linear_theory.power(CAMB, k)
    assert ratio == pytest.approx(expected, abs=1.5e-3)


def test_the_spectrum_is_continued_without_steps():
    first, last = boltzmann.K_RANGE
    k = np.array([first, last])
    below, above = (linear_theory.power(CAMB, k * (1.0 + sign * 1e-6)) for sign in (-1.0, 1.0))
    assert below == pytest.approx(above, rel=1e-5)
    far = np.array([1e-6, 1e5])
    ends = linear_theory.power(CAMB, k) / linear_theory.power(FIT, k)
    assert linear_theory.power(CAMB, far) == pytest.approx(ends * linear_theory.power(FIT, far), rel=1e-9, abs=0.0)
    assert boltzmann.power(CAMB, far).tolist() == [0.0, 0.0]


def test_halos_follow_the_spectrum():
    """CAMB has 1 % fewer light halos and 1 to 3 % more heavy ones, with a bias that is lower by up to 1 %."""
    log_mass, z = np.linspace(9.0, 14.0, 41), np.array([0.0, 1.0])
    fit, table = (linear_theory.halo_tables(cosmology, log_mass, z) for cosmology in (FIT, CAMB))
    density, bias = table["density"] / fit["density"], table["bias"] / fit["bias"]
    assert density[:, 0] == pytest.approx([0.987, 0.987], abs=2e-3)
    assert np.all((density[:, -1] > 1.005) & (density[:, -1] < 1.03))
    assert np.all((bias > 0.985) & (bias < 1.003))
    assert bias.min() < 0.997


def test_another_sigma_8_scales_the_spectrum():
    k = np.geomspace(1e-5, 1e3, 9)
    ratio = linear_theory.power(replace(CAMB, sigma_8=0.7), k) / linear_theory.power(CAMB, k)
    assert ratio == pytest.approx((0.7 / CAMB.sigma_8) ** 2, rel=1e-9)


def test_other_cosmologies_need_the_package(monkeypatch):
    monkeypatch.setitem(sys.modules, "camb", None)
    boltzmann.check(CAMB)
    with pytest.raises(
        BadInput, match=r"requires the package camb, which is not installed: pip install 'truesky.camb.'"
    ):
        boltzmann.check(replace(CAMB, h=0.7))
    with pytest.raises(BadInput, match="requires the package camb"):
        linear_theory.power(replace(CAMB, h=0.7), np.ones(1))
