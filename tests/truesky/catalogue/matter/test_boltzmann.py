"""The shipped spectrum of CAMB is close to the fitting formula, and other cosmologies need the package."""

import csv
import inspect
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from colossus.lss import bias, mass_function, peaks
from scipy.optimize import brentq

from lake_schema.errors import BadInput
from tests.truesky.catalogue import neutrinos
from truesky.catalogue import parameters
from truesky.catalogue.matter import boltzmann, linear_theory
from truesky.cosmology import FIDUCIAL, LIMITS, Cosmology
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
    neutrinos.set_version(monkeypatch, "2.0.5")
    assert [boltzmann.camb_version(cosmology) for cosmology in (CAMB, FIT, replace(CAMB, sigma_8=0.7))] == ["", "", ""]
    other, spectra = replace(CAMB, h=0.7), []
    monkeypatch.setattr(
        boltzmann, "compute", lambda cosmology: {"power": np.full(boltzmann.K_NODES, len(spectra) + 1.0)}
    )
    with cache.use_temporary_dir():
        for version in ("2.0.5", "2.0.6", "2.0.5"):
            neutrinos.set_version(monkeypatch, version)
            spectra.append(float(boltzmann.power(other, np.ones(1))[0]))
    assert spectra == pytest.approx([1.0, 2.0, 1.0])


def test_a_version_needs_no_import(monkeypatch):
    monkeypatch.setitem(sys.modules, "camb", None)
    neutrinos.set_version(monkeypatch, "2.0.5")
    assert boltzmann.camb_version(replace(CAMB, h=0.7)) == "2.0.5"


@pytest.mark.parametrize(
    ("k", "errors"), [(0.005, (12, 20, 33)), (0.02, (3, 5, 6)), (0.1, (0, 0, 0)), (1.0, (0, 0, -1))]
)
def test_the_power_of_cold_matter_is_that_of_camb(k, errors):
    """Errors of P(k, z) for z = 1, 2 and 5 relative to z = 0, in units of 1e-4: large scales grow more slowly.

    At z = 0 CAMB has other values for another largest wave number, because it interpolates between its wave numbers.
    """
    massive = neutrinos.MASSIVE
    values = {
        row["quantity"]: float(row["value"])
        for row in REFERENCES
        if row["quantity"].startswith("cold_power_z") and float(row["at"]) == k
        if Cosmology(**{name: float(row[name]) for name in LIMITS}) == massive
    }
    with neutrinos.installed():
        today = float(linear_theory.power(massive, np.array([k]))[0])
    assert today == pytest.approx(values["cold_power_z0"], rel=5e-4)
    for z, error in zip((1, 2, 5), errors, strict=True):
        growth = values[f"cold_power_z{z}"] / values["cold_power_z0"]
        assert 1e4 * (float(massive.growth(z)) ** 2 / growth - 1.0) == pytest.approx(error, abs=0.8)


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


def test_halos_follow_cold_matter():
    """Compare abundance and bias with the fits for the rms of cold matter in the Lagrangian radius, an integral."""
    log_mass, z = np.linspace(11.0, 15.0, 41), np.array([0.0, 2.0])
    with neutrinos.installed():
        tables = linear_theory.halo_tables(HEAVY, log_mass, z)
        sigma = _sigma(HEAVY, log_mass)
    slope = -np.gradient(np.log(sigma), np.log(10.0) * log_mass)
    for row, at in enumerate(z):
        now = sigma * float(HEAVY.growth(at))
        share = mass_function.massFunction(now, at, q_in="sigma", q_out="f", mdef="200m", model="tinker08")
        expected = np.log(10.0) * share * _DENSITY * HEAVY.omega_cold / 10.0**log_mass * slope
        # The slope at both ends is that of one side.
        assert tables["density"][row, 1:-1] == pytest.approx(expected[1:-1], rel=0.01, abs=0.0)
        # The density for a collapse depends on the density of matter.
        bias_of_sigma = bias.haloBiasFromNu(peaks.collapseOverdensity(z=at) / now, z=at, mdef="200m", model="tinker10")
        assert tables["bias"][row] == pytest.approx(bias_of_sigma, rel=3e-3)


# A spectrum is normalised by its table, so that the one of MASSIVE is possible for more neutrinos.
HEAVY = replace(CAMB, m_nu=0.5)
# Critical density today in Msun/h per (Mpc/h)^3.
_DENSITY = 2.77536627e11


