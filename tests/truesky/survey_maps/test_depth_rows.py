"""Rows of depth maps from footprints with measured frames and without."""

import numpy as np
import pytest

from lake_schema import sky
from lake_schema.tables.survey.depth import BAD_PIXELS, BOTH, MEASURED, ORDER, PLANNED, SATURATED
from truesky.survey_maps import depth_rows
from truesky.survey_maps.measured_frames import Measured
from truesky.survey_maps.pixel_overlap import PixelGrid, side_normals
from truesky.survey_maps.planned_footprints import VALUES, Footprints

CELL_ORDER, CELL = 8, 200_000
NONE = np.zeros(0, np.int64)


@pytest.fixture(scope="module")
def grid():
    return PixelGrid.from_cell(CELL_ORDER, CELL, ORDER)


def footprints(measured):
    """Return footprints of exposures 1, 2, ... that cover the whole cell, with measurements or None."""
    n = len(measured)
    ra, dec = sky.cell_centre(CELL_ORDER, CELL)
    corners = np.array([[ra - 1, dec - 1], [ra + 1, dec - 1], [ra + 1, dec + 1], [ra - 1, dec + 1]])
    values = np.ones((n, len(VALUES)))
    found = np.empty(n, object)
    for i, one in enumerate(measured):
        found[i] = one
        values[i, VALUES.index("measured_time")] = one is not None
    return Footprints(
        np.full(n, "lsst_r", object), np.full(n, "lsstcam", object), np.arange(1, n + 1), np.full(n, "a", object),
        np.tile(sky.unit_vectors(ra, dec), (n, 1)), np.full(n, 0.03), np.tile(side_normals(corners[None]), (n, 1, 1)),
        values, found,
    )  # fmt: skip


def build(grid, measured, masks=None):
    rows = depth_rows.build(grid, footprints(measured), np.zeros(len(grid.centres)), masks)
    assert len(rows) == len(grid.centres)
    return {name: rows[name].to_numpy() for name in ("pixel", "mask", "origin")}


def frame(grid, bad=NONE, saturated=NONE):
    return Measured(1.0, 1.0, grid.first_pixel + np.asarray(bad), grid.first_pixel + np.asarray(saturated))


@pytest.mark.parametrize(("number", "origin"), [(0, PLANNED), (1, BOTH), (2, MEASURED)])
def test_the_origin_depends_on_the_number_of_measured_exposures(grid, number, origin):
    rows = build(grid, [frame(grid)] * number + [None] * (2 - number))
    assert set(rows["origin"].tolist()) == {origin}


def test_bad_pixels_are_bad_in_every_exposure(grid):
    """Pixel 7 is bad in both exposures, 5 in one of them; pixels of other cells are ignored."""
    bad = [[5, 7, -3], [7, 9, len(grid.centres)]]
    rows = build(grid, [frame(grid, np.array(pixels)) for pixels in bad])
    assert np.flatnonzero(rows["mask"] & BAD_PIXELS).tolist() == [7]
    rows = build(grid, [frame(grid, np.array(bad[0])), None])
    assert not (rows["mask"] & BAD_PIXELS).any()


def test_measured_saturation_replaces_that_of_the_plan_only_where_all_is_measured(grid):
    predicted = np.zeros(len(grid.centres), np.int64)
    predicted[[3, 4]] = SATURATED
    frames = [frame(grid, saturated=np.array([4])), frame(grid, saturated=np.array([8]))]
    for measured, expected in ((frames, [4, 8]), ([*frames, None], [3, 4, 8]), ([None], [3, 4])):
        rows = build(grid, measured, lambda *_: predicted)
        assert np.flatnonzero(rows["mask"] & SATURATED).tolist() == expected
