"""List of sources to be drawn, column by column."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lake_schema.arrays import Bool, Float, Int
from truesky.render.sources.galaxy_shapes import Shapes
from truesky.render.sources.lensed_arcs import Picture


@dataclass(frozen=True, slots=True)
class Sources:
    """n sources in the order in which they are drawn (ascending identifiers).

    Attributes
    ----------
    ids : int array, shape (n,)
        Identifiers.
    column, row : float array, shape (n,)
        Positions, 0-based pixels.
    jacobian : float array, shape (n, 2, 2)
        d(u, v) / d(column, row), arcsec.
    electrons : float array, shape (n,)
        Expected electrons.
    shape : int array, shape (n,)
        Row of `shapes`, -1 for a point source or a picture without a profile.
    shapes : Shapes
        Shapes of galaxies.
    photons : float array, shape (n, w), or None
        Fraction of the photons in each sub-band of the PSF; None for flat f_nu.
    picture : int array, shape (n,), or None
        Number of the picture, -1 for none; None if no source has a picture. For a source with a shape, the picture is
        the structure of its disc, which is drawn on top of the profile.
    pictures : tuple of Picture
        The pictures.
    trail : float array, shape (n, 2), or None
        Displacement of a point source during the exposure, centred on its position, pixels; None if no source moves.
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
        """Return the selected sources."""
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
        """Picture of source `i`, or None."""
        return None if self.picture is None or self.picture[i] < 0 else self.pictures[self.picture[i]]

    def with_moving(self, moving: Sources) -> Sources:
        """Append moving point sources, with later identifiers and the same shapes, to these sources at rest."""
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
        """Mask [n] of the galaxies whose disc has a structure."""
        return np.zeros(len(self), bool) if self.picture is None else (self.shape >= 0) & (self.picture >= 0)

    @property
    def trail_length(self) -> Float:
        """Lengths of the trails [n], pixels."""
        return np.zeros(len(self)) if self.trail is None else np.hypot(*self.trail.T)
