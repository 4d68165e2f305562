"""Add the footprints of detectors to the pixels of a HEALPix cell, with the part of each pixel that they cover.

The part is counted on 16 samples per pixel, the centres of its children two orders below. The sides of a footprint are
great circles. Only pixels near a side are divided into samples: blocks of 256 pixels and groups of 16 that are far from
all sides are tested as a whole. All footprints are added to one block before the next, so that its sums stay in the
processor's cache.

Pixels have the nested order, in which four consecutive pixels are siblings: pixels 1 and 2 of them are displaced from
pixel 0 along the two axes of the grid. These displacements place the samples, with an error below 1e-3 pixels.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from lake_schema import sky
from lake_schema.arrays import Bool, Float, Int
from truesky.numerics.compiling import exact_jit

# Samples per pixel.
SAMPLES = 16
# Orders between a block or a group of pixels, which is tested as a whole, and its pixels.
_BLOCK_ORDERS, _GROUP_ORDERS = 4, 2
# Pixels per block and per group.
_BLOCK, _GROUP = 1 << 2 * _BLOCK_ORDERS, 1 << 2 * _GROUP_ORDERS
# Offsets of the samples from the centre of a pixel along the axes of the grid, in units of the pixel's width.
_OFFSETS = (-0.375, -0.125, 0.125, 0.375)
# All samples of a pixel, as bits.
_FULL = (1 << SAMPLES) - 1
# Number of samples in each of the 65,536 combinations of bits.
_COUNTS = np.array([bits.bit_count() for bits in range(_FULL + 1)], np.int64)


class PixelGrid(NamedTuple):
    """Pixels of a HEALPix cell in nested order.

    Attributes
    ----------
    order, cell : int
        HEALPix order and nested number of the cell.
    pixel_order : int
        HEALPix order of the pixels, at least 4 above `order`.
    centres : float array, shape (n, 3)
        Unit vectors to the centres of the pixels.
    group_centres : float array, shape (n / 16, 3)
        Unit vectors to the centres of the groups of 16 consecutive pixels.
    block_centres : float array, shape (n / 256, 3)
        Unit vectors to the centres of the blocks of 256 consecutive pixels.
    pixel_radius : float
        Largest distance between the centre of a pixel and its corners, radian.
    sample_radii : (float, float, float)
        Upper limits of the distance between the centre of a pixel, group or block and its samples, radian.
    """

    order: int
    cell: int
    pixel_order: int
    centres: Float
    group_centres: Float
    block_centres: Float
    pixel_radius: float
    sample_radii: tuple[float, float, float]

    @classmethod
    def from_cell(cls, order: int, cell: int, pixel_order: int) -> PixelGrid:
        """Return the pixels in a HEALPix cell.

        Parameters
        ----------
        order, cell : int
            HEALPix order and nested number of the cell.
        pixel_order : int
            HEALPix order of the pixels, at least 4 above `order`.

        Returns
        -------
        PixelGrid
            The pixels.
        """

        def centres(fine: int) -> Float:
            children = 1 << 2 * (fine - order)
            return sky.unit_vectors(*sky.cell_centres(fine, cell * children + np.arange(children)))

        orders = [pixel_order - coarser for coarser in (0, _GROUP_ORDERS, _BLOCK_ORDERS)]
        pixels, groups, blocks = (centres(fine) for fine in orders)
        radius = float(np.radians(sky.cell_radius(pixel_order)))
        return cls(order, cell, pixel_order, pixels, groups, blocks, radius, _sample_radii(pixels))

    @property
    def first_pixel(self) -> int:
        """Nested number of the first pixel."""
        return self.cell << 2 * (self.pixel_order - self.order)


def _sample_radii(centres: Float) -> tuple[float, float, float]:
    """Return the fields `sample_radii` of a grid with the given centres of pixels.

    A square of n x n pixels reaches n / 2 steps along both axes of the grid from its centre, and its outermost samples
    are an eighth of a step inside. Steps change by less than 5 % within a block, also at the poles.
    """
    along, across = (centres[i::4] - centres[::4] for i in (1, 2))
    diagonal = max(float(np.sqrt(((along + sign * across) ** 2).sum(axis=1).max())) for sign in (-1.0, 1.0))
    pixel, group, block = (1.05 * diagonal * (0.5 * (1 << n) - 0.125) for n in (0, _GROUP_ORDERS, _BLOCK_ORDERS))
    return pixel, group, block


class Sums(NamedTuple):
    """Sums over the footprints in each of n pixels.

    Attributes
    ----------
    values : float array, shape (k, n)
        Sum of the k values of each footprint, times the covered part of the pixel.
    exposures : int32 array, shape (n,)
        Number of exposures that cover a sample of the pixel.
    last : int64 array, shape (n,)
        Exposure that was counted last, -1 for none.
    samples : int32 array, shape (n,)
        Bits of the samples that any footprint covers.
    edges : bool array, shape (n,)
        True if a footprint covers some samples of the pixel, but not all.
    """

    values: Float
    exposures: Int
    last: Int
    samples: Int
    edges: Bool

    @classmethod
    def zeros(cls, pixels: int, values: int) -> Sums:
        """Return the sums over no footprints, for a number of pixels and of values."""
        return cls(
            np.zeros((values, pixels)),
            np.zeros(pixels, np.int32),
            np.full(pixels, -1, np.int64),
            np.zeros(pixels, np.int32),
            np.zeros(pixels, bool),
        )

    def select(self, chosen: Int) -> Sums:
        """Return the sums in the pixels with the given indices."""
        columns: list[Any] = [np.take(column, chosen, axis=-1) for column in self]
        return Sums(*columns)

    def covered_fraction(self) -> Float:
        """Return the part of each pixel that footprints cover, 0 to 1, shape (n,)."""
        return np.asarray(_COUNTS[self.samples] / SAMPLES)


def side_normals(corners: Float) -> Float:
    """Return unit vectors normal to the sides of convex polygons, towards their inside.

    `corners`, shape (m, 4, 2), are right ascension and declination in deg. The result has the shape (m, 4, 3).
    """
    places = sky.unit_vectors(corners[..., 0], corners[..., 1])
    normals = np.cross(places, np.roll(places, -1, axis=1))
    normals /= np.sqrt((normals**2).sum(axis=-1, keepdims=True))
    middle = places.mean(axis=1, keepdims=True)
    inside = (normals * middle).sum(axis=-1, keepdims=True)
    return np.asarray(normals * np.sign(inside))


def add_footprints(grid: PixelGrid, normals: Float, exposures: Int, values: Float, sums: Sums) -> None:
    """Add footprints to the sums of the pixels of a cell, in place.

    Parameters
    ----------
    grid : PixelGrid
        Pixels of the cell.
    normals : float array, shape (m, 4, 3)
        Unit vectors normal to the sides of each footprint, see `side_normals`.
    exposures : int64 array, shape (m,)
        Exposure of each footprint; footprints of an exposure follow each other.
    values : float array, shape (m, k)
        Values of each footprint.
    sums : Sums
        Sums, which are increased.
    """
    numbers = np.ascontiguousarray(exposures, np.int64)
    _add(
        (grid.centres, grid.group_centres, grid.block_centres),
        grid.sample_radii,
        (np.ascontiguousarray(normals), numbers, np.ascontiguousarray(values)),
        tuple(sums),
    )


@exact_jit
def _add(places: Any, radii: Any, footprints: Any, totals: Any) -> None:
    """Add footprints in place: `places` of pixels, groups and blocks, their `radii`, and `totals`, fields of `Sums`."""
    centres, groups, blocks = places
    radius, group_radius, block_radius = radii
    normals, exposure, values = footprints
    sums, counts, last, samples, edges = totals
    for b in range(len(blocks)):
        for f in range(len(normals)):
            nearest = _depth(normals[f], blocks[b])
            if nearest < -block_radius:
                continue
            if nearest >= block_radius:
                _add_whole(b * _BLOCK, (b + 1) * _BLOCK, exposure[f], values[f], sums, counts, last, samples)
                continue
            for g in range(b * _BLOCK // _GROUP, (b + 1) * _BLOCK // _GROUP):
                nearest = _depth(normals[f], groups[g])
                if nearest < -group_radius:
                    continue
                if nearest >= group_radius:
                    _add_whole(g * _GROUP, (g + 1) * _GROUP, exposure[f], values[f], sums, counts, last, samples)
                    continue
                for p in range(g * _GROUP, (g + 1) * _GROUP):
                    bits = _covered_samples(centres, p, normals[f], radius)
                    if bits == 0:
                        continue
                    count = _count(bits)
                    edges[p] |= count < SAMPLES
                    samples[p] |= bits
                    if last[p] != exposure[f]:
                        last[p] = exposure[f]
                        counts[p] += 1
                    for k in range(len(sums)):
                        sums[k, p] += count / SAMPLES * values[f, k]


@exact_jit
def _add_whole(
    first: int, past: int, exposure: int, values: Any, sums: Any, counts: Any, last: Any, samples: Any
) -> None:
    """Add a footprint that covers all of the pixels from `first` to `past` - 1 to sums, in place."""
    for p in range(first, past):
        samples[p] = _FULL
        counts[p] += last[p] != exposure
        last[p] = exposure
    for k in range(len(sums)):
        value = values[k]
        for p in range(first, past):
            sums[k, p] += value


@exact_jit
def _depth(normals: Any, place: Any) -> float:
    """Return the smallest distance (radian) of a place from the sides of a footprint, negative outside."""
    nearest = 1.0
    for side in range(len(normals)):
        distance = normals[side, 0] * place[0] + normals[side, 1] * place[1] + normals[side, 2] * place[2]
        nearest = min(nearest, distance)
    return nearest


@exact_jit
def _covered_samples(centres: Any, p: int, normals: Any, radius: float) -> int:
    """Return the samples of pixel `p` that are in a footprint, as bits."""
    if _depth(normals, centres[p]) < -radius:
        return 0
    first = p - p % 4
    bits = _FULL
    for side in range(len(normals)):
        nx, ny, nz = normals[side, 0], normals[side, 1], normals[side, 2]
        distance = nx * centres[p, 0] + ny * centres[p, 1] + nz * centres[p, 2]
        if distance >= radius:
            continue
        # The distance from a side is a linear function of the position.
        origin = nx * centres[first, 0] + ny * centres[first, 1] + nz * centres[first, 2]
        along = nx * centres[first + 1, 0] + ny * centres[first + 1, 1] + nz * centres[first + 1, 2] - origin
        across = nx * centres[first + 2, 0] + ny * centres[first + 2, 1] + nz * centres[first + 2, 2] - origin
        bit = 1
        for i in range(4):
            place = distance + _OFFSETS[i] * along
            for j in range(4):
                if place + _OFFSETS[j] * across < 0.0:
                    bits &= ~bit
                bit <<= 1
    return bits


@exact_jit
def _count(bits: int) -> int:
    """Return the number of samples in a combination of 16 bits: sums of two, four, eight and sixteen bits."""
    bits -= (bits >> 1) & 0x5555
    bits = (bits & 0x3333) + ((bits >> 2) & 0x3333)
    bits = (bits + (bits >> 4)) & 0x0F0F
    return (bits + (bits >> 8)) & 0x1F
