"""The fit to isochrones: against published turn-offs and the Sun, in order everywhere."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from truesky.catalogue.stars import isochrones

# [M/H], age Gyr: Teff K and log g of the hottest point, its initial mass; BaSTI (Pietrinferni et al. 2004).
TURN_OFFS = {
    (-2.0, 12.5): (6585, 4.16, 0.768),
    (-1.5, 12.5): (6439, 4.19, 0.772),
    (-1.0, 12.5): (6227, 4.21, 0.788),
    (-1.0, 10.0): (6385, 4.19, 0.837),
    (-0.5, 10.0): (6100, 4.20, 0.886),
}


@pytest.mark.parametrize(("metallicity", "age"), TURN_OFFS)
def test_turn_offs_are_those_of_another_code(metallicity, age):
    """Two codes' turn-offs differ by 1.5 %, our fit from its own by 0.5 %."""
    found = isochrones.isochrones([age], [metallicity])
    k = found.log_teff[0, : found.main_sequence + 4].argmax()
    teff, log_g, mass = TURN_OFFS[metallicity, age]
    assert 10.0 ** found.log_teff[0, k] == pytest.approx(teff, rel=0.02)
    assert found.log_g[0, k] == pytest.approx(log_g, abs=0.12)
    assert found.mass[0, k] == pytest.approx(mass, rel=0.03)


def test_giants_end_where_helium_is_lit():
    """The tip of the red giant branch: M_bol = -3.6 of metal-poor old stars (Bellazzini et al. 2001, ApJ 556, 635)."""
    found = isochrones.isochrones([12.5], [-1.5])
    tip = found.main_sequence - 1 + isochrones.FLASH
    assert 4.74 - 2.5 * found.log_l[0, tip] == pytest.approx(-3.6, abs=0.15)
    assert 10.0 ** found.log_teff[0, tip] == pytest.approx(4150, rel=0.05)
    # The horizontal branch, M_V = 0.6, is a hundred times fainter than 16 of these.
    assert 1.5 < found.log_l[0, tip + 2] < 1.8


@given(st.floats(0.063, 15.0), st.floats(-3.0, 0.7))
def test_masses_ascend_and_nothing_is_out_of_bounds(age, metallicity):
    found = isochrones.isochrones([age], [metallicity])
    assert np.all(np.diff(found.mass) > 0)
    assert np.all((found.log_teff > 3.4) & (found.log_teff < 4.5))
    assert np.all((found.log_l > -2.0) & (found.log_l < 5.0))
    assert np.all((found.log_g > -1.0) & (found.log_g < 5.2))


@given(st.floats(1.0, 13.0), st.floats(-2.3, 0.3))
def test_neighbouring_ages_and_metallicities_are_alike(age, metallicity):
    """No steps: 1 % of age and 0.01 of [M/H] change the main sequence by less than 1 % of temperature."""
    near = isochrones.isochrones([age, age * 1.01, age], [metallicity, metallicity, metallicity + 0.01])
    main = near.log_teff[:, : near.main_sequence]
    assert np.abs(main[1:] - main[0]).max() < 0.0044


def test_old_stars_are_lighter_and_metal_poor_ones_hotter():
    found = isochrones.isochrones([3.0, 8.0, 13.0, 13.0], [0.0, 0.0, 0.0, -1.5])
    leaves = found.mass[:, found.main_sequence - 1]
    assert np.all(np.diff(leaves) < 0)
    assert np.all(found.log_teff[3, :8] > found.log_teff[2, :8])


def test_the_table_says_what_it_is_a_fit_to_and_how_well():
    head = [line for line in isochrones.TABLE.read_text().splitlines() if line.startswith("#")]
    text = " ".join(head)
    assert "Choi et al. 2016" in text
    assert text.count("% rms") == 9
    assert isochrones.TABLE.stat().st_size < 100_000
