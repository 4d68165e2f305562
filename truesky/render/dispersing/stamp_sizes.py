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
LARGE_GALAXY_SIZES = COARSE * np.array([160, 256, 512, 1024])
_ALL_SIZES = np.concatenate([SIZES, LARGE_GALAXY_SIZES])
# Of a galaxy's light, at most in a row at the stamp's edge: a sum over many columns would show it. But for a galaxy so
# faint that such a sum is not seen in a single pixel.
_MAX_EDGE_FRACTION = 5e-4
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
    extra_pixels: Float
    limit: float
    min_size: int

    @classmethod
    def from_sources(cls, sources: Sources, psf: Psf, limit: float, min_size: int) -> Sizes:
        """Of sources.  psf : of the detector;  limit, least : electrons of a row, pixels"""
        reach = len(psf.surface) - 1
        x = np.arange(-reach, reach + 1)
        point = [psf.surface[np.rint(np.hypot(x, size / 2)).astype(int).clip(0, reach)].sum() for size in _ALL_SIZES]
        if psf.planes is not None:
            # A point has no light beyond its planes.
            point = [0.0 if size >= psf.side else light for size, light in zip(_ALL_SIZES, point, strict=True)]
        galaxy = sources.shape >= 0
        body = np.zeros((len(sources), len(_ALL_SIZES)), np.float32)
        body[galaxy] = _edge_light(sources.shapes.take(sources.shape[galaxy]), psf.pixel_scale)
        pictured = (sources.picture_of(i) for i in range(len(sources)))
        extra_pixels = np.array(
            [0.0 if picture is None else picture.diagonal / psf.pixel_scale for picture in pictured]
        )
        return cls(np.array(point), body, galaxy, extra_pixels + sources.trail_length, limit, min_size)

    def size(self, selected: Int, peak: Float, total: Float) -> Int:
        """[k] For spectra of some sources, of so many electrons a column at most, and in all columns.

        One of SIZES; of galaxies up to LARGEST, or one of GIANTS
        """
        body = self.body[selected]
        dark = (self.point + body) * peak[:, None] < self.limit
        dark &= (body < _MAX_EDGE_FRACTION) | (body * total[:, None] < self.limit)
        fits = dark.any(axis=1)
        size_for_light = _ALL_SIZES[np.where(fits, dark.argmax(axis=1), len(_ALL_SIZES) - 1)]
        required = np.maximum(size_for_light, self.min_size) + self.extra_pixels[selected]
        rounded = _ALL_SIZES[np.minimum(np.searchsorted(_ALL_SIZES, required), len(_ALL_SIZES) - 1)]
        of_galaxy = np.where(rounded > LARGEST, np.maximum(rounded, LARGE_GALAXY_SIZES[0]), rounded)
        return np.asarray(np.where(self.galaxy[selected], of_galaxy, np.minimum(rounded, SIZES[-1])))


def _edge_light(shapes: Shapes, pixel_scale: float) -> Float32:
    """float32[n, s] of a galaxy's light in a row at the edges of stamps, twice: with what comes in there."""
    edge_fractions, remaining = np.zeros((len(shapes), len(_ALL_SIZES)), np.float32), np.arange(len(shapes))
    for column, size in enumerate(_ALL_SIZES.tolist()):
        # A pixel farther in, for the width of the PSF's core.
        light = galaxy_shapes.line_brightness(shapes.take(remaining), (0.5 * size - 1.0) * pixel_scale)
        edge_fractions[remaining, column] = 2.0 * pixel_scale * light
        remaining = remaining[light * pixel_scale > _DARK]
    return edge_fractions
