"""Compare distances with astropy, adaptive quadrature and the series for small redshifts."""

import csv
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
from astropy.cosmology import FlatLambdaCDM
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad, solve_ivp

from lake_schema.errors import BadInput, OutOfRange
from truesky import cosmology as cosmology_module
from truesky.catalogue.matter import linear_theory
from truesky.cosmology import FIDUCIAL, LIMITS, MIN_M_NU, Cosmology, age, from_facts

ORACLE = FlatLambdaCDM(H0=100.0, Om0=0.319, Tcmb0=0.0)
Z = np.geomspace(1e-3, 20.0, 40)


def test_distances_are_astropys():
    np.testing.assert_allclose(FIDUCIAL.comoving_distance(Z), ORACLE.comoving_distance(Z).value, rtol=1e-10)
    np.testing.assert_allclose(FIDUCIAL.luminosity_distance(Z), ORACLE.luminosity_distance(Z).value, rtol=1e-10)
    np.testing.assert_allclose(FIDUCIAL.distance_modulus(Z), ORACLE.distmod(Z).value, atol=1e-9)
    np.testing.assert_allclose(FIDUCIAL.expansion_rate(Z), ORACLE.efunc(Z), rtol=1e-13)
    volume = ORACLE.comoving_volume(Z).value / (4.0 * np.pi)
    np.testing.assert_allclose(FIDUCIAL.comoving_volume(0.0, Z), volume, rtol=1e-9)
    nearer = ORACLE.comoving_volume(0.7 * Z).value / (4.0 * np.pi)
    np.testing.assert_allclose(FIDUCIAL.comoving_volume(0.7 * Z, Z), volume - nearer, rtol=1e-9)


def test_physical_scale_has_h():
    physical = FlatLambdaCDM(H0=67.0, Om0=0.319, Tcmb0=0.0)
    wanted = physical.kpc_proper_per_arcmin(Z).value / 60.0
    np.testing.assert_allclose(FIDUCIAL.kpc_per_arcsec(Z), wanted, rtol=1e-10)


def test_flagship_numbers():
    assert float(FIDUCIAL.comoving_distance(2.3)) == pytest.approx(3844.0, rel=1e-3)
    square_degree = (np.pi / 180.0) ** 2
    assert float(FIDUCIAL.comoving_volume(0.0, 2.3)) * square_degree == pytest.approx(5.77e6, rel=1e-3)


@given(st.floats(0.0, np.log(21.0)))
def test_quadrature_is_exact(log_a):
    z = float(np.expm1(log_a))
    wanted, _ = quad(lambda y: np.exp(y) / np.sqrt(0.319 * np.exp(3 * y) + 0.681), 0.0, np.log1p(z), epsrel=1e-13)
    assert float(FIDUCIAL.comoving_distance(z)) == pytest.approx(2997.92458 * wanted, rel=1e-12, abs=1e-300)


def test_hubbles_law_at_small_redshift():
    z = np.array([1e-8, 1e-6, 1e-4])
    series = 2997.92458 * z * (1.0 - 0.75 * 0.319 * z)
    np.testing.assert_allclose(FIDUCIAL.comoving_distance(z), series, rtol=1e-8)
    np.testing.assert_allclose(FIDUCIAL.redshift(series), z, rtol=1e-8)


@given(st.floats(1e-8, 19.9), st.floats(1e-9, 0.1))
def test_separation_adds_up_and_keeps_its_digits(z, step):
    whole = float(FIDUCIAL.comoving_separation(z, z + step))
    half = z + 0.5 * step
    parts = float(FIDUCIAL.comoving_separation(z, half) + FIDUCIAL.comoving_separation(half, z + step))
    assert parts == pytest.approx(whole, rel=1e-12 + 1e-15 * z / step, abs=0.0)
    middle = float(FIDUCIAL.expansion_rate(half))
    actual_step = (z + step) - z
    assert whole == pytest.approx(2997.92458 * actual_step / middle, rel=1e-12 + step**2, abs=0.0)
    assert float(FIDUCIAL.comoving_separation(z + step, z)) == pytest.approx(-whole, rel=1e-12, abs=0.0)


@given(st.floats(1e-8, 20.0))
def test_redshift_inverts_distance(z):
    assert float(FIDUCIAL.redshift(FIDUCIAL.comoving_distance(z))) == pytest.approx(z, rel=1e-10, abs=0.0)


