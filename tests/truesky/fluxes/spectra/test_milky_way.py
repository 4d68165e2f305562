"""The extinction law of the Milky Way at any wavelength."""

import numpy as np

from truesky.fluxes.spectra import extinction, milky_way


def test_whole_numbers_have_the_values_of_the_table():
    at = np.array([600.0, 5500.0, 24000.0])
    expected = [extinction.milky_way_table(int(wavelength), 1)[0] for wavelength in at]
    np.testing.assert_array_equal(milky_way.law(at), expected)


def test_other_wavelengths_are_interpolated():
    at = np.array([5500.0, 5501.0])
    below, above = milky_way.law(at)
    np.testing.assert_allclose(milky_way.law(np.array([5500.25]))[0], 0.75 * below + 0.25 * above, rtol=1e-14)
    np.testing.assert_array_equal(milky_way.law(np.array([10.0, 1e5])), milky_way.law(np.array([600.0, 24000.0])))
