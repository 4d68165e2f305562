"""The tabulated transform against closed forms and galsim."""

import galsim
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import gammaincinv

from tests.truesky import nightly
from truesky.render.sources import sersic

K = np.geomspace(2e-4, 200.0, 300)


def looked_up(index, k):
    """Linear between the nodes, as the kernel does it."""
    first, weights = sersic.interpolation_weights(np.array([index]))
    row = weights[0] @ sersic.table()[first[0] : first[0] + 4]
    return np.interp(k**2, sersic.nodes(), row)


def test_closed_forms():
    """A Gaussian for n = 1/2, (1 + k^2)^-3/2 for n = 1."""
    for index, exact in ((0.5, lambda b, k: np.exp(-(k**2) / (4 * b))), (1.0, lambda b, k: (1 + (k / b) ** 2) ** -1.5)):
        b = gammaincinv(2 * index, 0.5)
        np.testing.assert_allclose(sersic.transform(index, np.log(K)), exact(b, K), atol=1e-10)
        np.testing.assert_allclose(looked_up(index, K), exact(b, K), atol=6e-6)


@nightly.parametrize("index", [0.3, 0.47, 2.26, 4.0, pytest.param(6.2, marks=pytest.mark.nightly)], (0, 1, 2))
def test_galsim_agrees(index):
    tight = galsim.GSParams(kvalue_accuracy=1e-8, integration_relerr=1e-8, integration_abserr=1e-10)
    theirs = galsim.Sersic(index, half_light_radius=1.0, gsparams=tight)
    k = K[K < 20]
    np.testing.assert_allclose(looked_up(index, k), [theirs.kValue(x, 0.0).real for x in k], atol=6e-6)


@given(st.floats(0.3, 6.2))
def test_between_the_rows(index):
    np.testing.assert_allclose(looked_up(index, K), sersic.transform(index, np.log(K)), atol=6e-6)


def test_indices_out_of_bounds_are_held():
    np.testing.assert_array_equal(looked_up(0.1, K), looked_up(0.3, K))
    np.testing.assert_array_equal(looked_up(9.0, K), looked_up(6.2, K))
