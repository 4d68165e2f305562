"""Rectangles of a detector's pixels (windows), which are drawn instead of the whole detector."""

from __future__ import annotations

from dataclasses import dataclass


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
