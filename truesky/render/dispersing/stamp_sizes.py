"""Sizes of the stamps for spectra, which depend on the light of each source.

A stamp is periodic: the light of a galaxy beyond it is aliased to the opposite edge, where it is as bright as the light
at the edge itself. The PSF is cut to the stamp.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lake_schema.arrays import Bool, Float, Float32, Int
from truesky.render.psf.model import Psf
from truesky.render.sources import galaxy_shapes
from truesky.render.sources.galaxy_shapes import Shapes
from truesky.render.sources.source_list import Sources

# Sides of stamps with fast transforms, pixels.
SIZES = np.array([16, 20, 24, 28, 32, 36, 40, 48, 56, 64, 80, 96, 128, 160, 192, 256, 320, 384, 512])
# Largest side for a galaxy. Larger galaxies are drawn in two parts (large_galaxies.py): the smooth part uses a stamp
# with one of LARGE_GALAXY_SIZES and pixels that are COARSE times as wide.
LARGEST, COARSE = 256, 4
LARGE_GALAXY_SIZES = COARSE * np.array([160, 256, 512, 1024])
_ALL_SIZES = np.concatenate([SIZES, LARGE_GALAXY_SIZES])
# Largest fraction of a galaxy's light in a row at the edge of the stamp, since a sum over many columns would show it.
# Galaxies that are so faint that this sum is negligible in a single pixel are exempt.
_MAX_EDGE_FRACTION = 5e-4
# Fraction of a galaxy's light in a row that is negligible for any brightness.
_DARK = 1e-9


@dataclass(frozen=True, slots=True)
class Sizes:
    """Light of n sources at the edges of stamps, from which their sizes follow.

    Attributes
    ----------
    point : float array, shape (s,)
        Fraction of a point source's light in a row at the edge, for each of SIZES and LARGE_GALAXY_SIZES.
    body : float32 array, shape (n, s)
        Fraction of a galaxy's light, including aliased light; 0 for point sources.
    galaxy : bool array, shape (n,)
        True for galaxies.
    extra_pixels : float array, shape (n,)
        Additional width of the stamps for pictures and trails, pixels.
    limit : float
        Electrons in a row that are not noticeable.
    min_size : int
        Smallest side, pixels.
    """

    point: Float
    body: Float32
    galaxy: Bool
    extra_pixels: Float
    limit: float
    min_size: int

    @classmethod
    def from_sources(cls, sources: Sources, psf: Psf, limit: float, min_size: int) -> Sizes:
        """Compute the light of sources at the edges of stamps.

        Parameters
        ----------
        sources : Sources
            n sources.
        psf : Psf
            PSF of the detector.
        limit : float
            Electrons in a row that are not noticeable.
        min_size : int
            Smallest side, pixels.

        Returns
        -------
        Sizes
            The light.
        """
        reach = len(psf.surface) - 1
        x = np.arange(-reach, reach + 1)
        point = [psf.surface[np.rint(np.hypot(x, size / 2)).astype(int).clip(0, reach)].sum() for size in _ALL_SIZES]
        if psf.planes is not None:
            # A point source has no light beyond its planes.
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
        """Sides of the stamps for the spectra of some sources.

        Parameters
        ----------
        selected : int array, shape (k,)
            Indices of the sources.
        peak : float array, shape (k,)
            Largest number of electrons in a column.
        total : float array, shape (k,)
            Electrons in all columns.

        Returns
        -------
        int array, shape (k,)
            Sides, pixels: from SIZES, for galaxies up to LARGEST, or from LARGE_GALAXY_SIZES.
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
    """Fraction of galaxies' light [n, s] in a row at the edges of stamps, doubled for the aliased light."""
    edge_fractions, remaining = np.zeros((len(shapes), len(_ALL_SIZES)), np.float32), np.arange(len(shapes))
    for column, size in enumerate(_ALL_SIZES.tolist()):
        # The light is taken one pixel farther in, for the width of the PSF's core.
        light = galaxy_shapes.line_brightness(shapes.take(remaining), (0.5 * size - 1.0) * pixel_scale)
        edge_fractions[remaining, column] = 2.0 * pixel_scale * light
        remaining = remaining[light * pixel_scale > _DARK]
    return edge_fractions
