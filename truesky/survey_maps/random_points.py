"""Draw uniform random points in the area that a band covers, with the depth and masks at each point.

Points are drawn in HEALPix cells of order 8, each with its own random numbers, so that they depend neither on the area
nor on the division into files. In a cell, points are numbered in the order of a Poisson process: a higher density adds
points and keeps the points of a lower one. All bands have the same points, of which each keeps those in its area.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from lake_schema import ids, sky
from lake_schema.arrays import Array, Bool, Float, Int
from lake_schema.ids import GENERATION_ORDER
from lake_schema.tables.survey.depth import ORDER
from lake_schema.tables.survey.randoms import KIND
from truesky.randomness.rng import stream
from truesky.survey_maps.depth_lookup import DepthMap

# Columns of the table `depth` that random points have.
DEPTH_COLUMNS = ("depth_point", "mask", "covered")
# Function that returns the probability with which a galaxy is detected where the depth has these values (AB mag).
DetectionProbability = Callable[[Float], Float]
# Differences of order between indices of positions (order 29), depth pixels (order 14) and cells (order 8), in bits.
_INDEX_BITS = 2 * (sky.MAX_ORDER - GENERATION_ORDER)
_PIXEL_BITS = 2 * (sky.MAX_ORDER - ORDER)
_PIXELS = 1 << 2 * (ORDER - GENERATION_ORDER)
_ARCMIN2 = 3600.0


def expected_number(covered: Float | float, density: float) -> Float:
    """Return the expected numbers of points in areas whose size is given in depth pixels; `density` is per arcmin2."""
    return np.asarray(density * _ARCMIN2 * sky.cell_area(ORDER) * np.asarray(covered, float))


def draw_points(
    cells: Sequence[int], density: float, seed: int, depth: DepthMap, detection: DetectionProbability | None = None
) -> dict[str, Array]:
    """Draw random points in those parts of HEALPix cells that a band covers.

    Parameters
    ----------
    cells : sequence of int
        Nested cells of order 8, distinct.
    density : float
        Expected number of points per arcmin2 of covered area.
    seed : int
        Seed of the random numbers.
    depth : DepthMap
        Depth of the band in these cells, with DEPTH_COLUMNS. Pixels without row are not covered.
    detection : callable, optional
        Model of the detection, for the column `detection`. Without it there is no such column.

    Returns
    -------
    dict of str to array, each of shape (n,)
        Columns of the table `randoms` except `band`, in the order of `_healpix_29`.
    """
    parts = [_points_in_cell(cell, density, seed, depth) for cell in sorted(cells)]
    index, identifier, row = (np.concatenate([np.zeros(0, np.int64), *values]) for values in zip(*parts, strict=True))
    ra, dec = sky.positions_of_indices(index) if len(index) else (np.zeros(0), np.zeros(0))
    columns = {"id": identifier, "ra": ra, "dec": dec, "_healpix_29": index}
    columns |= {name: depth.columns[name][row] for name in DEPTH_COLUMNS}
    return columns if detection is None else columns | {"detection": detection(columns["depth_point"])}


def _points_in_cell(cell: int, density: float, seed: int, depth: DepthMap) -> tuple[Int, Int, Int]:
    """Return the order-29 indices (ascending), identifiers, and rows in `depth` of the points of an order-8 cell."""
    first = cell * _PIXELS
    begin, end = np.searchsorted(depth.pixels, (first, first + _PIXELS))
    # Row of each pixel of the cell. A table of all pixels is ten times as fast as a search for each point.
    rows = np.full(_PIXELS, -1, np.int64)
    rows[depth.pixels[begin:end] - first] = np.arange(begin, end)
    number = _poisson_number(cell, float(expected_number(float(_PIXELS), density)), seed)
    index = stream(seed, "randoms.position", cell).integers(0, 1 << _INDEX_BITS, number, dtype=np.int64)
    row = rows[index >> _PIXEL_BITS]
    chance = stream(seed, "randoms.coverage", cell).random(number)
    chosen = np.flatnonzero(_is_covered(row, chance, depth))
    chosen = chosen[np.argsort(index[chosen], kind="stable")]
    identifier = np.int64(int(ids.source_id(KIND, cell, np.zeros(1, np.int64))[0])) + chosen
    return index[chosen] | np.int64(cell << _INDEX_BITS), identifier, row[chosen]


def _is_covered(row: Int, chance: Float, depth: DepthMap) -> Bool:
    """Return True for points in a pixel with a row, with a probability equal to the covered fraction of the pixel."""
    if not len(depth.pixels):
        return np.zeros(len(row), bool)
    return np.asarray((row >= 0) & (chance < depth.columns["covered"][row]))


def _poisson_number(cell: int, mean: float, seed: int) -> int:
    """Draw the number of points of a cell, such that it never decreases with the mean.

    The points arrive after exponential steps of a mean of 1, and all points before `mean` count.
    """
    rng = stream(seed, "randoms.number", cell)
    steps = rng.standard_exponential(int(mean + 6.0 * np.sqrt(mean)) + 16)
    while (arrivals := np.cumsum(steps))[-1] < mean:
        steps = np.append(steps, rng.standard_exponential(16))
    return int(np.searchsorted(arrivals, mean))
