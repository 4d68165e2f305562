"""Light of lines in a band: that of spectra with their lines, integrated."""

import numpy as np
import pytest

from jobs.catalogue.galaxies import line_light
from jobs.fluxes import passbands
from jobs.fluxes.spectra import lines
from lake_schema.units import AB_CGS


@pytest.mark.parametrize("band", ["euclid_vis", "euclid_h", "lsst_g"])
def test_added_light_is_that_of_the_spectrum(band, rng):
    n, curve = 300, passbands.load(band)
    z = rng.uniform(0.0, 2.3, n)
    fluxes = {column: 1e-16 * rng.random(n) for column in lines.columns()}
    every = np.stack([line.ratio * fluxes[line.column] for line in lines.line_list()], 1)
    spectra = np.zeros((n, passbands.GRID_LAST - passbands.GRID_FIRST + 1))
    lines.add(spectra, passbands.GRID_FIRST, lines.profiles(every, z, np.full(n, 100.0), "vacuum"))
    expected = spectra[:, curve.wavelength.astype(int) - passbands.GRID_FIRST] @ passbands.weights(curve)
    found = line_light.added(curve, z, fluxes)
    # At the edges of a band a line is narrower here than it is.
    off = np.abs(found - expected) / expected.max()
    assert np.percentile(off, 95) < 0.01
    assert off.max() < 0.25
    assert found.sum() / expected.sum() == pytest.approx(1.0, abs=0.01)


def test_no_light_brightens_nothing_and_as_much_again_by_three_quarters():
    flux = 10.0 ** (-0.4 * (np.array([20.0, 26.0]) + AB_CGS))
    assert line_light.brightened(np.array([20.0, 26.0]), np.zeros(2)).tolist() == [20.0, 26.0]
    assert line_light.brightened(np.array([20.0, 26.0]), flux) == pytest.approx(
        [20.0 - 0.7526, 26.0 - 0.7526], abs=1e-4
    )
