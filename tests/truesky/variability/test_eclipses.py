"""Eclipses against geometry, and the number of close binaries against surveys."""

import numpy as np
import pytest

from truesky.catalogue.stars import companions, milky_way, stellar_populations
from truesky.randomness.per_source import PerSourceGenerator
from truesky.variability import eclipses
from truesky.variability.eclipses import Pairs

SUN = 4.438


def draw(pairs, first=0):
    return eclipses.draw(pairs, PerSourceGenerator(np.arange(first, first + pairs.axis.size), 1, "test"))


def suns(axis):
    n = axis.size
    return Pairs(np.ones((2, n)), np.full((2, n), SUN), np.ones(n, bool), axis)


def test_uniform_discs_hide_the_area_in_which_they_overlap():
    """The area of two circles in closed form, for many distances and radii."""
    distance, ratio = (grid.ravel() for grid in np.meshgrid(np.linspace(0.01, 2.4, 40), np.linspace(0.2, 1.5, 14)))
    with np.errstate(invalid="ignore"):
        first = np.arccos((distance**2 + 1.0 - ratio**2) / (2.0 * distance))
        second = np.arccos((distance**2 + ratio**2 - 1.0) / (2.0 * distance * ratio))
        lens = first - 0.5 * np.sin(2.0 * first) + ratio**2 * (second - 0.5 * np.sin(2.0 * second))
    area = np.where(distance >= 1.0 + ratio, 0.0, np.where(distance <= np.abs(1.0 - ratio), np.pi, lens))
    area = np.where(distance <= 1.0 - ratio, np.pi * ratio**2, area)
    assert eclipses.eclipse_loss(distance, ratio, 0.0) == pytest.approx(area / np.pi, abs=1e-6)


def hidden_light(distance, ratio, darkening):
    """The fraction of the light of 4000 rings behind the other star, by the hidden arc of each ring."""
    squares = (np.arange(4000) + 0.5) / 4000
    light = 1.0 - darkening * (1.0 - np.sqrt(1.0 - squares))
    d = max(distance, 1e-9)
    arc = np.arccos(np.clip((squares + d**2 - ratio**2) / (2.0 * np.sqrt(squares) * d), -1.0, 1.0)) / np.pi
    return np.sum(arc * light) / np.sum(light)


def test_few_discs_are_accurate_enough():
    """Against 4000 rings, with the limb darkening of V."""
    distance, ratio = (grid.ravel() for grid in np.meshgrid(np.linspace(0.0, 2.4, 30), np.linspace(0.2, 1.5, 14)))
    fine = [hidden_light(d, k, 0.65) for d, k in zip(distance, ratio, strict=True)]
    assert eclipses.eclipse_loss(distance, ratio, 0.65) == pytest.approx(np.array(fine), abs=3e-3)
    assert eclipses.eclipse_loss(np.zeros(2), np.array([1.0, 2.0]), 0.65) == pytest.approx(1.0)


def test_a_small_star_before_the_centre_of_the_sun():
    """Depth of a transit: k^2 / (1 - u / 3) at the centre of a disc with linear limb darkening u."""
    loss = eclipses.eclipse_loss(np.array([0.0]), np.array([0.2]), 0.6)[0]
    assert loss == pytest.approx(0.04 / (1.0 - 0.2), rel=0.02)


def test_orbits_of_suns():
    """Chance of an eclipse (R1 + R2) / a, and its duration P / pi arcsin(..) at the centre.

    Sample of 40,000 binaries at 10 radii, of which 8000 have eclipses; significance 6e-7 (5 standard errors).
    """
    n = 40_000
    axis = np.full(n, 10.0 * eclipses.SUN_RADIUS_AU)
    found = draw(suns(axis))
    assert found.period[0, 0] == pytest.approx(365.25 * np.sqrt(axis[0] ** 3 / 2.0), abs=0.0)
    share = np.mean(found.duration[0] > 0.0)
    assert share == pytest.approx(0.2, abs=5.0 * np.sqrt(0.2 * 0.8 / n))
    central = found.impact[0] < 0.05
    wanted = found.period[0, 0] / np.pi * np.arcsin(0.2)
    assert found.duration[0][central & (found.duration[0] > 0.0)] == pytest.approx(wanted, rel=0.01)
    assert np.all(found.phase[0] == 0.0)
    assert np.abs(found.phase[1] - 0.5).max() < 1e-12


