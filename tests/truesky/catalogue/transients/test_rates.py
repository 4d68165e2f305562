"""Rates of supernovae per volume and per galaxy."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from truesky.catalogue.transients import rates


def test_published_rates_per_volume():
    """Published: Ia 2.4e-5 (1+z)^1.5 per year and Mpc^3 (h = 0.7); core collapse 7.0e-5, and 6 times at z = 1."""
    law, z = rates.rates(), np.array([0.0, 0.015, 0.5, 1.0])
    np.testing.assert_allclose(rates.type_ia_per_volume(law, z, 0.7), 2.4e-5 * (1.0 + z) ** 1.5)
    assert rates.core_collapse_per_volume(law, z, 0.7)[1] == pytest.approx(7.0e-5, rel=1e-12, abs=0)
    ratio = rates.core_collapse_per_volume(law, z, 0.7)[3] / rates.core_collapse_per_volume(law, z, 0.7)[0]
    assert ratio == pytest.approx(5.8, abs=0.3)
    assert rates.type_ia_per_volume(law, z, 0.67)[0] == pytest.approx(2.4e-5 * (0.67 / 0.7) ** 3, rel=1e-12, abs=0)


def test_rates_are_continuous_at_the_break():
    law = rates.rates()
    below, above = rates.type_ia_per_volume(law, law.z_break + np.array([-1e-9, 1e-9]), 0.7)
    assert below == pytest.approx(above, rel=1e-8, abs=0)


def test_a_galaxy_like_the_milky_way():
    """Sample: one galaxy of 10^10.7 Msun with 2 Msun/yr; observed in the Milky Way: 0.5 Ia and 1.5 others a century."""
    ia, others = rates.expected_rates(np.array([10.7]), np.array([0.3]), np.array([0.01]))
    assert 0.2 < 100.0 * ia[0] < 1.5
    assert 0.5 < 100.0 * others[0] < 6.0


@given(st.floats(-3.0, 12.5), st.floats(-6.0, 4.0), st.floats(0.0, 15.0))
def test_rates_are_finite_and_increase(log_mass, log_sfr, z):
    mass, sfr = np.array([log_mass, log_mass + 0.1, log_mass]), np.array([log_sfr, log_sfr, log_sfr + 0.1])
    ia, others = rates.expected_rates(mass, sfr, np.full(3, z))
    assert np.isfinite([ia, others]).all()
    assert ia[1] > ia[0]
    assert others[2] > others[0]
    assert others[1] == others[0]
