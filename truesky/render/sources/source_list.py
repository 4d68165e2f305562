"""Define the list of sources (galaxies, stars, moving bodies) to be drawn on a detector, as arrays."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lake_schema.arrays import Bool, Float, Int
from truesky.render.sources.galaxy_shapes import Shapes
from truesky.render.sources.lensed_arcs import Picture


@dataclass(frozen=True, slots=True)
class Sources:
    """n sources of light on a detector, in the order in which they are drawn (ascending identifiers).

    Attributes
    ----------
    ids : int array, shape (n,)
        Source identifiers.
    column, row : float array, shape (n,)
        Pixel positions on the detector, counted from 0; they may lie outside it.
    jacobian : float array, shape (n, 2, 2)
        Arcsec to the west and north (rows) for a step of one column and one row (columns), at each source.
    electrons : float array, shape (n,)
        Expected electrons during the exposure.
    shape : int array, shape (n,)
        Index of the galaxy in `shapes`; -1 for a point source, or for a source that is drawn from a picture alone.
    shapes : Shapes
        Shapes (Sersic bulge and exponential disc) of galaxies.
    photons : float array, shape (n, w), or None
        Fraction of the detected photons in each of the w sub-bands of the passband, in which the PSF differs; None if
        all sources have flat f_nu.
    picture : int array, shape (n,), or None
        Index of the source's image in `pictures`, -1 for none; None if no source has an image. If the source also has a
        shape, the image is the structure of its disc, which is added to the smooth profile.
    pictures : tuple of Picture
        Images of sources.
    trail : float array, shape (n, 2), or None
        Motion (columns, rows) of a point source during the exposure in pixels, with its position in the middle; None if
        no source moves.
    """

    ids: Int
    column: Float
    row: Float
    jacobian: Float
    electrons: Float
    shape: Int
    shapes: Shapes
    photons: Float | None = None
    picture: Int | None = None
    pictures: tuple[Picture, ...] = ()
    trail: Float | None = None

    def __len__(self) -> int:
        return len(self.ids)

    def take(self, chosen: Bool | Int) -> Sources:
        """Return the sources that a mask selects, or the sources with given indices in the order of the indices."""
        return Sources(
            self.ids[chosen],
            self.column[chosen],
            self.row[chosen],
            self.jacobian[chosen],
            self.electrons[chosen],
            self.shape[chosen],
            self.shapes,
            None if self.photons is None else self.photons[chosen],
            None if self.picture is None else self.picture[chosen],
            self.pictures,
            None if self.trail is None else self.trail[chosen],
        )

    def picture_of(self, i: int) -> Picture | None:
        """Return the image of source number `i` (from 0), or None if it has none."""
        return None if self.picture is None or self.picture[i] < 0 else self.pictures[self.picture[i]]

    def with_moving(self, moving: Sources) -> Sources:
        """Return these sources, which are at rest, followed by moving point sources.

        The identifiers of `moving` must be larger and its `shapes` the same; this is not checked.
        """
        names = ("ids", "column", "row", "jacobian", "electrons", "shape")
        columns: dict[str, Any] = {n: np.concatenate([getattr(self, n), getattr(moving, n)]) for n in names}
        photons = None if self.photons is None else np.concatenate([self.photons, moving.photons])
        picture = None if self.picture is None else np.concatenate([self.picture, np.full(len(moving), -1)])
        trail = np.concatenate([np.zeros((len(self), 2)), moving.trail])
        return Sources(
            **columns, shapes=self.shapes, photons=photons, picture=picture, pictures=self.pictures, trail=trail
        )

    @property
    def has_structure(self) -> Bool:
        """True for galaxies that have an image of the structure of their disc (spiral arms and knots), shape (n,)."""
        return np.zeros(len(self), bool) if self.picture is None else (self.shape >= 0) & (self.picture >= 0)

    @property
    def trail_length(self) -> Float:
        """Length of each source's trail during the exposure in pixels, shape (n,); 0 for sources at rest."""
        return np.zeros(len(self)) if self.trail is None else np.hypot(*self.trail.T)