def test_eccentric_orbits():
    """The secondary eclipse moves away from phase 0.5, and both eclipses together last as long as in a circle."""
    n = 20_000
    found = draw(suns(np.full(n, 0.5)))
    assert np.all(found.tides == 0.0)
    assert 0.02 < np.std(found.phase[1]) < 0.3
    assert np.mean(found.phase[1]) == pytest.approx(0.5, abs=0.01)
    assert np.all(found.phase[0] == 0.0)


def test_stars_in_contact():
    """Dwarfs whose orbit is too small touch each other; giants have merged, and do not vary."""
    pairs = suns(np.full(2000, 1e-3))
    found = draw(pairs)
    radius = eclipses.radius(1.0, SUN)
    assert found.period == pytest.approx(float(eclipses.period_of_orbit(radius / eclipses.roche_radius(1.0), 2.0)))
    assert 0.3 < found.period[0, 0] < 0.6
    assert np.mean(found.is_variable) > 0.95
    assert 0.04 < found.tides.max() < 0.1
    merged = Pairs(pairs.mass, pairs.log_g, np.zeros(2000, bool), pairs.axis)
    assert not draw(merged).is_variable.any()


@pytest.fixture(scope="module")
def dwarfs():
    """300,000 primaries of 0.7 to 1.6 Msun of the thin disc: number of primaries, and their binaries."""
    galaxy, rng, n = milky_way.milky_way(), np.random.default_rng(3), 300_000
    own = galaxy.pieces.take(slice(galaxy.first[0, 0], galaxy.first[0, -1]))
    mass = 10.0 ** own.log_mass.mean(0)
    own = own.take((own.stage == stellar_populations.DWARF) & (mass > 0.7) & (mass < 1.6))
    chosen, along = rng.choice(own.number.size, n, p=own.number / own.number.sum()), rng.random(n)
    mass, log_g = (ends[0, chosen] + (ends[1, chosen] - ends[0, chosen]) * along for ends in (own.log_mass, own.log_g))
    second = companions.draw(galaxy.tracks, own.track[chosen], 10.0**mass, rng)
    first = 10.0 ** mass[second.primary]
    axis, _, _ = companions.draw_orbits(first, second.mass, rng)
    masses, gravities = np.stack([first, second.mass]), np.stack([log_g[second.primary], second.log_g])
    return n, Pairs(masses, gravities, np.ones(axis.size, bool), axis)


def test_fraction_of_close_binaries(dwarfs):
    """Kepler: 1.3 % of the targets have eclipses or tides (Kirk et al. 2016, AJ 151, 68).

    Contact binaries with eclipses: 1 in 500 (Rucinski 2002, PASP 114, 1124). Sample of 300,000 primaries, of which 3400
    are close binaries and 700 contact binaries (4 % at 1 standard error).
    """
    n, pairs = dwarfs
    found = draw(pairs)
    assert np.sum(found.is_variable.any(0)) / n == pytest.approx(0.013, rel=0.25)
    has_eclipse = (found.duration > 0.0).any(0) & found.is_variable.any(0)
    assert 0.004 < np.sum(has_eclipse) / n < 0.013
    touching = found.period[0] > 1.0001 * eclipses.period_of_orbit(pairs.axis, pairs.mass.sum(0))
    assert np.sum(touching & has_eclipse) / n == pytest.approx(1 / 500, rel=0.4)


def test_all_that_vary_are_candidates(dwarfs):
    _, pairs = dwarfs
    cosine = PerSourceGenerator(np.arange(pairs.axis.size), 1, "test").random()
    found = np.flatnonzero(draw(pairs).is_variable.any(0))
    candidates = eclipses.may_vary(pairs, cosine)
    assert np.isin(found, candidates).all()
    assert candidates.size < 0.1 * pairs.axis.size
