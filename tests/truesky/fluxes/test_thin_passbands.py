"""Fluxes with a quarter of the wavelengths of a band."""

import numpy as np
import pytest

from truesky.fluxes import passbands, thin_passbands


@pytest.mark.parametrize("name", ["euclid_vis", "lsst2016_u", "sdss_i"])
def test_linear_spectra_are_exact(name):
    band = passbands.load(name)
    exact = passbands.weights(band)
    for all_below in (0.0, float(band.wavelength[1001]), 1e5):
        wavelength, weights = thin_passbands.weights(band, all_below)
        assert (np.diff(wavelength) > 0.0).all()
        assert weights.sum() == pytest.approx(exact.sum(), rel=1e-12, abs=0.0)
        assert np.sum(weights * wavelength) == pytest.approx(np.sum(exact * band.wavelength), rel=1e-12, abs=0.0)


def test_number_of_wavelengths():
    band = passbands.load("euclid_vis")
    n = len(band.wavelength)
    assert len(thin_passbands.weights(band)[0]) == -(-n // 4)
    wavelength, weights = thin_passbands.weights(band, float(band.wavelength[500]))
    assert len(wavelength) == 500 + -(-(n - 500) // 4)
    np.testing.assert_array_equal(wavelength[:500], band.wavelength[:500])
    np.testing.assert_array_equal(weights[:500], passbands.weights(band)[:500])


@pytest.mark.parametrize("width", [1, 20, 999])
def test_narrow_bands_have_all_their_wavelengths(width):
    """In a narrow band, one emission line may have most of the light."""
    band = passbands.Passband("narrow", np.arange(6500.0, 6500.0 + width), np.ones(width), "vacuum")
    wavelength, weights = thin_passbands.weights(band)
    np.testing.assert_array_equal(wavelength, band.wavelength)
    np.testing.assert_array_equal(weights, passbands.weights(band))
