"""Compare distances with astropy, adaptive quadrature and the series for small redshifts."""

import re

import numpy as np
import pytest
from astropy.cosmology import FlatLambdaCDM
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from lake_schema.errors import BadInput, OutOfRange
from truesky.cosmology import FIDUCIAL, age
from truesky.request.toml_values import check_keys

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
    from scipy.integrate import quad

    for z in (0.0, 1.0, 5.0):
        whole = quad(lambda x: 1.0 / ((1.0 + x) * float(FIDUCIAL.expansion_rate(x))), z, np.inf)[0]
        assert float(age(z, FIDUCIAL.omega_m, FIDUCIAL.h)) == pytest.approx(whole * 9.777922 / 0.67, rel=1e-6)
    assert float(age(0.0, 0.3, 0.7)) == pytest.approx(13.47, abs=0.01)


def test_a_request_with_another_cosmology_names_the_values():
    with pytest.raises(BadInput) as caught:
        check_keys({"Omega_m": 0.3}, "universe", ("z_max",))
    values = (
        100.0 * FIDUCIAL.h,
        FIDUCIAL.omega_m,
        FIDUCIAL.omega_b,
        FIDUCIAL.sigma_8,
        FIDUCIAL.n_s,
    )
    assert re.findall(r"= ([\d.]+\d)", str(caught.value)) == [f"{value:g}" for value in values]
