"""The area of the sky that a catalogue covers, as HEALPix cells, divided into patches for jackknife errors.

Jackknife errors contain the differences between patches. For separations below the side of a patch, these are most of
the cosmic variance. Fluctuations of the mean density of a whole small field are not included.
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

# Largest number of patches into which a field is divided.
PATCHES = 16
# Smallest number of patches for which a jackknife error is estimated.
MIN_PATCHES = 6
# If a catalogue does not record the cells in which it was simulated, cells with sources are divided into four while
# their mean number of sources is more than four times this number.
_SOURCES_PER_CELL = 40.0
# Highest HEALPix order of the cells that represent the area of a catalogue without recorded cells.
_FINEST_ORDER = 12


@dataclass(frozen=True, slots=True, eq=False)
class Field:
    """HEALPix cells that a catalogue covers, and the jackknife patch to which each cell belongs.

    Attributes
    ----------
    order : int
        HEALPix order of the cells.
    cells : int array, shape (c,)
        Numbers of the cells in the nested scheme, ascending.
    patch : int array, shape (c,)
        Number of the patch of each cell, from 0, ascending.
    """

    order: int
    cells: Int
    patch: Int

    @property
    def n_patches(self) -> int:
        """Return the number of jackknife patches, 0 for a field without cells."""
        return int(self.patch.max(initial=-1)) + 1

    @property
    def area(self) -> float:
        """Return the area of all cells in deg2."""
        return len(self.cells) * sky.cell_area(self.order)

    @property
    def patch_side(self) -> float:
        """Return the side, in deg, of a square with the mean area of a patch."""
        return float(np.sqrt(self.area / max(self.n_patches, 1)))

    def patch_of(self, index: Int) -> Int:
        """Return the patch number of each position, given as nested HEALPix index of order 29; -1 outside the field."""
        cell = index >> 2 * (sky.MAX_ORDER - self.order)
        at = np.minimum(np.searchsorted(self.cells, cell), max(len(self.cells) - 1, 0))
        if not len(self.cells):
            return np.full(len(index), -1)
        return np.where(self.cells[at] == cell, self.patch[at], -1)


def from_version(catalogue: read.Version, index: Int) -> Field:
    """Find the area of the sky that a catalogue covers.

    The area consists of the HEALPix cells in which the catalogue was simulated. If the catalogue does not record them,
    it consists of the cells that contain sources.

    Parameters
    ----------
    catalogue : Version
        Published table of sources in a lake.
    index : int array, shape (n,)
        Positions of its sources as nested HEALPix indices of order 29. Used only if cells are not recorded.

    Returns
    -------
    Field
        The cells, divided into patches.
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
    """Divide HEALPix cells into at most 16 jackknife patches of consecutive cells with nearly equal numbers of cells.

    `cells` are nested cell numbers of the given order, ascending. Sources are simulated in cells of the order
    GENERATION_ORDER (8), and `order` must not be lower. The mean area of a patch is at least one such cell, unless the
    whole field is smaller.
    """
    n_patches = max(min(PATCHES, len(cells) >> 2 * (order - GENERATION_ORDER)), 1)
    return Field(order, cells, np.arange(len(cells)) * n_patches // max(len(cells), 1))


def _occupied_cells(index: Int, order: int) -> Int:
    return np.unique(index >> 2 * (sky.MAX_ORDER - order))


def random_positions(field: Field, n: int, *identity: int | str) -> tuple[Float, Int]:
    """Draw about `n` random positions in a field, with the same number in each cell.

    Parameters
    ----------
    field : Field
        Area to fill, with at least one cell.
    n : int
        Approximate number of positions; each cell gets at least one.
    *identity : int or str
        Names and numbers that identify the random numbers: the same identity always gives the same positions.

    Returns
    -------
    place : float array, shape (m, 3)
        Positions as unit vectors.
    patch : int array, shape (m,)
        Number of the jackknife patch of each position.
    """
    per_cell = max(n // max(len(field.cells), 1), 1)
    places = [
        sky.random_in_cell(field.order, int(cell), per_cell, stream(*identity, int(cell))) for cell in field.cells
    ]
    ra, dec = (np.concatenate([part[i] for part in places]) for i in (1, 2))
    return sky.unit_vectors(ra, dec), np.repeat(field.patch, per_cell)


def jackknife_error(samples: Float | Sequence[float], min_patches: int = MIN_PATCHES) -> Float:
    """Return the jackknife standard error of a measured quantity.

    Parameters
    ----------
    samples : float array, shape (patches, ...)
        The quantity, measured once for each patch without the sources of this patch.
    min_patches : int
        Smallest number of patches for which an error is estimated.

    Returns
    -------
    float array, shape (...)
        Standard error; NaN if there are fewer patches than `min_patches`, or a sample is not finite.
    """
    values = np.asarray(samples, float)
    if len(values) < min_patches:
        return np.full(values.shape[1:], np.nan)
    n = len(values)
    # The logarithm of an empty sample is infinite, and its error is NaN.
    with np.errstate(invalid="ignore"):
        return np.asarray(np.sqrt((n - 1) / n * np.sum((values - values.mean(0)) ** 2, axis=0)))
