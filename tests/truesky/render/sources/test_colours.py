"""Colours: parts of a band, and the photons of each source in them, against direct integration."""

from dataclasses import replace

import numpy as np
import pyarrow as pa

from truesky.fluxes import passbands
from truesky.fluxes.libraries import templates
from truesky.render.psf import sub_bands
from truesky.render.sources import colours

BAND = passbands.load("euclid_vis")


def test_parts_carry_equal_photons_of_flat_f_nu_and_make_up_the_band():
    parts = sub_bands.sub_bands(BAND)
    width = np.array([passbands.log_width(part) for part in parts])
    np.testing.assert_allclose(width / width.sum(), 1 / sub_bands.N_SUB_BANDS, rtol=5e-3)
    np.testing.assert_array_equal(np.concatenate([part.wavelength for part in parts]), BAND.wavelength)


def test_without_a_spectrum_the_colour_is_flat():
    rows = pa.table({"id": [1, 2]})
    for found in (colours.galaxies(rows, BAND), colours.stars(rows, BAND)):
        np.testing.assert_array_equal(found, np.full((2, sub_bands.N_SUB_BANDS), 1 / sub_bands.N_SUB_BANDS))


def galaxy(sed):
    columns = {name: [0.0] for name in colours.GALAXY_COLUMNS}
    columns |= {"id": [1], "z_obs": [0.5], "abs_mag_r01": [-20.0], "mag_r01": [22.0], "frac_1": [1.0], "sed_1": [sed]}
    return pa.table(columns)


def test_galaxies_have_the_colours_of_the_library_that_is_given():
    embedded = templates.galaxy_library()
    turned = replace(embedded, flux=embedded.flux[::-1], external=True)
    one, other = (colours.galaxies(galaxy(sed), BAND, library) for sed, library in ((3, None), (27, turned)))
    np.testing.assert_allclose(one, other, rtol=1e-5)
    assert np.abs(colours.galaxies(galaxy(3), BAND, turned) - one).max() > 0.01


def test_stars_have_the_colours_of_the_library_that_is_given():
    embedded = templates.stellar_library()
    turned = replace(embedded, flux=embedded.flux[::-1], external=True)
    rows = pa.table({"id": [1], "sed": [5], "mag_h": [18.0], "a_v": [0.1]})
    last = pa.table({"id": [1], "sed": [len(embedded) - 6], "mag_h": [18.0], "a_v": [0.1]})
    np.testing.assert_allclose(colours.stars(last, BAND, turned), colours.stars(rows, BAND), rtol=1e-5)
    assert np.abs(colours.stars(rows, BAND, turned) - colours.stars(rows, BAND)).max() > 0.01
