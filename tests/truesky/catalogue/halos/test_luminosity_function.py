"""The luminosity function: published densities, its integrals and its inverse."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from lake_schema.errors import OutOfRange
from truesky.catalogue.halos import luminosity_function as lf

SCHECHTER = lf.schechter()
INVERSE = lf.inverse(SCHECHTER, 6.1)
magnitudes, redshifts = st.floats(-26.0, -8.0), st.floats(0.0, 6.1)


@pytest.mark.parametrize("a", [-1.5, -1.09, -0.98, -0.9, -0.46, -0.1575, -0.01, 0.3, 1.0])
@pytest.mark.parametrize("x", [1e-6, 1e-2, 1.0, 30.0, 300.0])
def test_incomplete_gamma_is_its_integral(a, x):
    # In t = x + s: a smooth integrand, and e^-x taken out.
    tail = quad(lambda s: np.exp(a * np.log(x * np.exp(s)) - x * np.expm1(s)), 0.0, np.log1p(60.0 / x), epsrel=1e-12)[0]
    # Two recurrences lose digits where nothing is left of the function.
    within = 1e-6 if a < -0.95 and x > 30.0 else 1e-9
    assert lf.upper_gamma(a, x) == pytest.approx(tail * np.exp(-x), rel=within, abs=0.0)


def test_incomplete_gamma_passes_through_zero():
    from scipy.special import exp1

    assert lf.upper_gamma(0.0, [0.01, 1.0, 10.0]) == pytest.approx(exp1([0.01, 1.0, 10.0]), rel=1e-4)
    from scipy.special import expn

    # Gamma(-1, x) = E_2(x) / x.
    x = np.array([0.01, 1.0, 10.0])
    assert lf.upper_gamma(-1.0, x) == pytest.approx(expn(2, x) / x, rel=1e-4)
    with pytest.raises(OutOfRange, match="a = -2"):
        lf.upper_gamma(-2.0, 1.0)


@pytest.mark.parametrize(("m", "published"), [(-19.0, 1.57e-2), (-20.0, 6.4e-3), (-21.0, 1.2e-3)])
def test_abundances_at_z_01_are_those_of_sdss(m, published):
    """Zehavi et al. 2011, ApJ 736, 59, Table 2."""
    assert lf.number_density(SCHECHTER, m, 0.1) == pytest.approx(published, rel=0.2)


@pytest.mark.parametrize("z", [0.0, 0.1, 1.0, 2.3, 4.2, 5.8])
def test_number_density_is_the_integral_of_density(z):
    edges = (-25.0, -17.0)
    counted = quad(lambda m: float(lf.density(SCHECHTER, m, z)), *edges, epsrel=1e-10)[0]
    bright, faint = lf.number_density(SCHECHTER, edges, z)
    assert faint - bright == pytest.approx(counted, rel=1e-8)


@given(magnitudes, redshifts)
def test_density_is_finite_and_positive(m, z):
    value = float(lf.density(SCHECHTER, m, z))
    assert np.isfinite(value)
    assert value >= 0.0
    assert m < -24.5 or value > 0.0


@given(magnitudes, magnitudes, redshifts)
def test_more_galaxies_are_brighter_than_a_fainter_limit(m1, m2, z):
    bright, faint = lf.number_density(SCHECHTER, sorted((m1, m2)), z)
    assert bright >= 0.0
    assert faint >= bright * (1 - 1e-9)


@given(st.floats(-24.0, -9.0), redshifts)
def test_magnitude_inverts_number_density(m, z):
    number = lf.number_density(SCHECHTER, m, z)
    if number > 1e-12:
        assert lf.magnitude(INVERSE, number, z) == pytest.approx(m, abs=0.003)


def test_an_impossible_far_end_is_refused():
    assert lf.volume(1.5).z_max == 1.5
    with pytest.raises(OutOfRange, match="z_max = 9"):
        lf.volume(9.0)


def test_there_is_no_step_where_the_knots_begin():
    near, far = (lf.number_density(SCHECHTER, [-23.0, -22.0, -20.0], z) for z in (2.0 - 1e-9, 2.0 + 1e-9))
    assert far == pytest.approx(near, rel=2e-3)


def test_knots_are_joined_by_straight_lines():
    """Of M*, log phi* and alpha: halfway between z = 3 and 3.8."""
    m_star, phi_star, alpha = SCHECHTER.parameters_at(np.array([3.4]))
    assert m_star == pytest.approx(0.5 * (-22.15 - 22.00))
    assert phi_star == pytest.approx(np.sqrt(1.603e-3 * 5.968e-4))
    assert alpha == pytest.approx(0.5 * (-1.597 - 1.858))
