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


def slow_sums(grid, normals, exposures, values):
    """Return the sums over footprints with a test of all 16 samples of all pixels, in the order of the footprints."""
    sums = Sums.zeros(len(grid.centres), values.shape[1])
    first = np.arange(len(grid.centres)) // 4 * 4
    along, across = (grid.centres[first + i] - grid.centres[first] for i in (1, 2))
    steps = (-0.375, -0.125, 0.125, 0.375)
    places = [grid.centres + i * along + j * across for i in steps for j in steps]
    for sides, exposure, row in zip(normals, exposures, values, strict=True):
        inside = np.array([(place[:, None] * sides).sum(axis=-1).min(axis=1) >= 0.0 for place in places])
        count, hit = inside.sum(axis=0), inside.any(axis=0)
        sums.values[:, hit] += count[hit] / SAMPLES * row[:, None]
        sums.exposures[hit & (sums.last != exposure)] += 1
        sums.last[hit] = exposure
        sums.samples[:] |= (inside * (1 << np.arange(SAMPLES))[:, None]).sum(axis=0).astype(np.int32)
        sums.edges[hit & (count < SAMPLES)] = True
    return sums


@pytest.mark.parametrize("cell", [0, 123456, 12 * 4**9 - 1])
def test_all_bits_are_those_of_the_slow_sums(cell):
    """40 footprints of 20 exposures, some larger than a block of pixels and some smaller than a group."""
    rng = np.random.default_rng(cell)
    grid = PixelGrid.from_cell(9, cell, PIXEL_ORDER)
    ra, dec = sky.cell_centre(9, cell)
    corners = []
    for width, height, angle, x, y in zip(
        *10.0 ** rng.uniform(1.5, 3.0, (2, 40)), rng.uniform(0, 360, 40), *rng.uniform(-300, 300, (2, 40)), strict=True
    ):
        centre = pointing.sky_of_plane(np.array([x]), np.array([y]), ra, dec, 0.0)
        corners.append(footprint(float(centre[0][0]), float(centre[1][0]), angle, width, height))
    normals, exposures = side_normals(np.concatenate(corners)), np.repeat(np.arange(20), 2)
    values = rng.uniform(1.0, 2.0, (40, 3))
    fast, slow = Sums.zeros(len(grid.centres), 3), slow_sums(grid, normals, exposures, values)
    add_footprints(grid, normals, exposures, values, fast)
    for name, expected in slow._asdict().items():
        np.testing.assert_array_equal(getattr(fast, name), expected, err_msg=name)
    assert slow.exposures.max() > 5
    assert 0.0 < slow.edges.mean() < 1.0


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
    np.testing.assert_allclose(sums.values[0], sums.covered_fraction(), rtol=0, atol=1e-12)
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


@pytest.mark.parametrize("cell", [0, 4**9 - 1, 2169 << 8, 8 * 4**9, 8 * 4**9 + 1, 12 * 4**9 - 1])
def test_all_samples_are_within_the_radii(cell):
    """Samples of pixels, groups and blocks, with the exact centres of the children of the pixels; also at the poles."""
    grid = PixelGrid.from_cell(9, cell, PIXEL_ORDER)
    pixels = grid.first_pixel + np.arange(len(grid.centres))
    children = (pixels[:, None] << 4) + np.arange(SAMPLES)
    places = sky.unit_vectors(*sky.cell_centres(PIXEL_ORDER + 2, children.ravel()))
    for centres, radius in zip((grid.centres, grid.group_centres, grid.block_centres), grid.sample_radii, strict=True):
        apart = np.sqrt(((places.reshape(len(centres), -1, 3) - centres[:, None]) ** 2).sum(axis=-1))
        assert 0.5 * radius < apart.max() <= radius
