"""The shipped spectrum of CAMB is close to the fitting formula, and other cosmologies need the package."""

import csv
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from colossus.lss import bias, mass_function, peaks

from lake_schema.errors import BadInput
from truesky.catalogue import parameters
from truesky.catalogue.matter import boltzmann, density_box, linear_theory
from truesky.cosmology import FIDUCIAL
from truesky.numerics import cache

REFERENCES = list(
    csv.DictReader(Path(__file__).parents[2].joinpath("cosmology_references.csv").read_text().splitlines())
)
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


def test_the_shipped_table_needs_no_version_of_the_package(monkeypatch):
    """The version of CAMB belongs to the keys of a spectrum that CAMB computes."""
    package = SimpleNamespace(__version__="2.0.5")
    monkeypatch.setitem(sys.modules, "camb", package)
    assert [boltzmann.camb_version(cosmology) for cosmology in (CAMB, FIT, replace(CAMB, sigma_8=0.7))] == ["", "", ""]
    other, spectra = replace(CAMB, h=0.7), []
    monkeypatch.setattr(
        boltzmann, "compute", lambda cosmology: {"power": np.full(boltzmann.K_NODES, len(spectra) + 1.0)}
    )
    with cache.use_temporary_dir():
        for version in ("2.0.5", "2.0.6", "2.0.5"):
            package.__version__ = version
            spectra.append(float(boltzmann.power(other, np.ones(1))[0]))
    assert spectra == pytest.approx([1.0, 2.0, 1.0])


def test_the_version_of_the_package_is_in_all_keys(monkeypatch):
    monkeypatch.setitem(sys.modules, "camb", SimpleNamespace(__version__="2.0.5"))
    assert density_box.box_model(replace(CAMB, h=0.7)).key_parts()[-1] == "2.0.5"
    assert density_box.box_model(CAMB).key_parts()[-1] == ""


@pytest.mark.nightly
@pytest.mark.parametrize("m_nu", [0.06, 0.5])
def test_all_matter_has_the_requested_sigma_8(m_nu):
    """Cold matter has more power, as much as in the file of references, which another program has written."""
    pytest.importorskip("camb", reason="camb is not installed (extra camb)")
    massive = replace(CAMB, m_nu=m_nu)
    with cache.use_temporary_dir():
        found = boltzmann.sigma_8_of_cold_matter(massive)
        large, small = (float(linear_theory.power(massive, k) / linear_theory.power(CAMB, k)) for k in (1e-4, 50.0))
    rows = [row for row in REFERENCES if row["quantity"] == "sigma_8_of_cold_matter"]
    expected = next(
        float(row["value"]) for row in rows if float(row["m_nu"]) == m_nu and float(row["omega_m"]) == 0.319
    )
    assert found == pytest.approx(expected, rel=1e-4)
    assert boltzmann.sigma_8_of_cold_matter(CAMB) == 0.83 < found
    # At equal sigma_8, large scales have more power than without massive neutrinos.
    assert large > 1.02 > small


def test_the_default_spectrum_is_that_of_the_shipped_table():
    """The code for massive neutrinos leaves the spectrum without them as it is."""
    pytest.importorskip("camb", reason="camb is not installed (extra camb)")
    table = np.array(parameters.section("linear_power.toml", "camb")["power"])
    assert boltzmann.compute(CAMB)["power"] == pytest.approx(table, rel=1e-7)


@pytest.mark.nightly
def test_halos_follow_cold_matter():
    """Compare abundance and bias with the fits for the rms of cold matter in the Lagrangian radius, an integral."""
    pytest.importorskip("camb", reason="camb is not installed (extra camb)")
    massive, log_mass, z = replace(CAMB, m_nu=0.5), np.linspace(11.0, 15.0, 41), np.array([0.0, 2.0])
    with cache.use_temporary_dir():
        tables = linear_theory.halo_tables(massive, log_mass, z)
        k = np.geomspace(1e-4, 50.0, 20_000)
        spectrum = linear_theory.power(massive, k)
    density = 2.77536627e11 * massive.omega_cold
    x = k * np.cbrt(3.0 * 10.0 ** log_mass[:, None] / (4.0 * np.pi * density))
    window = 3.0 * (np.sin(x) - x * np.cos(x)) / x**3
    sigma = np.sqrt(np.trapezoid(spectrum * window**2 * k**3 / (2.0 * np.pi**2), np.log(k)))
    slope = -np.gradient(np.log(sigma), np.log(10.0) * log_mass)
    for row, at in enumerate(z):
        now = sigma * float(massive.growth(at))
        share = mass_function.massFunction(now, at, q_in="sigma", q_out="f", mdef="200m", model="tinker08")
        expected = np.log(10.0) * share * density / 10.0**log_mass * slope
        # The slope at both ends is that of one side.
        assert tables["density"][row, 1:-1] == pytest.approx(expected[1:-1], rel=0.01, abs=0.0)
        # The density for a collapse depends on the density of matter.
        bias_of_sigma = bias.haloBiasFromNu(peaks.collapseOverdensity(z=at) / now, z=at, mdef="200m", model="tinker10")
        assert tables["bias"][row] == pytest.approx(bias_of_sigma, rel=3e-3)


def test_other_cosmologies_need_the_package(monkeypatch):
    monkeypatch.setitem(sys.modules, "camb", None)
    boltzmann.check(CAMB)
    with pytest.raises(
        BadInput, match=r"requires the package camb, which is not installed: pip install 'truesky.camb.'"
    ):
        boltzmann.check(replace(CAMB, h=0.7))
    with pytest.raises(BadInput, match="requires the package camb"):
        linear_theory.power(replace(CAMB, h=0.7), np.ones(1))
