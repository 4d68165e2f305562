"""The part of the sky that a catalogue covers, in patches that are left out in turn.

Field    its cells, and the patch of each;  of_version : of a published catalogue
random   places anywhere in it
spread   standard errors of what is measured without each patch

Errors hold the structure that patches differ by, which is most of the cosmic variance for separations below a patch's
side; what all of a small field has in common they do not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lake_schema import sky
from lake_schema.arrays import Float, Int
from lake_schema.ids import GENERATION_ORDER
from lake_schema.store import read
from truesky.randomness.rng import stream

# Patches, and the fewest that tell an error.
PATCHES, FEWEST = 16, 6
# Sources that a cell holds in the mean where nobody says which cells were drawn, and the finest such cells.
_FILLED, _FINEST = 40.0, 12


@dataclass(frozen=True, slots=True, eq=False)
class Field:
    """order : of the nested cells;  cells : int[c], ascending;  patch : int[c] of each."""

    order: int
    cells: Int
    patch: Int

    @property
    def patches(self) -> int:
        return int(self.patch.max(initial=-1)) + 1

    @property
    def area(self) -> float:
        """deg2."""
        return len(self.cells) * sky.cell_area(self.order)

    @property
    def side(self) -> float:
        """Of a patch, deg, as if it were a square."""
        return float(np.sqrt(self.area / max(self.patches, 1)))

    def patch_of(self, index: Int) -> Int:
        """Patch[n] of order-29 indices, -1 outside."""
        cell = index >> 2 * (sky.DEEPEST - self.order)
        at = np.minimum(np.searchsorted(self.cells, cell), max(len(self.cells) - 1, 0))
        if not len(self.cells):
            return np.full(len(index), -1)
        return np.where(self.cells[at] == cell, self.patch[at], -1)


def of_version(catalogue: read.Version, index: Int) -> Field:
    """Where a catalogue was drawn; if it does not say, where it has sources.

    catalogue : of a lake;  index : int[n] order-29 indices of its sources
    """
    drawn = {cell for part in catalogue.manifest["parts"] for cell in part["facts"].get("generation_cells", ())}
    if drawn:
        return of_cells(GENERATION_ORDER, np.array(sorted(drawn), np.int64))
    order = GENERATION_ORDER
    while order < _FINEST and len(index) > _FILLED * 4 * len(_cells(index, order)):
        order += 1
    return of_cells(order, _cells(index, order))


def of_cells(order: int, cells: Int) -> Field:
    """In patches of neighbouring cells, none smaller than one that is drawn; cells : int[c] of an order, ascending."""
    many = max(min(PATCHES, len(cells) >> 2 * (order - GENERATION_ORDER)), 1)
    return Field(order, cells, np.arange(len(cells)) * many // max(len(cells), 1))


def _cells(index: Int, order: int) -> Int:
    return np.unique(index >> 2 * (sky.DEEPEST - order))


def random(field: Field, n: int, *identity: int | str) -> tuple[Float, Int]:
    """(unit vectors[m, 3], patch[m]) of about n places, as many in each cell.

    field : to be filled;  identity : of their stream
    """
    each = max(n // max(len(field.cells), 1), 1)
    places = [sky.random_in_cell(field.order, int(cell), each, stream(*identity, int(cell))) for cell in field.cells]
    ra, dec = (np.concatenate([part[i] for part in places]) for i in (1, 2))
    return sky.unit_vectors(ra, dec), np.repeat(field.patch, each)


def spread(without: Float | Sequence[float], fewest: int = FEWEST) -> Float:
    """Standard error[...] of a figure, NaN of fewer than `fewest` patches.

    without : float[patch, ...] the figure without each patch;  fewest : patches that tell an error
    """
    values = np.asarray(without, float)
    if len(values) < fewest:
        return np.full(values.shape[1:], np.nan)
    n = len(values)
    return np.asarray(np.sqrt((n - 1) / n * np.sum((values - values.mean(0)) ** 2, axis=0)))