def _sigma(cosmology, log_mass, ratio=1.0):
    """Return the rms overdensity today in spheres of `ratio` times the Lagrangian radius of masses of cold matter."""
    k = np.geomspace(1e-4, 50.0, 20_000)
    radius = np.cbrt(3.0 * 10.0**log_mass / (4.0 * np.pi * _DENSITY * cosmology.omega_cold))
    x = ratio * k * radius[:, None]
    window = 3.0 * (np.sin(x) - x * np.cos(x)) / x**3
    return np.sqrt(np.trapezoid(linear_theory.power(cosmology, k) * window**2 * k**3 / (2.0 * np.pi**2), np.log(k)))


def test_concentrations_have_the_growth_of_cold_matter(monkeypatch):
    """Compare with the formula of Diemer & Joyce 2019 for a growth that no universe has, and its exponent 0.6.

    Masses of the fit are relative to the critical density, in which no other mass has to be converted.
    """
    monkeypatch.setattr(Cosmology, "growth", lambda self, z: (1.0 + np.asarray(z, float)) ** -0.6)
    monkeypatch.setattr(Cosmology, "growth_rate", lambda self, z: np.full(np.shape(z), 0.6))
    monkeypatch.setattr(linear_theory, "MASS_DEFINITION", "200c")
    monkeypatch.setattr(linear_theory, "_COARSE", 1)
    log_mass, z = np.array([12.0, 13.0, 14.0]), np.array([3.0, 3.0])
    with neutrinos.installed():
        found = linear_theory.halo_tables(HEAVY, log_mass, z)["concentration"][0]
        nu = 1.686 / (_sigma(HEAVY, log_mass) * 4.0**-0.6)
        near, far = (np.log(_sigma(HEAVY, log_mass, 0.41 * step)) for step in (0.99, 1.01))
    n = -2.0 * (far - near) / np.log(1.01 / 0.99) - 3.0
    a, b = 2.45 * (1.0 + 1.82 * (n + 3.0)), 3.2 * (1.0 + 2.3 * (n + 3.0))
    ratio = a / nu * (1.0 + nu**2 / b)

    def difference(c, i):
        return c / (np.log1p(c) - c / (1.0 + c)) ** ((5.0 + n[i]) / 6.0) - ratio[i]

    expected = [(1.0 - 0.21 * (1.0 - 0.6)) * brentq(difference, 1.5, 100.0, args=(i,)) for i in range(3)]
    assert found == pytest.approx(np.array(expected), rel=0.02)


def test_colossus_gets_the_growth_with_massive_neutrinos():
    """The method has the arguments of colossus, of which those that nothing needs are refused."""
    with neutrinos.installed():
        current = linear_theory._set_cosmology(neutrinos.MASSIVE)
        arguments = [str(value) for value in inspect.signature(type(current).growthFactor).parameters.values()]
        assert [
            str(inspect.Parameter(value.name, value.kind, default=value.default))
            for value in inspect.signature(current.growthFactor).parameters.values()
        ] == arguments[1:]
        z, step = np.array([0.5, 2.0]), 1e-4
        assert np.array_equal(current.growthFactor(z), neutrinos.MASSIVE.growth(z))
        slope = (current.growthFactor(z + step) - current.growthFactor(z - step)) / (2.0 * step)
        assert current.growthFactor(z, derivative=1) == pytest.approx(slope, rel=1e-6)
        for asked in ({"derivative": 2}, {"inverse": True}):
            with pytest.raises(NotImplementedError, match="is not available"):
                current.growthFactor(z, **asked)
    massless = linear_theory._set_cosmology(CAMB)
    assert massless.growthFactor(2.0) == pytest.approx(float(CAMB.growth(2.0)), rel=1e-4)


def test_other_cosmologies_need_the_package(monkeypatch):
    monkeypatch.setitem(sys.modules, "camb", None)
    neutrinos.set_version(monkeypatch, None)
    assert boltzmann.camb_version(CAMB) == ""
    with pytest.raises(
        BadInput, match=r"requires the package camb, which is not installed: pip install 'truesky.camb.'"
    ):
        boltzmann.camb_version(replace(CAMB, h=0.7))
    with pytest.raises(BadInput, match="requires the package camb"):
        linear_theory.power(replace(CAMB, h=0.7), np.ones(1))
    with pytest.raises(BadInput, match="requires the package camb"):
        boltzmann.compute(CAMB)
