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
PATCHES, MIN_PATCHES = 16, 6
# Sources that a cell holds in the mean where nobody says which cells were drawn, and the finest such cells.
_SOURCES_PER_CELL, _FINEST_ORDER = 40.0, 12


@dataclass(frozen=True, slots=True, eq=False)
class Field:
    """order : of the nested cells;  cells : int[c], ascending;  patch : int[c] of each."""

    order: int
    cells: Int
    patch: Int

    @property
    def n_patches(self) -> int:
        return int(self.patch.max(initial=-1)) + 1

    @property
    def area(self) -> float:
        """deg2."""
        return len(self.cells) * sky.cell_area(self.order)

    @property
    def patch_side(self) -> float:
        """Of a patch, deg, as if it were a square."""
        return float(np.sqrt(self.area / max(self.n_patches, 1)))

    def patch_of(self, index: Int) -> Int:
        """Patch[n] of order-29 indices, -1 outside."""
        cell = index >> 2 * (sky.MAX_ORDER - self.order)
        at = np.minimum(np.searchsorted(self.cells, cell), max(len(self.cells) - 1, 0))
        if not len(self.cells):
            return np.full(len(index), -1)
        return np.where(self.cells[at] == cell, self.patch[at], -1)


def from_version(catalogue: read.Version, index: Int) -> Field:
    """Where a catalogue was drawn; if it does not say, where it has sources.

    catalogue : of a lake;  index : int[n] order-29 indices of its sources
    """
    generation_cells = {
        cell for part in catalogue.manifest["parts"] for cell in part["facts"].get("generation_cells", ())
    }
    if generation_cells:
        return from_cells(GENERATION_ORDER, np.array(sorted(generation_cells), np.int64))
    order = GENERATION_ORDER
    while order < _FINEST_ORDER and len(index) > _SOURCES_PER_CELL * 4 * len(_occupied_cells(index, order)):
        order += 1
    return from_cells(order, _occupied_cells(index, order))


def from_cells(order: int, cells: Int) -> Field:
    """In patches of neighbouring cells, none smaller than one that is drawn; cells : int[c] of an order, ascending."""
    n_patches = max(min(PATCHES, len(cells) >> 2 * (order - GENERATION_ORDER)), 1)
    return Field(order, cells, np.arange(len(cells)) * n_patches // max(len(cells), 1))


def _occupied_cells(index: Int, order: int) -> Int:
    return np.unique(index >> 2 * (sky.MAX_ORDER - order))


def random_positions(field: Field, n: int, *identity: int | str) -> tuple[Float, Int]:
    """(unit vectors[m, 3], patch[m]) of about n places, as many in each cell.

    field : to be filled;  identity : of their stream
    """
    per_cell = max(n // max(len(field.cells), 1), 1)
    places = [
        sky.random_in_cell(field.order, int(cell), per_cell, stream(*identity, int(cell))) for cell in field.cells
    ]
    ra, dec = (np.concatenate([part[i] for part in places]) for i in (1, 2))
    return sky.unit_vectors(ra, dec), np.repeat(field.patch, per_cell)


def jackknife_error(samples: Float | Sequence[float], min_patches: int = MIN_PATCHES) -> Float:
    """Standard error[...] of a figure, NaN of fewer than `fewest` patches.

    without : float[patch, ...] the figure without each patch;  fewest : patches that tell an error
    """
    values = np.asarray(samples, float)
    if len(values) < min_patches:
        return np.full(values.shape[1:], np.nan)
    n = len(values)
    return np.asarray(np.sqrt((n - 1) / n * np.sum((values - values.mean(0)) ** 2, axis=0)))
