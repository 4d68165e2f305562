"""Spectra over a stretch of wavelengths: those of whole spectra."""

import numpy as np

from truesky.fluxes import band_fluxes, passbands, stretches
from truesky.fluxes.sources import galaxies_of, stars_of

FIRST, COUNT = 12060, 6861


def whole(spectra):
    low = FIRST - passbands.GRID_FIRST
    return spectra[:, low : low + COUNT]


def test_galaxies_are_their_whole_spectra(galaxies, library):
    galaxies = galaxies(40)
    rows = galaxies_of(galaxies, library)
    found = stretches.galaxies(rows, FIRST, COUNT, library)
    wanted = whole(band_fluxes.galaxy_spectra(galaxies, library))
    np.testing.assert_allclose(found, wanted, rtol=2e-6, atol=1e-6 * np.abs(wanted).max())
    # Of each alone, too.
    some = stretches.galaxies(rows.rows(np.array([3, 1])), FIRST, COUNT, library)
    np.testing.assert_allclose(some, found[[3, 1]], rtol=2e-6)


def test_stars_are_their_whole_spectra(stars, stars_library):
    stars = stars(40)
    found = stretches.stars(stars_of(stars, stars_library), FIRST, COUNT, stars_library)
    np.testing.assert_allclose(found, whole(band_fluxes.star_spectra(stars, stars_library)), rtol=1e-6)


def test_no_rows(galaxies, library):
    galaxies = galaxies(40)
    rows = galaxies_of(galaxies.slice(0, 0), library)
    assert stretches.galaxies(rows, FIRST, COUNT, library).shape == (0, COUNT)
