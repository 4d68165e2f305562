"""A PSF on the nodes of a coarse grid keeps its moments, and sparse sums agree with products of matrices."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import signal

from truesky.render.drawing import psf_on_nodes
from truesky.render.psf.model import SAMPLES


@given(st.integers(1, 60), st.sampled_from([4, 8]), st.floats(-4.0, 4.0), st.floats(-40.0, 40.0))
def test_samples_on_nodes_keep_what_any_quartic_sees(half, block, curve, slope):
    """A sample spread over a pixel has the same mean on the nodes as on the sky."""
    first, shares = psf_on_nodes._shares(2 * half + 1, block, SAMPLES)
    nodes = block * (first[:, None] + np.arange(5) - first[half] - 2)
    seen = np.linspace(-0.5, 0.5, 2001)
    at = (np.arange(-half, half + 1) / SAMPLES)[:, None] + 0.5 * (seen[1:] + seen[:-1])

    def quartic(x):
        x = x / block
        return x**4 + curve * x**3 + x**2 + slope * x + 1.0

    np.testing.assert_allclose((shares * quartic(nodes)).sum(axis=1), quartic(at).mean(axis=1), rtol=1e-6, atol=1e-5)


@pytest.mark.parametrize("block", [2, 8])
def test_an_image_on_nodes_is_a_product_of_matrices(block):
    image = np.random.default_rng(4).normal(size=(41, 63))
    sides = []
    for length in image.shape:
        first, shares = psf_on_nodes._shares(length, block, SAMPLES)
        matrix = np.zeros((length, int(first[-1]) + 5))
        np.put_along_axis(matrix, first[:, None] + np.arange(5), shares, axis=1)
        sides.append(matrix)
    np.testing.assert_allclose(
        psf_on_nodes._to_nodes(image, block, SAMPLES), sides[0].T @ image @ sides[1], rtol=0.0, atol=1e-12
    )


def test_convolution_is_that_of_scipy():
    rng = np.random.default_rng(8)
    image, kernel = rng.normal(size=(53, 40)), rng.normal(size=(9, 9))
    np.testing.assert_array_equal(
        psf_on_nodes.convolve_inside(image, kernel), signal.fftconvolve(image, kernel, mode="valid")
    )
