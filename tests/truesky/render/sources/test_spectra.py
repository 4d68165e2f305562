"""Spectra of sources, normalised to one photon that the band detects."""

import numpy as np
import pyarrow as pa
import pytest

from truesky.fluxes import high_redshift, passbands, wavelength_windows
from truesky.fluxes.libraries import templates
from truesky.fluxes.sources import galaxies_from_table, stars_from_table
from truesky.render.sources import colours, spectra

BAND = passbands.load("nisp_red")
FIRST, COUNT = int(BAND.wavelength[0]), len(BAND.wavelength)
SUN = np.linspace(2.0, 1.0, COUNT)


def galaxies():
    """Return a galaxy with a line, a quasar, and another galaxy."""
    columns = {name: [0.0] * 3 for name in colours.GALAXY_COLUMNS}
    columns |= {
        "id": [1, 2, 3], "kind": [0, 2, 1], "z_obs": [1.3, 2.0, 0.4], "abs_mag_r01": [-20.0] * 3, "mag_r01": [22.0] * 3,
        "frac_1": [1.0] * 3, "sed_1": [4, 3, 20], "flux_halpha": [3e-16, 0.0, 0.0],
    }  # fmt: skip
    return pa.table(columns)


STARS = pa.table({"id": [7, 8], "sed": [5, 9], "mag_h": [18.0, 20.0], "a_v": [0.1, 0.3]})


def test_each_source_has_its_own_of_one_photon():
    which = np.array([3, 0, -1, 1, 2, 4])
    found = spectra.spectrum_function(which, galaxies(), STARS, BAND, SUN)(np.arange(6))
    np.testing.assert_allclose((found * BAND.response * BAND.wavelength).sum(axis=1), 1.0, rtol=1e-5)
    library, stellar = templates.galaxy_library(), templates.stellar_library()
    usual = wavelength_windows.galaxy_spectra(
        galaxies_from_table(galaxies().take([0, 2]), library), FIRST, COUNT, library
    )
    quasar = high_redshift.spectra(galaxies().slice(1, 1))[0, BAND.first : BAND.first + COUNT]
    stars = wavelength_windows.star_spectra(stars_from_table(STARS, stellar), FIRST, COUNT, stellar)
    for own, wanted in zip(found, (stars[0], usual[0], SUN, quasar, usual[1], stars[1]), strict=True):
        np.testing.assert_allclose(own / own.sum(), wanted / wanted.sum(), rtol=1e-4, atol=1e-9)


def test_some_of_them_in_any_order_are_the_same():
    of = spectra.spectrum_function(np.array([3, 0, -1, 1, 2, 4]), galaxies(), STARS, BAND, SUN)
    np.testing.assert_array_equal(of(np.array([4, 1])), of(np.arange(6))[[4, 1]])


def test_without_a_spectrum_it_is_flat():
    rows = pa.table({"id": [1, 2]})
    found = spectra.spectrum_function(np.array([0, 2]), rows, rows, BAND, SUN)(np.array([0, 1]))
    np.testing.assert_allclose(found[0] * BAND.wavelength**2, found[0, 0] * BAND.wavelength[0] ** 2, rtol=1e-5)
    np.testing.assert_array_equal(found[0], found[1])


def test_nothing_detected_is_nothing():
    found = spectra.spectrum_function(np.array([-1]), STARS.slice(0, 0), STARS.slice(0, 0), BAND, np.zeros(COUNT))(
        np.array([0])
    )
    assert found == pytest.approx(np.zeros((1, COUNT)))
