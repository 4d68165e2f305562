"""Initial masses, evolution and local densities of stellar populations."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from truesky.catalogue import parameters
from truesky.catalogue.stars import milky_way
from truesky.catalogue.stars import stellar_populations as populations

MASSES = populations.MassFunction(**parameters.section("milky_way.toml", "mass_function"))
EDGES = np.arange(-9.0, 14.05, 0.1)


def systems_between(low, high):
    """Number of systems of one main-sequence track from `low` to `high` Msun; it is 1 below 1 Msun."""
    log_mass = np.linspace(np.log10(low), np.log10(high), 30)[None, :]
    flat = np.zeros_like(log_mass)
    track = populations.Tracks(np.ones(1), np.zeros(1), log_mass.size, log_mass, flat, flat, flat)
    return populations.build_pieces(track, np.ones(1), MASSES, EDGES).number.sum()


def test_stars_between_the_hydrogen_limit_and_the_sun():
    """Local density of stellar systems, Chabrier 2003: 0.07 - 0.08 pc^-3."""
    assert systems_between(0.075, 1.0) == pytest.approx(1.0)
    assert systems_between(0.01, 0.0749) == 0.0
    # Discs and halo together, white dwarfs left out; the bulge comes last.
    galaxy = milky_way.milky_way()
    pieces = galaxy.pieces.take(np.arange(galaxy.first[-1, 0]))
    light = (pieces.track >= 0) & (pieces.log_mass.mean(0) < 0.0)
    assert pieces.number[light].sum() == pytest.approx(0.075, rel=0.01)


def test_masses_follow_the_broken_power_law():
    def law(m):
        return m**-1.3 if m < 0.5 else 0.5 * m**-2.3 if m < 1.0 else 0.5 * m**-2.5

    norm = 1.0 / quad(law, 0.075, 1.0, points=[0.5])[0]
    for low, high in ((0.1, 0.3), (0.3, 0.8), (0.8, 2.0), (2.0, 9.0)):
        assert systems_between(low, high) == pytest.approx(norm * quad(law, low, high, points=[0.5, 1.0])[0], rel=1e-6)


@given(st.floats(0.01, 100.0), st.floats(0.01, 100.0))
def test_more_stars_are_below_a_larger_mass(m1, m2):
    low, high = (systems_between(0.005, mass) for mass in sorted((m1, m2)))
    assert 0.0 <= low <= high * (1 + 1e-12) < 4.0 / 3.0


@pytest.fixture(scope="module")
def tracks():
    return populations.build_tracks(np.array([5.0, 10.0, 12.5]), np.array([0.0, -0.6, -1.5]))


def test_the_sun_is_on_its_track(tracks):
    """1 Msun, 4.6 Gyr: 5772 K, M_H = 3.3, log g = 4.44 (IAU 2015; Willmer 2018, ApJS 236, 47)."""
    sun = populations.build_tracks(np.array([4.6]), np.zeros(1))
    found = {name: np.interp(0.0, sun.log_mass[0, : sun.evolved], getattr(sun, name)[0, : sun.evolved])
             for name in ("log_teff", "m_h", "log_g")}  # fmt: skip
    assert 10 ** found["log_teff"] == pytest.approx(5772, rel=0.015)
    assert found["m_h"] == pytest.approx(3.30, abs=0.1)
    assert found["log_g"] == pytest.approx(4.44, abs=0.03)


def test_light_dwarfs_are_those_nearby(tracks):
    """Pecaut & Mamajek 2013: an M4V has 0.23 Msun, 3210 K, M_H = 7.7; old ones have the same M_H and are hotter."""
    at = [np.interp(np.log10(0.23), mass, values) for mass, values in zip(tracks.log_mass, tracks.m_h, strict=True)]
    assert at == pytest.approx([7.7] * 3, abs=0.25)
    teff = [10 ** np.interp(np.log10(0.23), m, t) for m, t in zip(tracks.log_mass, tracks.log_teff, strict=True)]
    assert teff[0] == pytest.approx(3210, abs=100)
    assert teff[0] + 50 < teff[1] < teff[2] < teff[0] + 900


def test_tracks_go_up_in_mass_and_the_main_sequence_in_light(tracks):
    assert np.all(np.diff(tracks.log_mass, axis=1) > 0)
    # Where nearby dwarfs go over into isochrones, too.
    below = slice(None), slice(None, tracks.evolved - 6)
    assert np.all(np.diff(tracks.m_h[below], axis=1) < 0)


def test_pieces_are_the_mass_function_cut_at_the_bins(tracks):
    share = np.array([0.5, 0.3, 0.2])
    found = populations.build_pieces(tracks, share, MASSES, EDGES)
    for k in range(3):
        own = found.number[found.track == k].sum()
        heaviest = 10 ** tracks.log_mass[k, -1]
        lightest = 10 ** tracks.log_mass[k, 0]
        wanted = systems_between(lightest, heaviest) * share[k]
        # Except for the helium flash, and for stars outside all bins.
        assert own == pytest.approx(wanted, rel=0.003)
    low, high = EDGES[found.bin], EDGES[found.bin + 1]
    assert np.all(found.m_h > low - 1e-9)
    assert np.all(found.m_h < high + 1e-9)
    assert np.all(found.number > 0.0)


def test_stages_are_in_the_order_of_gravity(tracks):
    found = populations.build_pieces(tracks, np.ones(3) / 3, MASSES, EDGES)
    log_g, stage = found.log_g.mean(0), found.stage
    assert log_g[stage == populations.GIANT].max() <= 3.5
    assert log_g[stage == populations.SUBGIANT].min() > 3.5
    assert log_g[stage == populations.DWARF].min() > 3.6
    # Old populations have no heavy dwarfs, and a red clump near M_H = -1.5 (Laney et al. 2012).
    assert found.log_mass[:, (stage == populations.DWARF) & (found.track == 2)].max() < np.log10(0.82)
    giants = (stage == populations.GIANT) & (found.track == 0)
    number, _ = np.histogram(found.m_h.mean(0)[giants], np.arange(-4.0, 2.1, 0.3), weights=found.number[giants])
    assert np.arange(-4.0, 2.0, 0.3)[number.argmax()] == pytest.approx(-1.6, abs=0.35)


@given(st.floats(-2.5, 0.4), st.floats(0.05, 0.5), st.integers(4, 30))
def test_cells_of_a_population_have_its_metallicity(mean, scatter, cells):
    found = populations.build_population(np.array([1.0, 3.0]), np.array([1.0, 2.0]), np.array([mean, 0.0]),
                                   np.array([scatter, 0.1]), cells)  # fmt: skip
    assert found.share.sum() == pytest.approx(1.0)
    young = found.age == 1.0
    assert found.share[young].sum() == pytest.approx(1 / 3)
    weight = found.share[young] / found.share[young].sum()
    assert weight @ found.metallicity[young] == pytest.approx(mean, abs=1e-9)
    variance = weight @ (found.metallicity[young] - mean) ** 2 + found.width[young][0] ** 2 / 12
    assert variance**0.5 == pytest.approx(scatter, rel=0.12)


def test_white_dwarfs_cool_along_their_sequence():
    """4.6e-3 pc^-3, Harris et al. 2006; 12,000 K at M_H = 11.9, 6000 K at 12.8."""
    found = populations.white_dwarf_pieces(EDGES)
    assert found.number.sum() == pytest.approx(4e-3, rel=1e-6)
    order = np.argsort(found.log_teff.mean(0))
    at = np.interp(np.log10([12_000.0, 6000.0]), found.log_teff.mean(0)[order], found.m_h.mean(0)[order])
    assert at == pytest.approx([11.9, 12.8], abs=0.15)
