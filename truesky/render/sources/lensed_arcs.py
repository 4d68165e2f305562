"""Define sources that are drawn from an image instead of a profile, such as arcs of galaxies behind strong lenses."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pyarrow as pa

from lake_schema.arrays import Array, Float, Float32, Int
from lake_schema.errors import BadInput

# Columns of the table `strong_lenses` that are needed to draw arcs.
ARC_COLUMNS = ("id", "source_id", "ra", "dec", "stamp_side", "stamp")
# Pixel size in arcsec of the images of arcs in the table `strong_lenses`.
ARC_SCALE = 0.05


@dataclass(frozen=True, slots=True)
class Picture:
    """Image from which a source is drawn, or which adds structure (spiral arms) to the smooth disc of a galaxy.

    Attributes
    ----------
    image : float32 array, shape (ny, nx)
        Pixels, centred on the source. Their sum is 1 for a source, and 0 for the structure of a disc.
    matrix : float array, shape (2, 2)
        Arcsec to the west and north (rows of the matrix) for a step of one column and one row (columns of the matrix).
    thick : float array, shape (2,), or None
        Vector along the minor axis in arcsec that describes the thickness of an inclined disc, defined as in
        `galaxy_shapes.Forms.thick`; None for the image of a source.
    """

    image: Float32
    matrix: Float
    thick: Float | None = None

    @classmethod
    def from_sky_image(cls, image: Float32, scale: float) -> Picture:
        """Return a picture from an image of sum 1 whose rows run from south to north and columns from west to east.

        `scale` is its pixel size in arcsec.
        """
        return cls(image, np.array([[-scale, 0.0], [0.0, scale]]))

    @property
    def diagonal(self) -> float:
        """Upper limit of the distance between opposite corners of the image on the sky, arcsec."""
        west, north = np.abs(self.matrix)
        rows, columns = self.image.shape
        return float(np.hypot(west[0] * columns + west[1] * rows, north[0] * columns + north[1] * rows))

    @property
    def half_light(self) -> float:
        """Radius in arcsec of the circle about the middle that contains half of the image's light.

        The error is half a pixel of the image. The radius is meaningful only for an image of sum 1.
        """
        (a, b), (c, d) = self.matrix
        step = 0.5 * float(abs(a * d - b * c)) ** 0.5
        up, across = (np.arange(n) - (n - 1) / 2 for n in self.image.shape)
        west, north = (line[0] * across + line[1] * up[:, None] for line in self.matrix)
        light = np.bincount((np.hypot(west, north) / step).astype(int).ravel(), self.image.ravel()).cumsum()
        return float((np.searchsorted(light, 0.5 * light[-1]) + 0.5) * step)

    @property
    def is_structure(self) -> bool:
        """True if the image is the structure of a disc, which only redistributes its light; False for a source."""
        return self.thick is not None


@dataclass(frozen=True, slots=True)
class Arcs:
    """Arcs around n strong lenses: the lensed images of the galaxies behind them.

    Attributes
    ----------
    ids : int array, shape (n,)
        Identifiers of the lenses (deflectors).
    ra, dec : float array, shape (n,)
        ICRS positions of the middle of the images in degrees.
    electrons : float array, shape (n,)
        Expected electrons of all arcs of a lens.
    source : int array, shape (n,)
        Index of the galaxy behind the lens in the list of galaxies.
    pictures : tuple of Picture
        Image of all arcs of each lens, with the sum 1.
    """

    ids: Int
    ra: Float
    dec: Float
    electrons: Float
    source: Int
    pictures: tuple[Picture, ...]


def arcs(rows: pa.Table, ids: Int, electrons: Float) -> Arcs:
    """Convert rows of the table `strong_lenses` to the arcs that are drawn.

    Parameters
    ----------
    rows : pyarrow.Table
        n rows of the table, with the columns `ARC_COLUMNS`.
    ids : int array, shape (m,)
        Identifiers of the galaxies that have been read, in any order.
    electrons : float array, shape (m,)
        Expected electrons of these galaxies without lensing, whereas catalogue fluxes include the magnification.

    Returns
    -------
    Arcs
        One set of arcs per row. Its electrons are the electrons of the galaxy times the sum of the image in the row,
        which is the magnification.

    Raises
    ------
    BadInput
        If the galaxy behind a lens is not among `ids`, or if an image has a wrong size or no light.
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
    """Return the image of the arcs of a strong lens, scaled to the sum 1, and the original sum of its pixels.

    `lens` is the identifier of the lens for messages. `pixels` has `side` rows of `side` pixels, one after another.
    Raises BadInput for another number of pixels, or if the sum is not positive and finite.
    """
    total = float(pixels.sum(dtype=float))
    if len(pixels) != side**2 or not total > 0.0 or not np.isfinite(total):
        actual = f"got {len(pixels)} pixels of sum {total:g}"
        raise BadInput(f"strong lens {lens}: its stamp must have {side} x {side} pixels and a positive sum, {actual}")
    return Picture.from_sky_image((pixels / total).reshape(side, side).astype(np.float32), ARC_SCALE), total
