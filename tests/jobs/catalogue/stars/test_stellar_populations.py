"""Initial masses, evolution and local densities of stellar populations."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import quad

from jobs.catalogue import parameters
from jobs.catalogue.stars import stellar_populations as populations

MASSES = populations.MassFunction(**parameters.section("milky_way.toml", "mass_function"))
GIANTS = populations.Giants(**parameters.section("milky_way.toml", "giants"))
DWARFS = populations.dwarf_sequence()


def test_stars_between_the_hydrogen_limit_and_the_sun():
    """Local density of stellar systems, Chabrier 2003: 0.07 - 0.08 pc^-3."""
    assert populations.mass_below(MASSES, 1.0) == pytest.approx(0.075)
    assert populations.mass_below(MASSES, 0.075) == 0.0


def test_masses_follow_the_broken_power_law():
    def law(m):
        return m**-1.3 if m < 0.5 else 0.5 * m**-2.3 if m < 1.0 else 0.5 * m**-5.0

    norm = 0.075 / quad(law, 0.075, 1.0, points=[0.5])[0]
    for low, high in ((0.1, 0.3), (0.3, 0.8), (0.8, 2.0), (2.0, 9.0)):
        below = populations.mass_below(MASSES, [low, high])
        assert below[1] - below[0] == pytest.approx(norm * quad(law, low, high, points=[0.5, 1.0])[0], rel=1e-6)


@given(st.floats(0.01, 100.0), st.floats(0.01, 100.0))
def test_more_stars_are_below_a_larger_mass(m1, m2):
    low, high = populations.mass_below(MASSES, sorted((m1, m2)))
    assert 0.0 <= low <= high * (1 + 1e-12) < 0.1


def test_giants_end_at_their_local_density():
    assert populations.giants_below(GIANTS, np.array([30.0])) == pytest.approx(5e-4)
    assert populations.giants_below(GIANTS, np.array([-30.0])) == pytest.approx(0.0, abs=1e-12)
    edges = np.arange(-8.0, 0.0, 0.1)
    number = np.diff(populations.giants_below(GIANTS, edges))
    assert number.min() >= 0.0
    # The red clump, M_H = -1.49 (Laney et al. 2012), stands out of the branch.
    assert edges[np.argmax(number)] == pytest.approx(-1.5, abs=0.1)


def test_the_main_sequence_is_in_order():
    assert np.all(np.diff(DWARFS.m_h) > 0)
    assert np.all(np.diff(DWARFS.log_mass) <= 0)
    # The Sun: G2V, 5770 K, M_H = 3.3, log g = 4.44.
    assert np.interp(3.31, DWARFS.m_h, DWARFS.teff) == pytest.approx(5770, abs=60)
    assert 10 ** np.interp(3.31, DWARFS.m_h, DWARFS.log_mass) == pytest.approx(1.0, abs=0.02)
    assert np.interp(3.31, DWARFS.m_h, DWARFS.log_g) == pytest.approx(4.43, abs=0.03)


def test_old_components_have_lost_their_massive_stars():
    m_h = np.arange(-7.0, 12.0, 0.1)
    local = populations.luminosity(m_h, DWARFS, np.array([0.8, 0.15, 0.05]), np.arange(3))
    assert local.shape == (9, m_h.size - 1)
    assert local.min() >= 0.0
    bright = m_h[1:] < 2.0
    assert local[0, bright].sum() > 0.0
    assert local[1:3, bright].sum() == 0.0
    faint = m_h[:-1] > 6.0
    assert local[1, faint] == pytest.approx(local[0, faint] * 0.15 / 0.8)
    assert local[4].sum() / local[3].sum() == pytest.approx(2 * 0.15 / 0.8, rel=1e-6)
