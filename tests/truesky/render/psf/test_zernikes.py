"""Sums of Zernike polynomials agree with galsim's, and their coefficients are added in a fixed order."""

import galsim
import numpy as np
import pytest

from truesky.render.psf.zernikes import sum_of_zernikes


@pytest.mark.parametrize("last", [1, 4, 11, 22, 55])
def test_sums_agree_with_galsim(last):
    rng = np.random.default_rng(last)
    coefficients = rng.normal(size=last + 1)
    x, y = rng.uniform(-1.0, 1.0, (2, 40, 50))
    expected = galsim.zernike.Zernike(coefficients)(x, y)
    found = sum_of_zernikes(coefficients, x, y)
    assert found.shape == (40, 50)
    assert found == pytest.approx(expected, rel=0, abs=1e-13 * np.abs(expected).max() * last)


def test_astigmatism_and_coma_have_their_formulas():
    x, y = np.random.default_rng(1).uniform(-1.0, 1.0, (2, 100))
    for noll, formula in ((5, np.sqrt(6) * 2 * x * y), (7, np.sqrt(8) * (3 * (x**2 + y**2) - 2) * y)):
        one = np.zeros(noll + 1)
        one[noll] = 1.0
        assert sum_of_zernikes(one, x, y) == pytest.approx(formula, rel=0, abs=1e-14)


def test_no_coefficients_are_no_wavefront():
    assert (sum_of_zernikes(np.zeros(23), np.linspace(-1, 1, 5), np.zeros(5)) == 0).all()
