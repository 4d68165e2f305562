"""Rectangles of a detector's pixels (windows), which are drawn instead of the whole detector."""

from __future__ import annotations

from dataclasses import dataclass

from lake_schema.arrays import Bool, Int


@dataclass(frozen=True, slots=True)
class Window:
    """Rectangle of pixels of a detector.

    Attributes
    ----------
    column, row : int
        First column and row, 0-based.
    nx, ny : int
        Number of columns and of rows.
    """

    column: int
    row: int
    nx: int
    ny: int

    @property
    def middle(self) -> tuple[float, float]:
        """Column and row of the middle of the window on the detector, 0-based."""
        return self.column + (self.nx - 1) / 2, self.row + (self.ny - 1) / 2

    def align(self, multiple: int) -> Window:
        """Return the smallest window that contains this one and whose edges are multiples of a number of pixels."""
        column, row = (first // multiple * multiple for first in (self.column, self.row))
        last_column, last_row = self.column + self.nx, self.row + self.ny
        return Window(
            column, row, -(-last_column // multiple) * multiple - column, -(-last_row // multiple) * multiple - row
        )


@dataclass(frozen=True, slots=True)
class DetectorPart:
    """A window and the size of its detector, for patterns that belong to the pixels of the detector.

    Attributes
    ----------
    window : Window
        The window.
    nx, ny : int
        Number of columns and of rows of the detector.
    """

    window: Window
    nx: int
    ny: int

    def find_pixels(self, rows: Int, columns: Int) -> tuple[Bool, Int, Int]:
        """Find pixels of the detector in the window.

        Parameters
        ----------
        rows, columns : int array, shape (n,)
            Rows and columns on the detector, 0-based.

        Returns
        -------
        is_inside : bool array, shape (n,)
            True for pixels in the window.
        window_rows, window_columns : int array, shape (m,)
            Rows and columns in the window of these pixels.
        """
        up, right = rows - self.window.row, columns - self.window.column
        is_inside = (up >= 0) & (up < self.window.ny) & (right >= 0) & (right < self.window.nx)
        return is_inside, up[is_inside], right[is_inside]


def whole(shape: tuple[int, ...]) -> DetectorPart:
    """Return the window that contains all pixels of a detector; `shape` ends with its numbers of rows and columns."""
    ny, nx = shape[-2:]
    return DetectorPart(Window(0, 0, nx, ny), nx, ny)
