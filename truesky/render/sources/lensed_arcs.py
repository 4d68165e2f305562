"""Sources that are pictures, and the lensed images of galaxies behind strong lenses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from lake_schema.arrays import Array, Float, Float32, Int
from lake_schema.errors import BadInput

# Columns of the table `strong_lenses`, and the pixel size of its pictures according to the table, arcsec.
ARC_COLUMNS = ("id", "source_id", "ra", "dec", "stamp_side", "stamp")
ARC_SCALE = 0.05


@dataclass(frozen=True, slots=True)
class Picture:
    """Image that is drawn by itself or on top of a disc.

    Attributes
    ----------
    image : float32 array, shape (ny, nx)
        Pixels of sum 1, centred on the source; of sum 0 for the structure of a disc.
    matrix : float array, shape (2, 2)
        Arcsec to the west and north (rows) for a step of one column and one row (columns).
    thick : float array, shape (2,), or None
        For the structure of a disc, the vector of `galaxy_shapes.Forms` in arcsec, which gives it the thickness of the
        disc.
    """

    image: Float32
    matrix: Float
    thick: Float | None = None

    @classmethod
    def from_sky_image(cls, image: Float32, scale: float) -> Picture:
        """Picture from an image of sum 1, south to north and west to east, with `scale` arcsec per pixel."""
        return cls(image, np.array([[-scale, 0.0], [0.0, scale]]))

    @property
    def diagonal(self) -> float:
        """Upper limit of the distance between opposite corners, arcsec."""
        west, north = np.abs(self.matrix)
        rows, columns = self.image.shape
        return float(np.hypot(west[0] * columns + west[1] * rows, north[0] * columns + north[1] * rows))

    @property
    def half_light(self) -> float:
        """Radius about its middle that contains half of its light, arcsec, to half a pixel."""
        (a, b), (c, d) = self.matrix
        step = 0.5 * float(abs(a * d - b * c)) ** 0.5
        up, across = (np.arange(n) - (n - 1) / 2 for n in self.image.shape)
        west, north = (line[0] * across + line[1] * up[:, None] for line in self.matrix)
        light = np.bincount((np.hypot(west, north) / step).astype(int).ravel(), self.image.ravel()).cumsum()
        return float((np.searchsorted(light, 0.5 * light[-1]) + 0.5) * step)

    @property
    def is_structure(self) -> bool:
        """True if the picture only redistributes the light of a disc."""
        return self.thick is not None


@dataclass(frozen=True, slots=True)
class Arcs:
    """Images of n lensed galaxies.

    Attributes
    ----------
    ids : int array, shape (n,)
        Identifiers of the lenses.
    ra, dec : float array, shape (n,)
        Positions, deg.
    electrons : float array, shape (n,)
        Expected electrons.
    source : int array, shape (n,)
        Row of the lensed galaxy.
    pictures : tuple of Picture
        The images.
    """

    ids: Int
    ra: Float
    dec: Float
    electrons: Float
    source: Int
    pictures: tuple[Picture, ...]


def arcs(rows: pa.Table, ids: Int, electrons: Float) -> Arcs:
    """Convert rows of the table `strong_lenses` to arcs.

    Parameters
    ----------
    rows : pyarrow.Table
        Rows of the table.
    ids : int array, shape (m,)
        Identifiers of galaxies.
    electrons : float array, shape (m,)
        Their expected electrons, without the magnification that catalogue fluxes include.

    Returns
    -------
    Arcs
        The arcs.

    Raises
    ------
    BadInput
        If the source of a lens is not among the galaxies.
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
    """Return the image of the arcs of a strong lens, and the sum of its pixels."""
    total = float(pixels.sum(dtype=float))
    if len(pixels) != side**2 or not total > 0.0 or not np.isfinite(total):
        actual = f"got {len(pixels)} pixels of sum {total:g}"
        raise BadInput(f"strong lens {lens}: its stamp must have {side} x {side} pixels and a positive sum, {actual}")
    return Picture.from_sky_image((pixels / total).reshape(side, side).astype(np.float32), ARC_SCALE), total
