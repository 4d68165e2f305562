"""Add the footprints of detectors to the pixels of a HEALPix cell, with the part of each pixel that they cover.

The part is counted on 16 samples per pixel, the centres of its children two orders below. The sides of a footprint are
great circles. Only pixels near a side are divided into samples: blocks of 256 pixels that are far from all sides
are tested as a whole.

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
# Orders between a block of pixels, which is tested as a whole, and its pixels.
_BLOCK_ORDERS = 4
# Pixels per block.
_BLOCK = 1 << 2 * _BLOCK_ORDERS
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
    block_centres : float array, shape (n / 256, 3)
        Unit vectors to the centres of the blocks of 256 consecutive pixels.
    pixel_radius, block_radius : float
        Largest distance between the centre of a pixel or block and its corners, radian.
    """

    order: int
    cell: int
    pixel_order: int
    centres: Float
    block_centres: Float
    pixel_radius: float
    block_radius: float

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

        radii = [float(np.radians(sky.cell_radius(fine))) for fine in (pixel_order, pixel_order - _BLOCK_ORDERS)]
        return cls(order, cell, pixel_order, centres(pixel_order), centres(pixel_order - _BLOCK_ORDERS), *radii)

    @property
    def first_pixel(self) -> int:
        """Nested number of the first pixel."""
        return self.cell << 2 * (self.pixel_order - self.order)


class Sums(NamedTuple):
    """Sums over the footprints in each of n pixels.

    Attributes
    ----------
    values : float array, shape (n, k)
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
            np.zeros((pixels, values)),
            np.zeros(pixels, np.int32),
            np.full(pixels, -1, np.int64),
            np.zeros(pixels, np.int32),
            np.zeros(pixels, bool),
        )

    def select(self, chosen: Bool) -> Sums:
        """Return the sums in the pixels with True flags."""
        columns: list[Any] = [column[chosen] for column in self]
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
        (grid.centres, grid.block_centres),
        (grid.pixel_radius, grid.block_radius),
        (np.ascontiguousarray(normals), numbers, np.ascontiguousarray(values)),
        tuple(sums),
    )


@exact_jit
def _add(places: Any, radii: Any, footprints: Any, totals: Any) -> None:
    """Add footprints in place: `places` and `radii` of pixels and blocks, and `totals`, the fields of `Sums`."""
    centres, blocks = places
    radius, block_radius = radii
    normals, exposure, values = footprints
    sums, counts, last, samples, edges = totals
    for f in range(len(normals)):
        for b in range(len(blocks)):
            nearest = _depth(normals[f], blocks[b])
            if nearest < -block_radius:
                continue
            is_inside = nearest >= block_radius
            for p in range(b * _BLOCK, (b + 1) * _BLOCK):
                bits, part = _FULL, 1.0
                if not is_inside:
                    bits = _covered_samples(centres, p, normals[f], radius)
                    if bits == 0:
                        continue
                    if bits != _FULL:
                        edges[p] = True
                        part = 0.0
                        for i in range(SAMPLES):
                            part += ((bits >> i) & 1) / SAMPLES
                samples[p] |= bits
                if last[p] != exposure[f]:
                    last[p] = exposure[f]
                    counts[p] += 1
                for k in range(values.shape[1]):
                    sums[p, k] += part * values[f, k]


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
    nearest = _depth(normals, centres[p])
    if nearest < -radius:
        return 0
    if nearest >= radius:
        return _FULL
    first = p - p % 4
    bits = 0
    for i in range(4):
        for j in range(4):
            inside = True
            for side in range(len(normals)):
                distance = 0.0
                for axis in range(3):
                    along = centres[first + 1, axis] - centres[first, axis]
                    across = centres[first + 2, axis] - centres[first, axis]
                    place = centres[p, axis] + _OFFSETS[i] * along + _OFFSETS[j] * across
                    distance += normals[side, axis] * place
                inside = inside and distance >= 0.0
            if inside:
                bits |= 1 << (4 * i + j)
    return bits
