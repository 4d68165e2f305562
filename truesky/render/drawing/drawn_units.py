"""Keep the light of drawn sources in integers, and convert it to electrons."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lake_schema.arrays import Float, Int
from truesky.render.drawing import wings
from truesky.render.drawing.kernels.frame import to_electrons


@dataclass(frozen=True, slots=True)
class DrawnUnits:
    """Light of sources on a frame (image of the detector) in integers, so that sums do not depend on the order.

    Attributes
    ----------
    frame : int64 array, shape (ny, nx)
        Light of the stamps.
    layer : float array
        Light beyond the stamps on blocks of pixels, as in `wings.wings`: multiples of 1 / `unit`.
    unit : float
        Factor from electrons to the integers of the frame.
    """

    frame: Int
    layer: Float
    unit: float

    def electrons_with(self, other: DrawnUnits) -> Float:
        """Return the electrons [ny, nx] of these sources and of others, which have the same unit."""
        frame, layer = self.frame + other.frame, self.layer + other.layer
        return np.asarray(to_electrons(frame, self.unit, layer, wings.BLOCK, wings.MARGIN))

    def electrons_of_columns(self, first: int, past: int) -> Float:
        """Return the electrons [ny, n] of the columns from `first`, a multiple of `wings.BLOCK`, to `past` - 1."""
        layer = np.ascontiguousarray(self.layer[:, first // wings.BLOCK :])
        return np.asarray(to_electrons(self.frame[:, first:past].copy(), self.unit, layer, wings.BLOCK, wings.MARGIN))

    def max_of_columns(self) -> Float:
        """Return an upper limit [nx] of the electrons of each column's brightest pixel."""
        # A pixel is interpolated between the centres of its block of pixels and of an adjacent block.
        blocks = self.layer.max(axis=0)
        upper = np.maximum(np.maximum(blocks[:-2], blocks[1:-1]), blocks[2:])
        smooth = upper[wings.MARGIN - 1 + np.arange(self.frame.shape[1]) // wings.BLOCK]
        return np.asarray(self.frame.max(axis=0) / self.unit + smooth)
