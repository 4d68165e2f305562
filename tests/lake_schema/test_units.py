"""Magnitudes, flux densities and electron rates, compared with decimal arithmetic and with definitions."""

from decimal import Decimal, getcontext

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lake_schema import units
from lake_schema.errors import OutOfRange

getcontext().prec = 50


def exact(mag: float) -> Decimal:
    """Return 10^(-0.4 (m + 48.6)) in microjansky."""
    return Decimal(10) ** (-(Decimal(mag) + Decimal("48.6")) / Decimal("2.5") + 29)


@given(st.floats(-30.0, 60.0))
def test_f_nu_to_the_last_digits(mag):
    wanted = exact(mag)
    assert abs(Decimal(float(units.f_nu_of_mag(mag))) / wanted - 1) < Decimal("4e-15")


@given(st.floats(-30.0, 60.0))
def test_round_trip(mag):
    assert abs(float(units.mag_of_f_nu(units.f_nu_of_mag(mag))) - mag) <= 1.5e-14


def test_ab_zero_point_and_not_the_printed_form():
    # Oke & Gunn 1983: m = 0 is 3631 Jy, and m = 20 is 3.63e-28 erg s-1 cm-2 Hz-1, not 10^(-8 + 48.6) = 4e40.
    cgs = float(units.cgs_of_ujy(units.f_nu_of_mag(20.0)))
    assert cgs == pytest.approx(3.6308e-28, rel=1e-4, abs=0.0)
    assert float(units.f_nu_of_mag(0.0)) == pytest.approx(3631e6, rel=1e-4)
    assert float(units.f_nu_of_mag(23.9)) == pytest.approx(1.0, rel=4e-15, abs=0.0)


def test_five_magnitudes_are_a_factor_of_one_hundred():
    mags = np.arange(-30.0, 60.0, 5.0)
    ratio = units.f_nu_of_mag(mags) / units.f_nu_of_mag(mags + 5.0)
    np.testing.assert_allclose(ratio, 100.0, rtol=1e-14)


@pytest.mark.parametrize("mag", [1000.0, -1000.0, np.nan, np.inf, -np.inf])
def test_impossible_magnitudes_are_refused(mag):
    with pytest.raises(OutOfRange, match="mag_ab"):
        units.f_nu_of_mag([20.0, mag])


@pytest.mark.parametrize("flux", [-1.0, np.nan, np.inf])
def test_impossible_fluxes_are_refused(flux):
    with pytest.raises(OutOfRange, match="f_nu"):
        units.mag_of_f_nu([1.0, flux])


def test_no_flux_is_infinitely_faint():
    assert units.mag_of_f_nu([0.0, 5e-324]).tolist()[0] == np.inf


# Values below 1e-278 microjansky have no full precision in cgs units.
@given(st.floats(1e-278, 1e300))
def test_microjansky_and_cgs(flux):
    assert float(units.cgs_of_ujy(flux)) == pytest.approx(flux * 1e-29, rel=5e-16, abs=0.0)
    assert float(units.ujy_of_cgs(units.cgs_of_ujy(flux))) == pytest.approx(flux, rel=5e-16, abs=0.0)


def test_electron_rate_counts_photons():
    # For constant f_nu, the rate of photons between nu and nu + dnu is f_nu A dnu / (h nu).
    area, blue, red, throughput, f_nu = 9926.0, 5500.0, 9000.0, 0.7, 3.0
    nu = 2.99792458e18 / np.linspace(blue, red, 200_001)
    photons = f_nu * 1e-29 * area * throughput / (6.62607015e-27 * nu)
    counted = -np.trapezoid(photons, nu)
    width = throughput * np.log(red / blue)
    assert float(units.electron_rate(f_nu, area, width)) == pytest.approx(counted, rel=1e-9)
    assert float(units.electron_rate(units.f_nu_of_mag(units.zero_point(area, width)), area, width)) == (
        pytest.approx(1.0, rel=1e-13, abs=0.0)
    )


@pytest.mark.parametrize(("area", "width"), [(0.0, 1.0), (1.0, 0.0), (-1.0, 1.0), (np.nan, 1.0), (1.0, np.inf)])
def test_electron_rate_refuses_impossible_areas_and_widths(area, width):
    with pytest.raises(OutOfRange):
        units.electron_rate(1.0, area, width)
