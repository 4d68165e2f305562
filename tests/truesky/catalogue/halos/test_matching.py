"""Luminosities matched to halo masses: abundances, concentrations, satellites."""

from dataclasses import replace

import numpy as np
import pytest

from truesky.catalogue.halos import luminosity_function, matching
from truesky.cosmology import FIDUCIAL

HALOS = matching.masses(FIDUCIAL)
FIT = matching.masses(replace(FIDUCIAL, power="eisenstein98"))
LF = luminosity_function.schechter()
MATCHED = matching.match_luminosities(HALOS, luminosity_function.inverse(LF, matching.Z_LAST))


@pytest.mark.parametrize(
    ("z", "numbers", "biases"),
    [
        (0.0, (3.66e-2, 4.75e-3, 5.39e-4, 3.55e-5), (0.68, 0.80, 1.08, 1.96)),
        (0.5, (3.71e-2, 4.39e-3, 3.93e-4, 1.38e-5), (0.77, 0.98, 1.49, 3.07)),
        (1.0, (3.59e-2, 3.69e-3, 2.34e-4, 3.40e-6), (0.92, 1.26, 2.14, 4.83)),
        (2.0, (2.78e-2, 1.86e-3, 4.53e-5, 5.5e-8), (1.37, 2.16, 4.19, 10.5)),
    ],
)
def test_abundance_and_bias(z, numbers, biases):
    """Tinker et al. 2008 and 2010 in the cosmology of the Flagship simulation, with the fitting formula."""
    at = np.array([11.0, 12.0, 13.0, 14.0])
    density = np.exp(FIT.interpolate(FIT.ln_density, np.array([z]), FIT.log_mass))[0]
    total = [np.trapezoid(density[FIT.log_mass > m - 1e-9], dx=0.02) for m in at]
    assert total == pytest.approx(numbers, rel=0.03)
    assert FIT.interpolate(FIT.bias, np.array([z]), at)[0] == pytest.approx(biases, rel=0.02)


def test_concentrations():
    """Diemer & Joyce 2019."""
    found = HALOS.interpolate_pairs(HALOS.concentration, np.array([0.0, 1.0]), np.array([12.0, 12.0]))
    assert found == pytest.approx([13.5, 5.7], rel=0.03)


@pytest.mark.parametrize(
    ("z", "halos", "most"),
    [
        (0.0, (4.75e-3, 5.39e-4, 3.55e-5), (1.45, 1.5, 1.7)),
        (0.5, (4.39e-3, 3.93e-4, 1.38e-5), (1.4, 1.5, 2.0)),
        (2.0, (1.86e-3, 4.53e-5), (1.4, 2.0)),
    ],
)
def test_luminosities_of_masses(z, halos, most):
    """Galaxies brighter than the central of a halo are as many as the halos above (Tinker et al. 2008), or more:
    satellites and scatter add up to a half, more where the mass function is steep."""
    m_r = MATCHED.magnitude(np.full(len(halos), z), np.array([12.0, 13.0, 14.0])[: len(halos)])
    ratio = luminosity_function.number_density(LF, m_r, z) / np.array(halos)
    assert np.all(ratio > 1.0)
    assert np.all(ratio < np.array(most))


@pytest.mark.parametrize("z", [0.1, 0.5, 1.0, 2.0, 4.0])
def test_the_luminosity_function_comes_out(z, rng):
    """Drawn centrals and satellites, scattered and matched: counted against the Schechter function.

    Sample of 3e6 (Mpc/h)^3; significance 6e-7 (5 standard errors), or 5 % for the steps in mass.
    """
    occupation, volume = MATCHED.occupation, 3e6
    density = np.exp(HALOS.interpolate(HALOS.ln_density, np.array([z]), HALOS.log_mass))[0] * 0.02
    density[HALOS.log_mass < 10.5] = 0.0
    mass = np.repeat(HALOS.log_mass, rng.poisson(volume * density)) + 0.02 * (rng.random() - 0.5)
    over = 10 ** (mass - 10.5)
    count = rng.poisson(np.maximum(over - occupation.min_mass_ratio, 0) / occupation.ratio_at(z))
    host = np.repeat(np.arange(mass.size), count)
    sub = mass[host] - np.log10(
        occupation.min_mass_ratio + (over[host] - occupation.min_mass_ratio) * rng.random(host.size)
    )
    proxy = np.concatenate([mass, sub]) + occupation.scatter * rng.standard_normal(mass.size + sub.size)
    m_r = MATCHED.magnitude(np.full(proxy.size, z), proxy)
    for limit in luminosity_function.schechter().parameters_at(z)[0] + np.array([-1.0, 0.0, 1.0]):
        expected = volume * float(luminosity_function.number_density(LF, limit, z))
        assert np.sum(m_r < limit) == pytest.approx(expected, rel=0.05, abs=5 * np.sqrt(expected))


def test_mass_of_inverts_magnitude():
    z, proxy = np.array([0.1, 0.8, 1.9]), np.array([11.0, 12.3, 13.1])
    assert MATCHED.proxy_mass(z, MATCHED.magnitude(z, proxy)) == pytest.approx(proxy, abs=1e-6)


@pytest.mark.parametrize(("m_r", "fraction"), [(-19.0, 0.28), (-20.0, 0.21), (-21.0, 0.13)])
def test_satellite_fraction_nearby(m_r, fraction):
    """Zehavi et al. 2011, z = 0.1."""
    z, occupation = np.array([0.1]), MATCHED.occupation
    least = float(MATCHED.proxy_mass(z, np.array([m_r]))[0])
    number = np.exp(HALOS.interpolate(HALOS.ln_density, z, HALOS.log_mass))[0] * 0.02
    above = matching.satellites_above(HALOS.log_mass, occupation) @ number
    sub = above[:-1] - above[1:]
    from scipy.special import ndtr

    centrals = np.sum(number * ndtr((HALOS.log_mass - least) / occupation.scatter))
    satellites = np.sum(sub * ndtr((HALOS.log_mass[:-1] + 0.01 - least) / occupation.scatter))
    assert satellites / (centrals + satellites) == pytest.approx(fraction, abs=0.03)


def test_halos_have_more_satellites_at_high_redshift_up_to_an_end():
    own = MATCHED.occupation
    assert own.ratio_at(np.array([own.z_pivot]))[0] == pytest.approx(own.ratio)
    more = matching.satellite_evolution(np.array([0.1, 0.5, 1.0, 3.0]), own)
    assert more[1] == pytest.approx((1.5 / 1.1) ** own.ratio_z)
    assert (np.diff(more[:3]) > 0).all()
    assert more[2] == more[3]


def test_sizes_and_velocities():
    assert HALOS.radius(np.array([15.0]))[0] == pytest.approx(2.38, rel=0.01)
    assert HALOS.dispersion(np.array([15.0, 14.0, 12.0]), np.zeros(3)) == pytest.approx([980.0, 450.0, 97.0], rel=0.02)
