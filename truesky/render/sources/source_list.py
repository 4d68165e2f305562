"""The sources to be drawn, column by column.

Sources         what is drawn: galaxies (with a shape) and points
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from lake_schema.arrays import Bool, Float, Int
from truesky.render.sources.galaxy_shapes import Shapes
from truesky.render.sources.lensed_arcs import Picture


@dataclass(frozen=True, slots=True)
class Sources:
    """n sources in the order in which they are drawn (ascending id).

    column, row : float64[n] 0-based pixel position
    jacobian    : float64[n, 2, 2] d(u, v) / d(column, row), arcsec
    electrons   : float64[n] expected
    shape       : row of `shapes`, -1 = a point or a picture alone
    photons     : float64[n, w] fraction of its photons in each sub-band of the PSF; None: flat f_nu
    picture     : row of `pictures`, -1 = no picture; None: there is none. Of a source with a shape it is the structure
                  of its disc, drawn on top of it
    trail       : float64[n, 2] pixels that a point moves by in the exposure, in the middle of which it is at its
                  position; None: nothing moves
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
        """Some of the sources."""
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
        """The picture of source i, if it has one."""
        return None if self.picture is None or self.picture[i] < 0 else self.pictures[self.picture[i]]

    def with_moving(self, moving: Sources) -> Sources:
        """These, at rest, and points that move, of later identifiers and the same shapes."""
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
        """[n] True of galaxies whose disc has a structure of its own."""
        return np.zeros(len(self), bool) if self.picture is None else (self.shape >= 0) & (self.picture >= 0)

    @property
    def trail_length(self) -> Float:
        """Of the trails, pixels."""
        return np.zeros(len(self)) if self.trail is None else np.hypot(*self.trail.T)
