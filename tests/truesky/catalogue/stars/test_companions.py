"""Binaries: how many, of which masses, how far apart."""

import numpy as np
import pytest

from truesky.catalogue.stars import companions
from truesky.catalogue.stars.milky_way import milky_way

GALAXY = milky_way()


@pytest.mark.parametrize(("mass", "fraction", "slope"), [(0.3, 0.26, 0.4), (1.0, 0.44, 0.3)])
def test_companions_of_a_mass(rng, mass, fraction, slope):
    """Duchene & Kraus 2013, Table 1: 26 % of 0.1-0.5 Msun, 44 % of 0.7-1.3 Msun; ratios as q^0.4, q^0.3."""
    n = 40_000
    found = companions.draw(GALAXY.tracks, np.full(n, 3), np.full(n, mass), rng)
    lightest = 10.0 ** GALAXY.tracks.log_mass[3, 0] / mass
    living = 1.0 - lightest ** (1.0 + slope)
    assert found.primary.size / n == pytest.approx(fraction * living, rel=0.04)
    assert found.mass.max() <= mass
    ratio = found.mass / mass
    mean = (1 + slope) / (2 + slope) * (1 - lightest ** (2 + slope)) / living
    assert ratio.mean() == pytest.approx(mean, rel=0.01)
    assert np.unique(found.primary).size == found.primary.size


def test_a_companion_is_a_star_of_its_mass_on_the_same_isochrone(rng):
    tracks, track = GALAXY.tracks, np.array([0, 50, 150, 215] * 500)
    found = companions.draw(tracks, track, np.full(track.size, 0.7), rng)
    for k in (0, 50, 150, 215):
        own = track[found.primary] == k
        part = slice(None, tracks.evolved)
        for values, wanted in ((found.m_h, tracks.m_h), (np.log10(found.teff), tracks.log_teff)):
            at = np.interp(np.log10(found.mass[own]), tracks.log_mass[k, part], wanted[k, part])
            assert values[own] == pytest.approx(at, abs=1e-9)


def test_white_dwarfs_have_none(rng):
    found = companions.draw(GALAXY.tracks, np.full(100, -1), np.full(100, np.nan), rng)
    assert found.primary.size == 0


def test_expected_companions_are_those_drawn(rng):
    """By bin of M_H, of the stars that stand for a component.

    Sample of 200,000; significance 6e-7 for the fullest bin (5 standard errors), and 4 % for the bins of mass.
    """
    own = GALAXY.pieces.take(slice(GALAXY.first[1, 0], GALAXY.first[1, -1]))
    n = 200_000
    chosen = rng.choice(own.number.size, n, p=own.number / own.number.sum())
    mass = 10.0 ** (own.log_mass[0] + rng.random(own.number.size) * (own.log_mass[1] - own.log_mass[0]))[chosen]
    found = companions.draw(GALAXY.tracks, own.track[chosen], mass, rng)
    drawn, _ = np.histogram(found.m_h, GALAXY.m_h[::10])
    wanted = GALAXY.companions[1].reshape(-1, 10).sum(1) * n / own.number.sum()
    assert drawn == pytest.approx(wanted, abs=0.04 * wanted.max() + 5 * np.sqrt(wanted.max()))


def test_separations(rng):
    """log P(d) = 5.0 +- 2.3 of solar stars, about 50 AU (Raghavan et al. 2010); M dwarfs 5 to 20 AU."""
    n = 40_000
    for primary, middle in ((1.0, 50.0), (0.3, 10.0)):
        _, east, north = companions.draw_orbits(np.full(n, primary), np.full(n, 0.5 * primary), rng)
        apart = np.hypot(east, north)
        # Seen from random directions the median is shorter by a tenth.
        assert np.median(apart) == pytest.approx(0.85 * middle, rel=0.2)
        assert apart.max() <= 20_000.0
        assert np.mean(east > 0) == pytest.approx(0.5, abs=0.01)
        assert np.median(np.abs(east)) / np.median(np.abs(north)) == pytest.approx(1.0, abs=0.1)