def test_ends():
    assert float(FIDUCIAL.redshift(0.0)) == 0.0
    assert float(FIDUCIAL.distance_modulus(0.0)) == -np.inf
    with pytest.raises(OutOfRange, match="z2"):
        FIDUCIAL.comoving_distance([0.5, 21.0])
    with pytest.raises(OutOfRange, match="z2"):
        FIDUCIAL.comoving_distance(-0.1)
    with pytest.raises(OutOfRange, match="z2"):
        FIDUCIAL.luminosity_distance(np.nan)
    with pytest.raises(OutOfRange, match="comoving distance"):
        FIDUCIAL.redshift(1e5)


def test_ages():
    """Compare the closed form with the integral of dt = dz / ((1 + z) H); 13.47 Gyr with h = 0.7, Omega_m = 0.3."""
    for z in (0.0, 1.0, 5.0):
        whole = quad(lambda x: 1.0 / ((1.0 + x) * float(FIDUCIAL.expansion_rate(x))), z, np.inf)[0]
        assert float(age(z, FIDUCIAL.omega_m, FIDUCIAL.h)) == pytest.approx(whole * 9.777922 / 0.67, rel=1e-6)
    assert float(age(0.0, 0.3, 0.7)) == pytest.approx(13.47, abs=0.01)


LEGAL = {"omega_m": 0.3, "omega_b": 0.045, "h": 0.7, "sigma_8": 0.8, "n_s": 0.96}
OTHERS = (
    Cosmology(**LEGAL, w0=-0.9),
    Cosmology(**LEGAL, w0=-1.2, wa=-0.5),
    Cosmology(**LEGAL, w0=-0.75, wa=0.6),
    Cosmology(**LEGAL, w0=-2.0, wa=-2.0),
)


@pytest.mark.parametrize("cosmology", OTHERS)
def test_distances_with_dark_energy_are_those_of_adaptive_quadrature(cosmology):
    expected = astropy_expansion_rate(cosmology)
    z = np.array([0.01, 0.3, 1.0, 3.0, 10.0, 20.0])
    whole = [quad(lambda x: 1.0 / expected(x), 0.0, at, epsabs=0.0, epsrel=1e-12, limit=200)[0] for at in z]
    np.testing.assert_allclose(cosmology.comoving_distance(z), 2997.92458 * np.array(whole), rtol=1e-10)
    np.testing.assert_allclose(cosmology.redshift(cosmology.comoving_distance(z)), z, rtol=1e-10)
    np.testing.assert_allclose(cosmology.expansion_rate(z), expected(z), rtol=1e-13)


def astropy_expansion_rate(cosmology):
    """Return E(z) of a flat universe with w0 and wa, from astropy."""
    from astropy.cosmology import Flatw0waCDM

    return Flatw0waCDM(100.0, cosmology.omega_m, w0=cosmology.w0, wa=cosmology.wa, Tcmb0=0.0).efunc


def test_growth_of_a_constant_is_the_limit_of_other_dark_energy():
    """The closed form is the reference of the differential equation."""
    spline = cosmology_module._growth_spline(FIDUCIAL)
    np.testing.assert_allclose(np.exp(spline(-np.log1p(Z))), FIDUCIAL.growth(Z), rtol=1e-8)
    near = replace(FIDUCIAL, w0=-1.0 + 1e-9)
    np.testing.assert_allclose(near.growth(Z), FIDUCIAL.growth(Z), rtol=1e-8)
    np.testing.assert_allclose(near.growth_rate(Z, 0.55), FIDUCIAL.growth_rate(Z, 0.55), rtol=5e-3)


@pytest.mark.parametrize("cosmology", OTHERS)
def test_growth_with_dark_energy_solves_its_equation(cosmology):
    """A solver of high order integrates D'' + (2 + dlnE/dlna) D' = 3/2 Om(a) D from a = 1e-6."""

    def slope(x, y):
        a = np.exp(-x)
        share = cosmology._dark_energy(a) / cosmology._expansion_rate(a) ** 2
        w = cosmology.w0 + cosmology.wa * (1.0 - np.exp(x))
        return [y[1], 1.5 * (1.0 - share) * y[0] - (0.5 - 1.5 * w * share) * y[1]]

    start = np.log(1e-6)
    solution = solve_ivp(slope, (start, 0.0), [1e-6, 1e-6], rtol=1e-11, atol=0.0, method="DOP853", dense_output=True)
    d, rate = solution.sol(-np.log1p(Z))
    np.testing.assert_allclose(cosmology.growth(Z), d / solution.y[0, -1], rtol=2e-8)
    np.testing.assert_allclose(cosmology.growth_rate(Z, 0.55), rate / d, rtol=5e-6)
    assert float(cosmology.growth(0.0)) == 1.0
    with pytest.raises(OutOfRange, match="z = 21"):
        cosmology.growth(21.0)


