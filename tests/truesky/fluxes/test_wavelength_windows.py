"""Compare spectra in one range of wavelengths with whole spectra."""

import numpy as np

from truesky.fluxes import band_fluxes, passbands, wavelength_windows
from truesky.fluxes.sources import galaxies_from_table, stars_from_table

FIRST, COUNT = 12060, 6861


def whole(spectra):
    low = FIRST - passbands.GRID_FIRST
    return spectra[:, low : low + COUNT]


def test_galaxies_are_their_whole_spectra(galaxies, library):
    galaxies = galaxies(40)
    rows = galaxies_from_table(galaxies, library)
    found = wavelength_windows.galaxy_spectra(rows, FIRST, COUNT, library)
    wanted = whole(band_fluxes.galaxy_spectra(galaxies, library))
    np.testing.assert_allclose(found, wanted, rtol=2e-6, atol=1e-6 * np.abs(wanted).max())
    # The result is the same for each source alone.
    some = wavelength_windows.galaxy_spectra(rows.select(np.array([3, 1])), FIRST, COUNT, library)
    np.testing.assert_allclose(some, found[[3, 1]], rtol=2e-6)


def test_stars_are_their_whole_spectra(stars, stars_library):
    stars = stars(40)
    found = wavelength_windows.star_spectra(stars_from_table(stars, stars_library), FIRST, COUNT, stars_library)
    np.testing.assert_allclose(found, whole(band_fluxes.star_spectra(stars, stars_library)), rtol=1e-6)


def test_no_rows(galaxies, library):
    galaxies = galaxies(40)
    rows = galaxies_from_table(galaxies.slice(0, 0), library)
    assert wavelength_windows.galaxy_spectra(rows, FIRST, COUNT, library).shape == (0, COUNT)
