"""Variance of a pixel with charge shared by neighbours, and with offsets of rows, columns and slopes."""

import numpy as np
import pytest
import scipy.ndimage

from truesky.validation.lake.measure.covariances import pixel_variance


@pytest.mark.parametrize("near", [0, 1, 2])
def test_the_variance_that_neighbours_share(near):
    """Rows and columns have offsets, a slope is added, and half of the pixels are masked."""
    rng = np.random.default_rng(5)
    size, reach = 2 * near + 1, 0.02
    kernel = np.full((size, size), reach / max(size**2 - 1, 1))
    kernel[near, near] = 1.0 - reach if near else 1.0
    values = scipy.ndimage.convolve(rng.standard_normal((200, 64, 64)) * 7.0, kernel[None], mode="reflect")
    values += 2.0 * rng.standard_normal((200, 64, 1)) + 1.5 * rng.standard_normal((200, 1, 64))
    values += np.linspace(-5.0, 5.0, 64)
    kept = rng.random(values.shape) < 0.5
    plain = float(np.var(values[kept]))
    value, error = pixel_variance(np.where(kept, values, 1e6), kept, near)
    assert value == pytest.approx(49.0, abs=4.0 * error)
    assert error < 2.0
    assert abs(plain - 49.0) > 5.0 * error