def test_a_constant_needs_no_powers(monkeypatch):
    """Without the shortcut, distances of the fiducial cosmology have the same bits."""
    z = np.linspace(0.0, 20.0, 101)
    short = FIDUCIAL.comoving_distance(z)
    monkeypatch.setattr(Cosmology, "has_constant_dark_energy", False)
    assert np.array_equal(FIDUCIAL.comoving_distance(z), short)


REFERENCES = list(csv.DictReader(Path(__file__).with_name("cosmology_references.csv").read_text().splitlines()))
# Error relative to CCL without radiation and to CAMB with radiation, both by scripts/cosmology_references.py.
TOLERANCES = {
    "chi": 1e-6, "growth": 1e-5, "growth_rate": 1e-3, "power": 1e-3, "sigma_8": 1e-3, "chi_with_radiation": 1e-3,
    "chi_with_neutrinos": 4e-4,
}  # fmt: skip
# Numbers of cosmologies without and with massive neutrinos.
COUNTS = {"chi_with_neutrinos": 8}


@pytest.mark.parametrize("quantity", TOLERANCES)
def test_other_programs_have_the_same_values(quantity):
    rows = [row for row in REFERENCES if row["quantity"] == quantity]
    assert len({tuple(row[name] for name in LIMITS) for row in rows}) == COUNTS.get(quantity, 5)
    for row in rows:
        values, at = {name: float(row[name]) for name in LIMITS}, float(row["at"])
        cosmology = Cosmology(**values, power="camb" if values["m_nu"] else "eisenstein98")
        value = {
            "chi": cosmology.comoving_distance,
            "chi_with_radiation": cosmology.comoving_distance,
            "chi_with_neutrinos": cosmology.comoving_distance,
            "growth": cosmology.growth,
            "growth_rate": lambda z, of=cosmology: of.growth_rate(z, 0.55),
            "sigma_8": lambda z, of=cosmology: of.sigma_8 * of.growth(z),
            "power": lambda k, of=cosmology: linear_theory.power(of, np.array(k)),
        }[quantity](at)
        assert float(value) == pytest.approx(float(row["value"]), rel=TOLERANCES[quantity], abs=0.0), row


def cosmology_of(row):
    return Cosmology(**{name: float(row[name]) for name in LIMITS})


# Fractions of neutrinos in all matter of several cosmologies, and largest errors of the growth of cold and all matter.
# The last fractions are close to the limit.
@pytest.mark.parametrize(
    ("fractions", "cold", "matter"),
    [((0.004, 0.006), 1e-4, 4e-4), ((0.03, 0.039), 5e-4, 8e-3), ((0.039, 0.04), 1.2e-3, 7e-3)],
)
def test_the_growth_is_that_of_cold_matter(fractions, cold, matter):
    """All matter grows more slowly than cold matter, because neutrinos cluster at low redshifts only."""
    for quantity, largest in (("growth_of_cold_matter", cold), ("growth_of_all_matter", matter)):
        rows = [(cosmology_of(row), row) for row in REFERENCES if row["quantity"] == quantity]
        rows = [(of, row) for of, row in rows if fractions[0] < of.omega_nu / of.omega_m < fractions[1]]
        assert len(rows) in (10, 15)
        errors = [abs(float(of.growth(float(row["at"]))) / float(row["value"]) - 1.0) for of, row in rows]
        assert 0.1 * largest < max(errors) < largest


@pytest.mark.parametrize(
    ("k", "errors"), [(0.005, (0.88, 1.56, 2.80)), (0.02, (0.58, 1.0, 1.68)), (1.0, (-0.17, -0.27, -0.39))]
)
def test_the_growth_does_not_depend_on_scale(k, errors):
    """The documentation has these errors relative to CAMB in per cent, for 0.5 eV and z = 1, 2 and 5."""
    power = {
        row["quantity"]: float(row["value"])
        for row in REFERENCES
        if float(row["at"]) == k and cosmology_of(row) == replace(FIDUCIAL, m_nu=0.5)
    }
    for z, expected in zip((1, 2, 5), errors, strict=True):
        growth = np.sqrt(power[f"cold_power_z{z}"] / power["cold_power_z0"])
        assert 100.0 * (replace(FIDUCIAL, m_nu=0.5).growth(z) / growth - 1.0) == pytest.approx(expected, abs=0.01)


