"""Colours: parts of a band, and the photons of each source in them, against direct integration."""

import numpy as np
import pyarrow as pa

from jobs.fluxes import passbands
from jobs.render import chromatic

BAND = passbands.load("euclid_vis")


def test_parts_carry_equal_photons_of_flat_f_nu_and_make_up_the_band():
    parts = chromatic.sub_bands(BAND)
    width = np.array([passbands.log_width(part) for part in parts])
    np.testing.assert_allclose(width / width.sum(), 1 / chromatic.PARTS, rtol=5e-3)
    np.testing.assert_array_equal(np.concatenate([part.wavelength for part in parts]), BAND.wavelength)


def test_without_a_spectrum_the_colour_is_flat():
    rows = pa.table({"id": [1, 2]})
    for found in (chromatic.galaxies(rows, BAND), chromatic.stars(rows, BAND)):
        np.testing.assert_array_equal(found, np.full((2, chromatic.PARTS), 1 / chromatic.PARTS))
