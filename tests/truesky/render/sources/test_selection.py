"""Selection: nothing that would be drawn is left out, nothing far away is taken."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from lake_schema import ids, sky
from truesky.render.sources import selection


@given(st.floats(-300, 400), st.floats(-300, 400), st.sampled_from([32, 48, 64, 96, 256]))
def test_a_stamp_that_overlaps_is_taken(x, y, size):
    x0, y0 = int(np.rint(x)) - size // 2, int(np.rint(y)) - size // 2
    overlaps = x0 < 100 and x0 + size > 0 and y0 < 80 and y0 + size > 0
    (taken,) = selection.overlaps_frame(np.array([x]), np.array([y]), np.array([size]), 100, 80)
    assert taken >= overlaps
    if taken:
        # No more than two pixels too generous.
        assert x0 - 2 < 100
        assert x0 + size + 2 > 0
        assert y0 - 2 < 80
        assert y0 + size + 2 > 0


def test_near_works_across_the_wrap_and_the_pole():
    ra, dec = np.array([359.9, 0.1, 180.0, 0.0]), np.array([0.0, 0.0, 0.0, 0.15])
    assert selection.within_radius(ra, dec, (0.0, 0.0), 0.2).tolist() == [True, True, False, True]
    assert selection.within_radius(np.array([0.0, 180.0]), np.array([89.95, 89.95]), (90.0, 90.0), 0.06).all()


def test_cells_of_identifiers():
    cells = np.array([7, 7, 500_000])
    sources = ids.source_id(5, cells, np.arange(3))
    assert selection.cells_of_ids(sources, is_moved=False) == [7, 500_000]
    around = selection.cells_of_ids(sources[:1], is_moved=True)
    assert 7 in around
    assert set(sky.margin_cells(ids.GENERATION_ORDER, 7, ids.GENERATION_ORDER).tolist()) <= set(around)
    # An identifier of a user may contain a cell that does not exist.
    assert selection.cells_of_ids(np.array([(1 << 63) - 1]), is_moved=True) == []
    assert selection.cells_of_ids(np.zeros(0, np.int64), is_moved=True) == []
