"""The part of each pixel that a footprint covers, against a count of the exact samples."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lake_schema import sky
from truesky.render.camera import pointing
from truesky.survey_maps.pixel_overlap import SAMPLES, PixelGrid, Sums, add_footprints, side_normals

ORDER, PIXEL_ORDER = 8, 14


def footprint(ra, dec, angle, width, height):
    """Return the corners of a rectangle on the sky (sides in arcsec), float[1, 4, 2]."""
    x, y = np.array([-1, 1, 1, -1]) * width / 2, np.array([-1, -1, 1, 1]) * height / 2
    return np.stack(pointing.sky_of_plane(x, y, ra, dec, angle), axis=-1)[None]


def slow_samples(grid, corners):
    """Return for each pixel how many of its children two orders below have their centre in the footprint."""
    pixels = grid.first_pixel + np.arange(len(grid.centres))
    children = (pixels[:, None] << 4) + np.arange(SAMPLES)
    places = sky.unit_vectors(*sky.cell_centres(PIXEL_ORDER + 2, children.ravel()))
    inside = (places[:, None] * side_normals(corners)[0]).sum(axis=-1).min(axis=1) >= 0.0
    return inside.reshape(-1, SAMPLES).sum(axis=1)


def added(grid, *corner_lists, exposures=None):
    corners = np.concatenate(corner_lists)
    sums = Sums.zeros(len(grid.centres), 1)
    numbers = np.arange(len(corners)) if exposures is None else np.array(exposures)
    add_footprints(grid, side_normals(corners), numbers, np.ones((len(corners), 1)), sums)
    return sums


@settings(max_examples=15, deadline=None)
@given(
    cell=st.integers(0, 12 * 4**ORDER - 1), angle=st.floats(0, 360), width=st.floats(60, 900),
    height=st.floats(60, 900), shift=st.tuples(st.floats(-300, 300), st.floats(-300, 300)),
)  # fmt: skip
def test_covered_samples_are_those_of_the_slow_count(cell, angle, width, height, shift):
    """Samples are placed with an error below 1e-3 pixels, so few of them, near the sides, may differ."""
    grid = PixelGrid.from_cell(ORDER, cell, PIXEL_ORDER)
    ra, dec = sky.cell_centre(ORDER, cell)
    centre = pointing.sky_of_plane(np.array([shift[0]]), np.array([shift[1]]), ra, dec, 0.0)
    corners = footprint(float(centre[0][0]), float(centre[1][0]), angle, width, height)
    sums = added(grid, corners)
    expected = slow_samples(grid, corners)
    found = np.rint(sums.covered_fraction() * SAMPLES).astype(int)
    assert np.abs(found - expected).sum() <= 0.01 * max(expected.sum(), 1) + 4
    np.testing.assert_allclose(sums.values[:, 0], sums.covered_fraction(), rtol=0, atol=1e-12)
    np.testing.assert_array_equal(sums.exposures > 0, found > 0)
    np.testing.assert_array_equal(sums.edges, (found > 0) & (found < SAMPLES))


def test_the_covered_area_is_that_of_the_footprint():
    grid = PixelGrid.from_cell(7, 12345, PIXEL_ORDER)
    ra, dec = sky.cell_centre(7, 12345)
    sums = added(grid, footprint(ra, dec, 40.0, 800.0, 600.0))
    area = sums.covered_fraction().sum() * sky.cell_area(PIXEL_ORDER) * 3600.0**2
    assert area == pytest.approx(800.0 * 600.0, rel=2e-3)


def test_two_detectors_of_one_exposure_count_once():
    grid = PixelGrid.from_cell(ORDER, 77, PIXEL_ORDER)
    ra, dec = sky.cell_centre(ORDER, 77)
    both = footprint(ra, dec, 0.0, 300.0, 300.0), footprint(ra, dec, 0.0, 300.0, 300.0)
    assert added(grid, *both, exposures=[4, 4]).exposures.max() == 1
    sums = added(grid, *both, exposures=[4, 5])
    assert sums.exposures.max() == 2
    assert sums.covered_fraction().max() == 1.0
    assert sums.values.max() == 2.0
