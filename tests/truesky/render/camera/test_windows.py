"""Rectangles of a detector's pixels."""

from hypothesis import given
from hypothesis import strategies as st

from truesky.render.camera.windows import Window

places, sides = st.integers(-5000, 5000), st.integers(1, 5000)


@given(column=places, row=places, nx=sides, ny=sides, multiple=st.integers(1, 64))
def test_the_aligned_window_is_the_smallest_that_contains_the_window(column, row, nx, ny, multiple):
    window = Window(column, row, nx, ny)
    outer = window.align(multiple)
    for first, count, outer_first, outer_count in (
        (column, nx, outer.column, outer.nx),
        (row, ny, outer.row, outer.ny),
    ):
        assert outer_first % multiple == outer_count % multiple == 0
        assert first - multiple < outer_first <= first
        assert first + count <= outer_first + outer_count < first + count + multiple
    assert outer.align(multiple) == outer


def test_the_middle_of_a_window():
    assert Window(10, 20, 1, 1).middle == (10, 20)
    assert Window(10, 20, 4, 3).middle == (11.5, 21)
