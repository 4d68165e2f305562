"""The area of the sky that a catalogue covers, divided into patches for jackknife errors.

Jackknife errors contain the structure that differs between patches. This is most of the cosmic variance for
separations below the side of a patch. Fluctuations that a whole small field shares are not in the errors.
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

# Number of patches, and the smallest number of patches for which an error is estimated.
PATCHES, MIN_PATCHES = 16, 6
# If the generation cells are not recorded: mean number of sources per cell, and the highest order of such cells.
_SOURCES_PER_CELL, _FINEST_ORDER = 40.0, 12


@dataclass(frozen=True, slots=True, eq=False)
class Field:
    """Cells that a catalogue covers, and the patch of each cell.

    Attributes
    ----------
    order : int
        HEALPix order of the nested cells.
    cells : int array, shape (c,)
        Cell numbers, ascending.
    patch : int array, shape (c,)
        Patch of each cell, from 0.
    """

    order: int
    cells: Int
    patch: Int

    @property
    def n_patches(self) -> int:
        """Number of patches."""
        return int(self.patch.max(initial=-1)) + 1

    @property
    def area(self) -> float:
        """Area of all cells in deg2."""
        return len(self.cells) * sky.cell_area(self.order)

    @property
    def patch_side(self) -> float:
        """Side in deg of a square with the mean area of a patch."""
        return float(np.sqrt(self.area / max(self.n_patches, 1)))

    def patch_of(self, index: Int) -> Int:
        """Return the patch of each order-29 index, -1 outside the field."""
        cell = index >> 2 * (sky.MAX_ORDER - self.order)
        at = np.minimum(np.searchsorted(self.cells, cell), max(len(self.cells) - 1, 0))
        if not len(self.cells):
            return np.full(len(index), -1)
        return np.where(self.cells[at] == cell, self.patch[at], -1)


def from_version(catalogue: read.Version, index: Int) -> Field:
    """Return the cells that a catalogue was drawn in or, if they are not recorded, the cells that contain sources.

    Parameters
    ----------
    catalogue : Version
        Catalogue of a lake.
    index : int array, shape (n,)
        Order-29 indices of its sources.

    Returns
    -------
    Field
        The cells, in patches.
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
    """Divide cells (ascending numbers of one order) into at most PATCHES runs of consecutive cells.

    No patch is smaller than a generation cell, unless the whole field is. `order` must be at least GENERATION_ORDER.
    """
    n_patches = max(min(PATCHES, len(cells) >> 2 * (order - GENERATION_ORDER)), 1)
    return Field(order, cells, np.arange(len(cells)) * n_patches // max(len(cells), 1))


def _occupied_cells(index: Int, order: int) -> Int:
    return np.unique(index >> 2 * (sky.MAX_ORDER - order))


def random_positions(field: Field, n: int, *identity: int | str) -> tuple[Float, Int]:
    """Draw about `n` random positions, the same number in each cell.

    Parameters
    ----------
    field : Field
        Cells to fill.
    n : int
        Approximate number of positions; each cell gets at least one.
    *identity : int or str
        Identity of the random stream.

    Returns
    -------
    place : float array, shape (m, 3)
        Unit vectors.
    patch : int array, shape (m,)
        Patch of each position.
    """
    per_cell = max(n // max(len(field.cells), 1), 1)
    places = [
        sky.random_in_cell(field.order, int(cell), per_cell, stream(*identity, int(cell))) for cell in field.cells
    ]
    ra, dec = (np.concatenate([part[i] for part in places]) for i in (1, 2))
    return sky.unit_vectors(ra, dec), np.repeat(field.patch, per_cell)


def jackknife_error(samples: Float | Sequence[float], min_patches: int = MIN_PATCHES) -> Float:
    """Return the jackknife standard error of a figure, NaN if there are fewer patches than `min_patches`.

    Parameters
    ----------
    samples : float array, shape (patches, ...)
        The figure without each patch.
    min_patches : int
        Smallest number of patches for which an error is estimated.

    Returns
    -------
    float array, shape (...)
        Standard error.
    """
    values = np.asarray(samples, float)
    if len(values) < min_patches:
        return np.full(values.shape[1:], np.nan)
    n = len(values)
    return np.asarray(np.sqrt((n - 1) / n * np.sum((values - values.mean(0)) ** 2, axis=0)))
