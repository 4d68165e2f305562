"""The part of the sky in which two-point statistics are measured: covered and unmasked pixels of the depth map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyarrow.compute as pc

from lake_schema import sky
from lake_schema.arrays import Bool, Float, Int
from lake_schema.ids import GENERATION_ORDER
from lake_schema.store import read
from lake_schema.tables.survey import depth as bits
from lake_schema.tables.survey.depth import ORDER

# Bits of the column `mask` of pixels that are not used. Galaxies near the edge of an exposure are used.
_UNUSED = bits.BRIGHT_STAR | bits.SPIKE | bits.GHOST | bits.SATURATED | bits.BAD_PIXELS
# Smallest covered fraction of a pixel that is used. The table `galaxies` also has the galaxies in uncovered parts.
_MIN_COVERED = 0.99
_PIXELS_A_CELL = 1 << 2 * (ORDER - GENERATION_ORDER)


@dataclass(frozen=True, slots=True, eq=False)
class SurveyMask:
    """Pixels of order 14 that a band covers completely and that no bright star or bad pixels disturb.

    Attributes
    ----------
    band : str
        Name of the passband.
    pixels : int array, shape (n,)
        Nested pixels of order 14, ascending.
    """

    band: str
    pixels: Int

    @property
    def area(self) -> float:
        """Return the area in deg2."""
        return len(self.pixels) * sky.cell_area(ORDER)

    def contains(self, index: Int) -> Bool:
        """Return True for positions, given as nested HEALPix indices of order 29, in a pixel of the mask."""
        if not len(self.pixels):
            return np.zeros(len(index), bool)
        pixel = sky.parent(index, sky.MAX_ORDER, ORDER)
        at = np.minimum(np.searchsorted(self.pixels, pixel), len(self.pixels) - 1)
        return np.asarray(self.pixels[at] == pixel)

    def cells(self) -> tuple[Int, Float]:
        """Return the cells of order 8 that have pixels of the mask, ascending, and the fraction of each in the mask."""
        cells, count = np.unique(sky.parent(self.pixels, ORDER, GENERATION_ORDER), return_counts=True)
        return cells, count / _PIXELS_A_CELL


def why_outdated(depth: read.Version, randoms: read.Version) -> str:
    """Return why random points cannot be used with a depth map: they were drawn in another one. "" if they can."""
    if randoms.manifest["facts"].get("depth", depth.key) == depth.key:
        return ""
    return "table randoms was drawn in another version of table depth: run truesky randoms again"


def band_of_points(randoms: read.Version) -> str:
    """Return the band whose points are used, the first one with which the table `randoms` was drawn."""
    return str(randoms.manifest["facts"]["bands"][0])


def read_mask(depth: read.Version, band: str, simulated_cells: Sequence[int]) -> SurveyMask:
    """Read the mask of a band in those order-8 cells in which galaxies were simulated.

    Parameters
    ----------
    depth : Version
        Published table `depth`.
    band : str
        Name of the passband.
    simulated_cells : sequence of int
        Nested cells of order 8.

    Returns
    -------
    SurveyMask
        The mask, which may be empty.
    """
    simulated, parts = np.sort(np.array(simulated_cells, np.int64)), [np.zeros(0, np.int64)]
    for partition in depth.partitions if len(simulated) else ():
        rows = depth.rows(["pixel", "mask", "covered"], [partition], pc.field("band") == band)
        pixel = rows["pixel"].to_numpy()
        cell = sky.parent(pixel, ORDER, GENERATION_ORDER)
        inside = simulated[np.minimum(np.searchsorted(simulated, cell), len(simulated) - 1)] == cell
        is_clean = (rows["mask"].to_numpy() & _UNUSED) == 0
        parts.append(pixel[inside & is_clean & (rows["covered"].to_numpy() >= _MIN_COVERED)])
    return SurveyMask(band, np.sort(np.concatenate(parts)))
