"""Sizes of the stamps from which slitless spectra are drawn.

A stamp is a square image around a source, computed with discrete Fourier transforms. It is therefore periodic: the
light of a galaxy just beyond an edge appears inside the opposite edge, and doubles the light there. The wings of the
PSF beyond the stamp are lost. For both reasons a bright source needs a large stamp.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lake_schema.arrays import Bool, Float, Float32, Int
from truesky.render.psf.model import Psf
from truesky.render.sources import galaxy_shapes
from truesky.render.sources.galaxy_shapes import Shapes
from truesky.render.sources.source_list import Sources

# Allowed sides of stamps (square images of sources), pixels. For these numbers, Fourier transforms are fast.
SIZES = np.array([16, 20, 24, 28, 32, 36, 40, 48, 56, 64, 80, 96, 128, 160, 192, 256, 320, 384, 512])
# Largest side of the stamp of a galaxy that is drawn as a whole, pixels. A galaxy that needs a larger stamp is drawn in
# two parts: its image after a wide Gaussian filter (smooth part), and the sharp rest (large_galaxies.py).
LARGEST = 256
# A galaxy that needs a stamp larger than LARGEST is drawn in a sharp and a smooth part. The smooth part is drawn on
# coarse pixels, and this is their width in detector pixels.
COARSE = 4
# Allowed sides, in detector pixels, of the stamp for the smooth part of a galaxy that is too large to be drawn as a
# whole.
LARGE_GALAXY_SIZES = COARSE * np.array([160, 256, 512, 1024])
_ALL_SIZES = np.concatenate([SIZES, LARGE_GALAXY_SIZES])
# A stamp must be so large that at most this fraction of a galaxy's light lies in the row of pixels at its edge. This
# holds even if the light is not noticeable in any pixel, since it may be noticeable in the sum over all columns of the
# spectrum. Galaxies for which even this sum is below the limit for a single pixel are exempt.
_MAX_EDGE_FRACTION = 5e-4
# If the row of pixels at the edge of a stamp has less than this fraction of a galaxy's light, the fraction at the edges
# of all larger stamps is treated as 0.
_DARK = 1e-9


@dataclass(frozen=True, slots=True)
class Sizes:
    """Light of n sources at the edges of stamps of all sizes, from which the sizes of the stamps are chosen.

    A stamp is the periodic square image of a source.

    Attributes
    ----------
    point : float array, shape (s,)
        Fraction of a point source's light in the row of pixels at the edge of a stamp, for each of the s sizes (SIZES,
        then LARGE_GALAXY_SIZES).
    body : float32 array, shape (n, s)
        Fraction of a galaxy's light, before the PSF, in the row of pixels at the edge of a stamp of each size. It
        includes the equal light that the periodic image repeats from the opposite edge. 0 for point sources.
    galaxy : bool array, shape (n,)
        True for galaxies with a bulge or disc profile.
    extra_pixels : float array, shape (n,)
        Pixels by which stamps must be wider for sources that are drawn from pictures (given images) or are moving; 0
        for others.
    limit : float
        Electrons below which the light in a pixel at the edge is not noticeable.
    min_size : int
        Smallest allowed side of a stamp, pixels.
    """

    point: Float
    body: Float32
    galaxy: Bool
    extra_pixels: Float
    limit: float
    min_size: int

    @classmethod
    def from_sources(cls, sources: Sources, psf: Psf, limit: float, min_size: int) -> Sizes:
        """Compute the light of sources at the edges of stamps (square images of sources) of all allowed sizes.

        Parameters
        ----------
        sources : Sources
            The n sources.
        psf : Psf
            PSF of the detector.
        limit : float
            Electrons below which the light in a pixel at the edge is not noticeable.
        min_size : int
            Smallest side of a stamp, pixels.

        Returns
        -------
        Sizes
            Light of the sources at the edges of stamps.
        """
        reach = len(psf.surface) - 1
        x = np.arange(-reach, reach + 1)
        point = [psf.surface[np.rint(np.hypot(x, size / 2)).astype(int).clip(0, reach)].sum() for size in _ALL_SIZES]
        if psf.planes is not None:
            # The light of a point source ends at the border of the PSF images, so larger stamps have none at their
            # edge.
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
        """Return the sides of the stamps (square images) with which the spectra of k sources are drawn.

        Parameters
        ----------
        selected : int array, shape (k,)
            Indices of the sources.
        peak : float array, shape (k,)
            Electrons of each spectrum in its brightest column, summed over rows.
        total : float array, shape (k,)
            Electrons of each spectrum in all columns.

        Returns
        -------
        int array, shape (k,)
            Sides, pixels: the smallest allowed ones for which the light at the edge of the stamp is not noticeable. For
            galaxies, one of SIZES up to LARGEST, or one of LARGE_GALAXY_SIZES. For other sources, one of SIZES. If no
            side is large enough, the largest.
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
    """Return the fraction of each galaxy's light in the row of pixels at the edge of a stamp, for all s sizes: [n, s].

    `pixel_scale` is in arcsec per pixel. The fraction is doubled, because a stamp is periodic and repeats the equal
    light beyond the opposite edge. It is 0 for all sizes after the first one at which the light is below `_DARK`.
    """
    edge_fractions, remaining = np.zeros((len(shapes), len(_ALL_SIZES)), np.float32), np.arange(len(shapes))
    for column, size in enumerate(_ALL_SIZES.tolist()):
        # The light of the profile without PSF is computed one pixel inside the edge of the stamp. This approximates
        # that the PSF moves light outwards.
        light = galaxy_shapes.line_brightness(shapes.take(remaining), (0.5 * size - 1.0) * pixel_scale)
        edge_fractions[remaining, column] = 2.0 * pixel_scale * light
        remaining = remaining[light * pixel_scale > _DARK]
    return edge_fractions
