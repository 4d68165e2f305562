"""How large the stamps are that spectra are drawn on: as large as their light asks for.

A stamp is periodic: what a galaxy has beyond it comes in at the opposite edge, and is as bright there as what it has
at the edge itself. The PSF is cut to the stamp.

Sizes        of the stamps of some sources
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jobs.render.psf.model import Psf
from jobs.render.sources import galaxy_shapes
from jobs.render.sources.galaxy_shapes import Shapes
from jobs.render.sources.source_list import Sources
from lake_schema.arrays import Bool, Float, Float32, Int

# Sides of stamps whose transforms are fast.
SIZES = np.array([16, 20, 24, 28, 32, 36, 40, 48, 56, 64, 80, 96, 128, 160, 192, 256, 320, 384, 512])
# Pixels between those of the stamp that the smooth light of a galaxy is drawn on which no other stamp holds; its side.
COARSE = 8
GIANT = COARSE * int(SIZES[-1])
# Of a galaxy's light, at most in a row at the stamp's edge: a sum over many columns would show it. But for a galaxy so
# faint that such a sum is not seen in a single pixel.
_PART = 5e-4
# Of a galaxy's light in a row, what no brightness shows.
_DARK = 1e-9


@dataclass(frozen=True, slots=True)
class Sizes:
    """Of n sources.

    point : float64[s] fraction of a point's light in a row at the edge of each of SIZES
    body  : float32[n, s] of a galaxy's, with what comes in there; 0 of a point;  galaxy : bool[n] which are galaxies
    wider : float64[n] pixels that a stamp is wider, of pictures and trails
    limit : electrons of a row that are not seen;  least : smallest side, pixels
    """

    point: Float
    body: Float32
    galaxy: Bool
    wider: Float
    limit: float
    least: int

    @classmethod
    def of(cls, sources: Sources, psf: Psf, limit: float, least: int) -> Sizes:
        """Of sources.  psf : of the detector;  limit, least : electrons of a row, pixels"""
        reach = len(psf.surface) - 1
        x = np.arange(-reach, reach + 1)
        point = [psf.surface[np.rint(np.hypot(x, size / 2)).astype(int).clip(0, reach)].sum() for size in SIZES]
        if psf.planes is not None:
            # A point has no light beyond its planes.
            point = [0.0 if size >= psf.side else light for size, light in zip(SIZES, point, strict=True)]
        galaxy = sources.shape >= 0
        body = np.zeros((len(sources), len(SIZES)), np.float32)
        body[galaxy] = _rows(sources.shapes.take(sources.shape[galaxy]), psf.pixel_scale)
        pictured = (sources.picture_of(i) for i in range(len(sources)))
        wider = np.array([0.0 if picture is None else picture.diagonal / psf.pixel_scale for picture in pictured])
        return cls(np.array(point), body, galaxy, wider + sources.length, limit, least)

    def size(self, some: Int, peak: Float, total: Float) -> Int:
        """[k] For spectra of some sources, of so many electrons a column at most, and in all columns.

        GIANT where none of SIZES will do
        """
        body = self.body[some]
        dark = (self.point + body) * peak[:, None] < self.limit
        dark &= (body < _PART) | (body * total[:, None] < self.limit)
        held = dark.any(axis=1)
        own = SIZES[np.where(held, dark.argmax(axis=1), len(SIZES) - 1)]
        wanted = np.maximum(own, self.least) + self.wider[some]
        found = SIZES[np.minimum(np.searchsorted(SIZES, wanted), len(SIZES) - 1)]
        return np.asarray(np.where(self.galaxy[some] & ~held, GIANT, found))


def _rows(shapes: Shapes, pixel_scale: float) -> Float32:
    """float32[n, s] of a galaxy's light in a row at the edges of stamps, twice: with what comes in there."""
    found, left = np.zeros((len(shapes), len(SIZES)), np.float32), np.arange(len(shapes))
    for column, size in enumerate(SIZES.tolist()):
        # A pixel farther in, for the width of the PSF's core.
        light = galaxy_shapes.line(shapes.take(left), (0.5 * size - 1.0) * pixel_scale)
        found[left, column] = 2.0 * pixel_scale * light
        left = left[light * pixel_scale > _DARK]
    return found
