"""Generation cells and the files that they lie in."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lake_schema import sky
from lake_schema.ids import GENERATION_ORDER
from lake_schema.store import layout
from truesky.catalogue import cells
from truesky.request.area import Area


def held(parts):
    return [cell for part in parts for cell in part.facts["generation_cells"]]


@given(st.sets(st.integers(0, (12 << 16) - 1), min_size=1, max_size=200), st.floats(0.5, 500.0), st.integers(0, 8))
def test_every_cell_lies_in_one_file_of_the_lowest_order_that_can_hold_it(generation, most, order):
    given_cells = np.array(list(generation))
    numbers = 1.0 + given_cells % 7
    parts = cells.tasks_by_row_count(given_cells.tolist(), numbers, most, order)
    assert held(parts) == sorted(generation)
    number = dict(zip(given_cells.tolist(), numbers, strict=True))
    for part in parts:
        level, file = layout.cell_of_file(part.name)
        own = part.facts["generation_cells"]
        assert own == [c for c in sorted(generation) if c >> 2 * (8 - level) == file]
        assert level == 8 or sum(number[c] for c in own) <= most
        parent = [n for c, n in number.items() if c >> 2 * (9 - level) == file >> 2]
        assert level == order or sum(parent) > most


def test_files_are_those_that_hats_would_plan(rng):
    """A sky with a crowded plane. hats puts each cell of the highest order into a separate file."""
    # It takes seconds to load, in each process of tests.
    from hats.pixel_math.partition_stats import generate_alignment

    _, lat = sky.galactic(*sky.cell_centres(GENERATION_ORDER, np.arange(12 << 16)))
    numbers = rng.poisson(2000.0 * np.exp(-np.abs(lat) / 10.0)) + 1
    parts = cells.tasks_by_row_count(range(numbers.size), numbers, 60_000, 3)
    theirs = generate_alignment(numbers, highest_order=8, lowest_order=3, threshold=60_000)
    wanted = {(int(order), int(cell)) for order, cell, _ in set(map(tuple, theirs))}
    assert {layout.cell_of_file(part.name) for part in parts} == wanted
    assert {order for order, _ in wanted} >= {3, 4, 5, 6}


@pytest.mark.parametrize("most", [0.5, 10.0, 1e9])
def test_the_order_of_the_cells_does_not_matter(most):
    found = Area(ra=10.0, dec=20.0, radius=1.0).cells()
    numbers = np.arange(1.0, len(found) + 1)
    parts = cells.tasks_by_row_count(found, numbers, most, 3)
    assert parts == cells.tasks_by_row_count(found[::-1], numbers[::-1], most, 3)
    assert held(parts) == held(cells.tasks_of_area(Area(ra=10.0, dec=20.0, radius=1.0)))
