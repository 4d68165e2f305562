"""Measurements of stars with known light."""

import numpy as np
import pytest
import scipy

from truesky.validation.lake.measure import stars


@pytest.mark.parametrize("sigma", np.linspace(0.6, 2.0, 8))
def test_half_of_the_light_of_a_gaussian(sigma):
    """Few of the apertures are as narrow as the star."""
    radii = stars._APERTURES * 20.0
    growth = np.outer([1e4, 2e4, 5e5], 1.0 - np.exp(-0.5 * (radii / sigma) ** 2))
    found = stars._half_light(growth, np.array([1e4, 2e4, 5e5]), radii)
    assert found == pytest.approx(sigma * np.sqrt(2.0 * np.log(2.0)), rel=2e-3)


def diffraction(dx, dy, side=41):
    """Return an Airy disc with a first dark ring at 1.5 pixels and bright rings outside, averaged over pixels."""
    fine = (np.arange(5 * side) - 5 * (side // 2) - 2.0) / 5.0
    z = np.pi * np.hypot(fine - dx, (fine - dy)[:, None]) / 1.22 + 1e-9
    light = (2.0 * scipy.special.j1(z) / z) ** 2
    light = light.reshape(side, 5, side, 5).sum(axis=(1, 3))
    return light / light.sum()


def test_stars_keep_their_light_at_all_positions_within_a_pixel():
    """Only pixels with a cosmic ray are replaced, also near the core, where the profile is steep.

    The star with the cosmic ray keeps its light within 0.5 %.
    """
    rng = np.random.default_rng(2)
    flux = rng.uniform(1e5, 5e5, 60)
    cuts = np.stack([light * diffraction(*rng.uniform(-0.5, 0.5, 2)) for light in flux])
    hit = cuts.copy()
    hit[3, 26, 20:24] += 0.02 * flux[3]
    kept = stars._replace_contaminated(hit, np.zeros(hit.shape, bool), flux, 13.0)
    np.testing.assert_array_equal(kept[np.arange(60) != 3], cuts[np.arange(60) != 3])
    assert kept[3].sum() == pytest.approx(cuts[3].sum(), rel=5e-3)
    assert hit[3].sum() > 1.07 * cuts[3].sum()
