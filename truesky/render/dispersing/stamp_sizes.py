"""How large the stamps are that spectra are drawn on: as large as their light asks for.

A stamp is periodic: what a galaxy has beyond it comes in at the opposite edge, and is as bright there as what it has
at the edge itself. The PSF is cut to the stamp.

Sizes        of the stamps of some sources
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lake_schema.arrays import Bool, Float, Float32, Int
from truesky.render.psf.model import Psf
from truesky.render.sources import galaxy_shapes
from truesky.render.sources.galaxy_shapes import Shapes
from truesky.render.sources.source_list import Sources

# Sides of stamps whose transforms are fast.
SIZES = np.array([16, 20, 24, 28, 32, 36, 40, 48, 56, 64, 80, 96, 128, 160, 192, 256, 320, 384, 512])
# The largest of them for a galaxy.  One that is wider is a giant (giants.py): it is drawn in two parts, what is smooth
# on a stamp of one of the sides that follow, of pixels COARSE times as wide.
LARGEST, COARSE = 256, 4
GIANTS = COARSE * np.array([160, 256, 512, 1024])
_ALL = np.concatenate([SIZES, GIANTS])
# Of a galaxy's light, at most in a row at the stamp's edge: a sum over many columns would show it. But for a galaxy so
# faint that such a sum is not seen in a single pixel.
_PART = 5e-4
# Of a galaxy's light in a row, what no brightness shows.
_DARK = 1e-9


@dataclass(frozen=True, slots=True)
class Sizes:
    """Of n sources.

    point : float64[s] fraction of a point's light in a row at the edge of each of SIZES and GIANTS
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
        point = [psf.surface[np.rint(np.hypot(x, size / 2)).astype(int).clip(0, reach)].sum() for size in _ALL]
        if psf.planes is not None:
            # A point has no light beyond its planes.
            point = [0.0 if size >= psf.side else light for size, light in zip(_ALL, point, strict=True)]
        galaxy = sources.shape >= 0
        body = np.zeros((len(sources), len(_ALL)), np.float32)
        body[galaxy] = _rows(sources.shapes.take(sources.shape[galaxy]), psf.pixel_scale)
        pictured = (sources.picture_of(i) for i in range(len(sources)))
        wider = np.array([0.0 if picture is None else picture.diagonal / psf.pixel_scale for picture in pictured])
        return cls(np.array(point), body, galaxy, wider + sources.length, limit, least)

    def size(self, some: Int, peak: Float, total: Float) -> Int:
        """[k] For spectra of some sources, of so many electrons a column at most, and in all columns.

        One of SIZES; of galaxies up to LARGEST, or one of GIANTS
        """
        body = self.body[some]
        dark = (self.point + body) * peak[:, None] < self.limit
        dark &= (body < _PART) | (body * total[:, None] < self.limit)
        held = dark.any(axis=1)
        own = _ALL[np.where(held, dark.argmax(axis=1), len(_ALL) - 1)]
        wanted = np.maximum(own, self.least) + self.wider[some]
        found = _ALL[np.minimum(np.searchsorted(_ALL, wanted), len(_ALL) - 1)]
        of_galaxy = np.where(found > LARGEST, np.maximum(found, GIANTS[0]), found)
        return np.asarray(np.where(self.galaxy[some], of_galaxy, np.minimum(found, SIZES[-1])))


def _rows(shapes: Shapes, pixel_scale: float) -> Float32:
    """float32[n, s] of a galaxy's light in a row at the edges of stamps, twice: with what comes in there."""
    found, left = np.zeros((len(shapes), len(_ALL)), np.float32), np.arange(len(shapes))
    for column, size in enumerate(_ALL.tolist()):
        # A pixel farther in, for the width of the PSF's core.
        light = galaxy_shapes.line(shapes.take(left), (0.5 * size - 1.0) * pixel_scale)
        found[left, column] = 2.0 * pixel_scale * light
        left = left[light * pixel_scale > _DARK]
    return found