def test_neutrinos_are_matter_for_distances():
    massive = replace(FIDUCIAL, m_nu=0.3)
    assert massive.omega_nu == pytest.approx(0.3 / 93.14 / 0.67**2, rel=1e-12, abs=0.0)
    assert massive.omega_cold == 0.319 - massive.omega_nu
    assert np.array_equal(massive.comoving_distance(Z), FIDUCIAL.comoving_distance(Z))
    assert (FIDUCIAL.omega_nu, FIDUCIAL.omega_cold) == (0.0, 0.319)


def test_neutrinos_slow_the_growth_down():
    """Small scales grow with the exponent 1 - 3/5 f_nu if neutrinos do not cluster; here they do at low redshifts."""
    z, last = np.array([2.0, 5.0, 10.0]), 1.0
    massless = replace(FIDUCIAL, m_nu=MIN_M_NU).growth(z)
    for m_nu in (0.06, 0.2, 0.5):
        cosmology = replace(FIDUCIAL, m_nu=m_nu)
        power = np.log(cosmology.growth(z) / massless) / np.log(massless)
        share = cosmology.omega_nu / cosmology.omega_m
        assert np.all((power < -0.4 * share) & (power > -0.6 * share))
        assert float(cosmology.growth_rate(1.0, 0.55)) < last
        last = float(cosmology.growth_rate(1.0, 0.55))
    with pytest.raises(OutOfRange, match="z = 21"):
        cosmology.growth(21.0)
    # The growth without massive neutrinos has no radiation, which matters less than 3e-4 up to z = 2.
    assert massless[0] == pytest.approx(float(FIDUCIAL.growth(2.0)), rel=3e-4)


@pytest.mark.parametrize("name", LIMITS)
def test_the_fingerprint_depends_on_every_bit(name):
    base = replace(FIDUCIAL, m_nu=MIN_M_NU)
    towards = LIMITS[name][1] if name != "w0" else -2.0
    other = replace(base, **{name: float(np.nextafter(getattr(base, name), towards))})
    assert len({other.fingerprint(), base.fingerprint(), FIDUCIAL.fingerprint()}) == 3


def test_fingerprints_are_the_same_everywhere():
    assert FIDUCIAL.fingerprint() == replace(FIDUCIAL, h=0.67).fingerprint() == "fcc45824086d29a1"
    assert replace(FIDUCIAL, power="eisenstein98").fingerprint() != FIDUCIAL.fingerprint()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"h": 67.0}, r"h = 67.0 is outside \[0.4, 1.0\]"),
        ({"n_s": float("nan")}, "n_s = nan is outside"),
        ({"sigma_8": 0.0}, "sigma_8 = 0.0 is outside"),
        ({"m_nu": -0.1}, "m_nu = -0.1 is outside"),
        ({"m_nu": 0.51}, "m_nu = 0.51 is outside"),
        ({"m_nu": float("nan")}, "m_nu = nan is outside"),
        (
            {"m_nu": 0.06, "power": "eisenstein98"},
            'm_nu = 0.06 requires power = "camb": eisenstein98 has no massive neutrinos',
        ),
        ({"omega_m": 0.12, "omega_b": 0.12}, "omega_b = 0.12 must be smaller than omega_m = 0.12, all matter$"),
        (
            {"omega_m": 0.12, "omega_b": 0.118, "m_nu": 0.1},
            "omega_b = 0.118 must be smaller than omega_m = 0.12, all matter, less neutrinos, 0.00239$",
        ),
        ({"m_nu": 1e-160}, "^m_nu = 1e-160 must be 0, or from 0.001 to 0.5$"),
        ({"m_nu": 5e-324}, "must be 0, or from 0.001 to 0.5$"),
        (
            {"omega_m": 0.24, "h": 0.4, "m_nu": 0.5},
            "^m_nu = 0.5, h = 0.4 and omega_m = 0.24 make neutrinos a fraction of 0.14 of all matter, at most 0.04 is",
        ),
        ({"omega_m": 0.298, "m_nu": 0.5}, "a fraction of 0.0401 of all matter"),
        ({"w0": -0.5, "wa": 0.5}, r"w0 \+ wa = 0 must be at most -0.1"),
        ({"power": "class"}, "power = 'class' is not one of eisenstein98, camb"),
    ],
)
def test_impossible_parameters_are_refused(values, message):
    with pytest.raises(BadInput, match=message):
        replace(FIDUCIAL, **values)


def test_facts_of_a_lake_name_its_cosmology():
    assert from_facts({"cosmology": asdict(OTHERS[1]), "seed": 1}) == OTHERS[1]
    assert from_facts({"seed": 1}) == replace(FIDUCIAL, power="eisenstein98")
