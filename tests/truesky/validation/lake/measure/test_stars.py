"""Measurements of stars with known light."""

import numpy as np
import pytest

from truesky.validation.lake.measure import stars


@pytest.mark.parametrize("sigma", np.linspace(0.6, 2.0, 8))
def test_half_of_the_light_of_a_gaussian(sigma):
    """Few of the apertures are as narrow as the star."""
    radii = stars._APERTURES * 20.0
    growth = np.outer([1e4, 2e4, 5e5], 1.0 - np.exp(-0.5 * (radii / sigma) ** 2))
    found = stars._half_light(growth, np.array([1e4, 2e4, 5e5]), radii)
    assert found == pytest.approx(sigma * np.sqrt(2.0 * np.log(2.0)), rel=2e-3)
