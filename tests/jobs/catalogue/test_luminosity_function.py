import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from jobs.catalogue import luminosity_function as lf
from jobs.fluxes import cosmology
from lake_schema.errors import OutOfRange

SCHECHTER = lf.schechter()
INVERSE = lf.inverse(SCHECHTER, 3.0)
magnitudes, redshifts = st.floats(-26.0, -8.0), st.floats(0.0, 3.0)


@pytest.mark.parametrize("a", [-0.9, -0.46, -0.1575, -0.01, 0.3, 1.0])
@pytest.mark.parametrize("x", [1e-6, 1e-2, 1.0, 30.0, 300.0])
def test_incomplete_gamma_is_its_integral(a, x):
    # In t = x + s: a smooth integrand, and e^-x taken out.
    tail = quad(lambda s: np.exp(a * np.log(x * np.exp(s)) - x * np.expm1(s)), 0.0, np.log1p(60.0 / x), epsrel=1e-12)[0]
    assert lf.upper_gamma(a, x) == pytest.approx(tail * np.exp(-x), rel=1e-9)


def test_incomplete_gamma_passes_through_zero():
    from scipy.special import exp1

    assert lf.upper_gamma(0.0, [0.01, 1.0, 10.0]) == pytest.approx(exp1([0.01, 1.0, 10.0]), rel=1e-4)
    with pytest.raises(OutOfRange, match="a = -1"):
        lf.upper_gamma(-1.0, 1.0)


@pytest.mark.parametrize(("m", "published"), [(-19.0, 1.57e-2), (-20.0, 6.4e-3), (-21.0, 1.2e-3)])
def test_abundances_at_z_01_are_those_of_sdss(m, published):
    """Zehavi et al. 2011, ApJ 736, 59, Table 2."""
    assert lf.number_density(SCHECHTER, m, 0.1) == pytest.approx(published, rel=0.2)


@pytest.mark.parametrize("z", [0.0, 0.1, 1.0, 2.3])
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


def test_counts_are_the_integral_over_the_volume():
    space = lf.volume()
    counts = lf.counts(SCHECHTER, space, lambda z: 24.0 - cosmology.distance_modulus(z))

    def shell(z):
        limit = min(24.0 - float(cosmology.distance_modulus(z)), space.m_faintest)
        depth = cosmology.HUBBLE_DISTANCE / float(cosmology.expansion_rate(z))
        return float(lf.number_density(SCHECHTER, limit, z)) * float(cosmology.comoving_distance(z)) ** 2 * depth

    exact = quad(shell, space.z_min, space.z_max, epsrel=1e-8, limit=200)[0] * (np.pi / 180.0) ** 2
    assert counts.per_deg2 == pytest.approx(exact, rel=1e-4)


@pytest.mark.parametrize("z", [0.1, 0.5, 1.0, 2.0])
def test_drawn_galaxies_have_the_luminosity_function(z, rng):
    space = lf.Volume(z - 0.02, z + 0.02, -17.0)
    counts = lf.counts(SCHECHTER, space, lambda z: np.full_like(z, -17.0))
    area = 2e5 / counts.per_deg2
    redshift, m = lf.draw(INVERSE, counts, area, rng)
    assert redshift.min() >= space.z_min
    assert redshift.max() <= space.z_max
    assert m.max() <= -17.0 + 0.01
    bins = np.arange(-22.0, -16.9, 0.5)
    volume = area * (np.pi / 180.0) ** 2 * float(cosmology.comoving_volume(space.z_min, space.z_max))
    expected = np.diff(lf.number_density(SCHECHTER, bins, z)) * volume
    found = np.histogram(m, bins)[0]
    assert np.all(np.abs(found - expected) < 0.03 * expected + 4 * np.sqrt(expected))
    assert found[4:] == pytest.approx(expected[4:], rel=0.05)


def test_the_number_drawn_is_poisson(rng):
    counts = lf.counts(SCHECHTER, lf.volume(), lambda z: 22.0 - cosmology.distance_modulus(z))
    area = 50.0 / counts.per_deg2
    numbers = np.array([lf.draw(INVERSE, counts, area, rng)[0].size for _ in range(1500)])
    assert numbers.mean() == pytest.approx(50.0, abs=4 * np.sqrt(50.0 / 1500))
    assert numbers.var() == pytest.approx(50.0, rel=4 * np.sqrt(2 / 1500))


def test_an_impossible_far_end_is_refused():
    assert lf.volume(1.5).z_max == 1.5
    with pytest.raises(OutOfRange, match="z_max = 9"):
        lf.volume(9.0)
