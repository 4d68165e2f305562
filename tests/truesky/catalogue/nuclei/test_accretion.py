"""Tests of the accretion rates, types and black holes of active nuclei."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from truesky.catalogue.nuclei import accretion
from truesky.variability import nuclear_luminosity

LAWS = accretion.laws()


@given(st.floats(-4.9, -0.1), st.floats(0.0, 6.0))
def test_the_share_above_a_rate_is_the_integral_of_the_law(log_rate, z):
    """`specific_rate` is the inverse of the share, which is summed here in steps of the rate."""
    law = LAWS.accretion
    growth = ((1.0 + min(z, law.z_last)) / (1.0 + law.z_pivot)) ** law.z_slope
    log_x = np.linspace(log_rate, law.log_rates[1], 4001)
    density = 10.0**law.log_share * growth * 10.0 ** (-law.slope * log_x)
    share = np.trapezoid(density, log_x)
    found = accretion.specific_rate(law, np.array([share]), np.array([z]))
    assert found == pytest.approx([log_rate], abs=1e-4)


def test_shares_of_active_galaxies():
    """Above 1 % of the Eddington luminosity at z = 0.6: 10^-3.05 (0.01^-0.65 - 1) / (0.65 ln 10) = 1.1 %.

    Sample: 100,000 galaxies. Significance: 4.5 standard deviations (7e-6).
    """
    n = 100_000
    nuclei = accretion.draw(replace(LAWS, faintest_quasar=-99.0), np.arange(n), 3, np.full(n, 0.6), np.full(n, 10.5))
    active = accretion.has_nucleus(nuclei)
    expected = 10.0**-3.05 * (0.01**-0.65 - 1.0) / (0.65 * np.log(10.0))
    scatter = np.sqrt(expected / n)
    assert (active & (nuclei.log_rate > -2.0)).mean() == pytest.approx(expected, abs=4.5 * scatter)
    assert active.mean() == pytest.approx(0.25, abs=4.5 * np.sqrt(0.25 * 0.75 / n))


def test_small_galaxies_have_none_and_luminous_type_1_are_quasars():
    n = 50_000
    z, mass = np.repeat([0.2, 1.5], n), np.full(2 * n, 11.5)
    nuclei = accretion.draw(LAWS, np.arange(2 * n), 3, z, mass)
    magnitude = nuclear_luminosity.ultraviolet_magnitude(nuclei.log_luminosity)
    luminous = magnitude < LAWS.faintest_quasar
    visible = nuclei.type == accretion.TYPE_1
    assert (luminous & visible & (z < 0.3)).any()
    assert not (luminous & visible & (z > 0.3)).any()
    assert (luminous & (nuclei.type == accretion.TYPE_2) & (z > 0.3)).any()
    small = accretion.draw(LAWS, np.arange(n), 3, np.full(n, 1.5), np.full(n, 9.4))
    assert not accretion.has_nucleus(small).any()


def test_nuclei_do_not_depend_on_other_galaxies_or_the_precision_of_columns():
    ids, z, mass = np.arange(1000), np.linspace(0.1, 3.0, 1000), np.linspace(9.6, 11.6, 1000)
    every = accretion.draw(LAWS, ids, 3, z, mass)
    some = accretion.draw(LAWS, ids[::7], 3, z[::7].astype(np.float32), mass[::7].astype(np.float32))
    np.testing.assert_array_equal(some.type, every.type[::7])
    np.testing.assert_array_equal(some.log_luminosity, every.log_luminosity[::7])


def test_luminous_nuclei_are_less_often_hidden():
    share = accretion.obscured_share(LAWS.types, np.array([41.0, 43.89 + np.log10(25.0), 47.5]))
    assert share == pytest.approx([0.7, 0.56, 0.1], abs=0.05)


def test_black_holes():
    """Kormendy & Ho 2013: 4.9e8 Msun for a bulge of 1e11 Msun, and never above the Eddington luminosity."""
    args = np.array([11.0, 11.0, 9.5]), np.array([1.0, 0.1, 0.1]), np.array([43.0, 43.0, 45.0])
    mass = accretion.black_hole_mass(LAWS, *args, np.zeros(3))
    assert mass == pytest.approx([8.69, 8.69 - 1.16, 45.0 - np.log10(1.3e38)])


def test_black_holes_of_quasars():
    """MacLeod et al. 2010: log M = 2 - 0.27 M_i, 8.75 at M_i = -25, with a scatter of 0.305 dex."""
    m_1450 = np.full(2, -25.0 + 1.486)
    assert accretion.quasar_black_hole_mass(LAWS, m_1450, np.array([0.0, 1.0])) == pytest.approx([8.75, 9.055])
