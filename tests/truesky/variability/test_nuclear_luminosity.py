"""Tests of luminosities and magnitudes of nuclei."""

import numpy as np
import pytest

from truesky.variability import nuclear_luminosity


def test_a_quasar_of_the_break_has_the_luminosity_of_its_photons():
    """M_1450 = -25.1: L_nu = 10^(-0.4 (M + 48.6)) 4 pi (10 pc)^2 = 4.76e30 erg/s/Hz, at 2.0675e15 Hz, times 4.2."""
    expected = np.log10(4.2 * 2.0675e15 * 10.0 ** (-0.4 * 23.5) * 1.19649e40)
    assert nuclear_luminosity.log_luminosity(np.array([-25.1])) == pytest.approx([expected], abs=1e-4)


def test_magnitude_and_luminosity_are_inverse():
    m = np.linspace(-30.0, -10.0, 9)
    again = nuclear_luminosity.ultraviolet_magnitude(nuclear_luminosity.log_luminosity(m))
    assert again == pytest.approx(m, abs=1e-10)


def test_the_i_band_is_brighter_for_a_red_continuum():
    """Richards et al. 2006: M_i (z = 2) is M_1450 - 1.486, with the 2.5 log10(1 + z) at z = 2."""
    assert nuclear_luminosity.i_magnitude(np.array([-24.0])) == pytest.approx([-25.486])
