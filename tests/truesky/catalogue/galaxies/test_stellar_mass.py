"""Stellar masses from light and colour, star formation rates from mass and redshift."""

import numpy as np
import pytest

from truesky.catalogue.galaxies import stellar_mass
from truesky.catalogue.galaxies.sequences import BLUE, GREEN, RED
from truesky.cosmology import FIDUCIAL

MASSES, RATES = stellar_mass.mass_to_light(), stellar_mass.star_formation()
AGES = {0.4: 9.2, 1.0: 5.75, 2.0: 3.22}


def test_a_solar_galaxy():
    """At the Sun's M_r = 4.76 and g - r = 0.5 there is one Sun of light: the ratio is that of the relation at z = 0."""
    m_r = np.array([4.76 - 5 * np.log10(0.67)])
    log_mass = stellar_mass.log_stellar_mass(MASSES, FIDUCIAL.h, m_r, np.array([0.5 + 0.16]), np.zeros(1))
    assert log_mass == pytest.approx(-0.734 + 1.697 * 0.5, abs=1e-12)


@pytest.mark.parametrize("z", [0.0, 1.0, 3.0])
def test_mass_follows_light_and_colour(z):
    def mass(m_r, colour):
        return float(
            stellar_mass.log_stellar_mass(MASSES, FIDUCIAL.h, np.array([m_r]), np.array([colour]), np.array([z]))[0]
        )

    assert mass(-22.5, 0.6) - mass(-20.0, 0.6) == pytest.approx(1.0)
    assert mass(-20.0, 0.9) - mass(-20.0, 0.3) == pytest.approx(0.6 * (1.697 - 0.947 * np.log10(1 + z)))


@pytest.mark.parametrize("log_mass", [9.8, 10.2, 10.6])
@pytest.mark.parametrize("z", [0.4, 1.0, 2.0])
def test_the_main_sequence_is_that_of_other_studies(z, log_mass):
    """Speagle et al. 2014, eq. 28, in their range: studies differ by 0.2 dex; theirs does not bend."""
    t = AGES[z]
    expected = (0.84 - 0.026 * t) * log_mass - (6.51 - 0.11 * t)
    found = stellar_mass.main_sequence(RATES, np.array([log_mass]), np.array([z]))
    assert found == pytest.approx([expected], abs=0.2)


def test_bluer_galaxies_form_more_stars(rng):
    n = 50_000
    deviate = rng.standard_normal(n)
    rate = stellar_mass.log_sfr(RATES, np.zeros(n), np.full(n, BLUE), deviate, rng)
    assert np.std(rate) == pytest.approx(0.30, abs=0.005)
    assert np.corrcoef(rate, deviate)[0, 1] == pytest.approx(-0.6, abs=0.01)
    for sequence, mean, scatter in ((GREEN, -0.4, 0.35), (RED, -1.6, 0.4)):
        rate = stellar_mass.log_sfr(RATES, np.zeros(n), np.full(n, sequence), deviate, rng)
        assert (rate.mean(), rate.std()) == pytest.approx((mean, scatter), abs=0.01)
