"""Sources that are pictures; the lensed images of a galaxy behind a strong lens, as such.

Picture         surface brightness on a grid of its own
arcs            rows of strong lenses -> pictures, places and electrons
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from lake_schema.arrays import Array, Float, Float32, Int
from lake_schema.errors import BadInput

# What is read of the table `strong_lenses`; arcsec of a pixel of its pictures, as the table declares.
ARC_COLUMNS = ("id", "source_id", "ra", "dec", "stamp_side", "stamp")
ARC_SCALE = 0.05


@dataclass(frozen=True, slots=True)
class Picture:
    """What is drawn as it is, or on top of a disc.

    image  : float32[ny, nx] of sum 1, its place in the middle; of sum 0 where it is a disc's structure
    matrix : float64[2, 2] arcsec to the west and to the north (rows) of a step to its next column and to its next row
             (columns)
    thick  : float64[2] of a disc's structure: galaxy_shapes.Forms' for arcsec, by which it is as thick as its disc
    """

    image: Float32
    matrix: Float
    thick: Float | None = None

    @classmethod
    def from_sky_image(cls, image: Float32, scale: float) -> Picture:
        """An image of sum 1, south to north and west to east; scale : arcsec."""
        return cls(image, np.array([[-scale, 0.0], [0.0, scale]]))

    @property
    def diagonal(self) -> float:
        """Corner to corner, arcsec; no less of an image that is drawn on a slant."""
        west, north = np.abs(self.matrix)
        rows, columns = self.image.shape
        return float(np.hypot(west[0] * columns + west[1] * rows, north[0] * columns + north[1] * rows))

    @property
    def half_light(self) -> float:
        """Radius about its middle that holds half of its light, arcsec, to half a pixel."""
        (a, b), (c, d) = self.matrix
        step = 0.5 * float(abs(a * d - b * c)) ** 0.5
        up, across = (np.arange(n) - (n - 1) / 2 for n in self.image.shape)
        west, north = (line[0] * across + line[1] * up[:, None] for line in self.matrix)
        light = np.bincount((np.hypot(west, north) / step).astype(int).ravel(), self.image.ravel()).cumsum()
        return float((np.searchsorted(light, 0.5 * light[-1]) + 0.5) * step)

    @property
    def is_structure(self) -> bool:
        """Light that is moved about on a disc, none by itself."""
        return self.thick is not None


@dataclass(frozen=True, slots=True)
class Arcs:
    """n lensed galaxies: id, ra, dec in deg, electrons, the row of the galaxy that they are an image of, pictures."""

    ids: Int
    ra: Float
    dec: Float
    electrons: Float
    source: Int
    pictures: tuple[Picture, ...]


def arcs(rows: pa.Table, ids: Int, electrons: Float) -> Arcs:
    """Rows of the table `strong_lenses` -> Arcs.

    ids, electrons : [m] of galaxies, without the magnification of their own that fluxes hold
    """
    source_ids, order = rows["source_id"].to_numpy(), np.argsort(ids, kind="stable")
    at = np.searchsorted(ids, source_ids, sorter=order)
    source = order[np.minimum(at, len(ids) - 1)] if len(ids) else np.zeros(len(source_ids), np.int64)
    for lens, source_id, i in zip(rows["id"].to_pylist(), source_ids.tolist(), source.tolist(), strict=True):
        if not len(ids) or ids[i] != source_id:
            raise BadInput(f"strong lens {lens}: its source {source_id} is not among the galaxies")
    drawn = rows["stamp"].combine_chunks()
    pixels, ends = drawn.flatten().to_numpy(zero_copy_only=False), np.cumsum(drawn.value_lengths().to_numpy())
    lenses, sides = rows["id"].to_pylist(), rows["stamp_side"].to_pylist()
    stamps = np.split(pixels, ends[:-1]) if len(ends) else []
    pictures = [_picture(*arguments) for arguments in zip(lenses, sides, stamps, strict=True)]
    return Arcs(
        rows["id"].to_numpy().astype(np.int64),
        rows["ra"].to_numpy(),
        rows["dec"].to_numpy(),
        electrons[source] * np.array([total for _, total in pictures]),
        source,
        tuple(picture for picture, _ in pictures),
    )


def _picture(lens: int, side: int, pixels: Array) -> tuple[Picture, float]:
    """A strong lens' picture, and its sum."""
    total = float(pixels.sum(dtype=float))
    if len(pixels) != side**2 or not total > 0.0 or not np.isfinite(total):
        raise BadInput(f"strong lens {lens}: its stamp of side {side} has {len(pixels)} pixels of sum {total:g}")
    return Picture.from_sky_image((pixels / total).reshape(side, side).astype(np.float32), ARC_SCALE), total
