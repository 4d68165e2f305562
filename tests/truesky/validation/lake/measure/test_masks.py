"""Discs and dilated masks against scipy's distances and morphology."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from truesky.validation.lake.measure import masks

CROSS, SQUARE = ndimage.generate_binary_structure(2, 1), np.ones((3, 3), bool)


@given(st.integers(0, 2**32 - 1), st.floats(0.0, 12.0))
def test_discs_hold_what_is_within_their_radius(seed, widest):
    rng = np.random.default_rng(seed)
    x, y, radius = rng.uniform(-15.0, 40.0, 6), rng.uniform(-15.0, 35.0, 6), widest * rng.uniform(0.0, 1.0, 6)
    radius[0] = 0.0
    out = rng.random((20, 30)) < 0.02
    before = out.copy()
    masks.mark_discs(x, y, radius, out)
    rows, columns = np.mgrid[0:20, 0:30]
    near = [(columns - a) ** 2 + (rows - b) ** 2 <= r * r for a, b, r in zip(x, y, radius, strict=True) if r > 0.0]
    assert (out == np.logical_or.reduce([before, *near])).all()


@pytest.mark.parametrize("radius", [np.nan, -1.0, 0.0])
def test_no_disc_without_a_radius(radius):
    out = np.zeros((5, 5), bool)
    masks.mark_discs(np.array([2.0]), np.array([2.0]), np.array([radius]), out)
    assert not out.any()


@given(st.integers(0, 2**32 - 1), st.booleans(), st.integers(0, 4))
def test_dilation_agrees_with_scipy(seed, corners, times):
    mask = np.random.default_rng(seed).random((3, 9, 11)) < 0.05
    before = mask.copy()
    told = mask
    if times:
        structure = (SQUARE if corners else CROSS)[None]
        told = ndimage.binary_dilation(mask, structure=structure, iterations=times)
    assert (masks.dilate(mask, corners, times) == told).all()
    assert (mask == before).all()
