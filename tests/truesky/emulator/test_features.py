"""Test the features of sources: radii, neighbours and their light."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lake_schema.ids import source_id
from truesky.emulator import features


def sources(n, seed, side=60.0):
    """Return identifiers, positions (deg) and fluxes of n sources in a square with this side in arcsec."""
    rng = np.random.default_rng(seed)
    ra, dec = (centre + rng.uniform(0.0, side / 3600.0, n) for centre in (150.0, 2.0))
    return source_id(0, 5, np.arange(n)), ra, dec, rng.lognormal(0.0, 1.5, n)


def test_radius_of_a_galaxy_lies_between_those_of_its_components():
    radius = features.circular_radius(
        np.array([0.0, 1.0, 0.5]), (np.full(3, 0.2), np.ones(3)), (np.full(3, 1.0), np.full(3, 0.25))
    )
    assert radius == pytest.approx([0.5, 0.2, 0.35])


def test_radius_of_a_gaussian_psf():
    """A Gaussian with standard deviation s has the effective area 4 pi s^2, and half of its light within 1.177 s."""
    assert features.psf_radius(4.0 * np.pi * 0.3**2) == pytest.approx(0.3 * np.sqrt(2.0 * np.log(2.0)))


def test_stars_and_quasars_are_points():
    kinds = np.arange(6)
    assert list(np.flatnonzero(features.is_point(source_id(kinds, 5, kinds)))) == [2, 5]


@given(st.integers(0, 60), st.integers(0, 1000))
def test_neighbours_are_those_of_a_comparison_of_all_pairs(n, seed):
    """The tree finds the same pairs as a comparison of all sources with each other."""
    ids, ra, dec, flux = sources(n, seed)
    is_bright = flux > 3.0
    pairs = features.find_neighbours(ids, ra, dec, is_bright)
    distance = np.hypot((ra[:, None] - ra) * np.cos(np.radians(dec.mean() if n else 0.0)), dec[:, None] - dec) * 3600.0
    expected = (distance <= features.NEAR) | ((distance <= features.FAR) & is_bright)
    np.fill_diagonal(expected, False)
    found = np.zeros((n, n), bool)
    found[pairs.source, pairs.neighbour] = True
    unsure = (abs(distance - features.NEAR) < 1e-3) | (abs(distance - features.FAR) < 1e-3)
    assert (found == expected)[~unsure].all()
    assert len(pairs.source) == found.sum()


@given(st.integers(2, 40), st.integers(0, 1000))
def test_light_of_neighbours_does_not_depend_on_the_order_of_sources(n, seed):
    ids, ra, dec, flux = sources(n, seed, 20.0)
    order = np.random.default_rng(seed).permutation(n)

    def light(rows):
        bright = flux[rows] > 3.0
        pairs = features.find_neighbours(ids[rows], ra[rows], dec[rows], bright)
        return features.neighbour_light(pairs, flux[rows], np.full(n, 0.3), bright)

    assert (light(order) == light(np.arange(n))[order]).all()


def test_light_of_one_neighbour():
    """At its half-light radius h, a neighbour has 1/4 of its central surface brightness f / (pi h^2)."""
    pairs = features.Neighbours(np.array([0, 1]), np.array([1, 0]), np.array([0.5, 0.5]))
    light = features.neighbour_light(pairs, np.array([1.0, 8.0]), np.array([0.5, 0.5]), np.array([False, True]))
    assert light == pytest.approx([np.log10(2.0), np.log10(1.0 / 32.0)])


def test_neighbours_beyond_the_near_limit_count_only_if_they_are_bright():
    pairs = features.Neighbours(np.array([0, 1]), np.array([1, 0]), np.array([5.0, 5.0]))
    light = features.neighbour_light(pairs, np.array([1.0, 1e5]), np.array([0.5, 0.5]), np.array([False, True]))
    assert light[0] > 0.0
    assert light[1] == -2.0
    assert features.neighbour_light(pairs, np.array([0.0, 1.0]), np.array([0.5, 0.5]), np.ones(2, bool))[0] == 2.0
