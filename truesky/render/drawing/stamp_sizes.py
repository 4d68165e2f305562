"""Sizes of the stamps of sources, and the distance up to which sources shine beyond them.

A stamp of side N is periodic: a pixel at x from the source's middle has F sum_m f(x + N m) electrons, where F is the
flux, f(r) its fraction in a pixel at r, and m runs over pairs of integers. A side is large enough if

1. the light at the edge, F f(N / 2), is less than `edge` times the pixel noise, since a visible cut appears as a square
   around the source. For a PSF with spikes, f(N / 2) is the largest value along columns and rows; over a galaxy it is
   smeared.
2. aliased light is less than `aliased` times the flux in an aperture of area a about the source. There x is small, and
   for f = c r^-k the sum over m other than 0 is c N^-k Z(k), with the lattice sum Z(k) = sum |m|^-k. It is 9.03 for k =
   3 of the PSF, and at most 6 for the flattest wings of galaxies. So a Z f(N) < aliased. Shear is biased by the part
   that changes with shear, d ln f / d gamma = k. From k = 3 this matters more than the flux, and Z is multiplied by k /
   3, with k measured between N and 1.05 N.
3. it is at least the smallest side for an accuracy, plus 4 half-light radii for a galaxy, since the PSF's wings beyond
   the stamp are drawn as for a point source (wings.py).

A PSF in planes is cut to the stamp, and its wings are not aliased. A limit by noise alone would bias faint sources,
since aliased light is coherent; condition 2 does not depend on the noise.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from lake_schema.arrays import Bool, Float, Int
from truesky.render.drawing import outskirts, wings
from truesky.render.drawing.settings import Settings
from truesky.render.effects.scene import NOTICEABLE
from truesky.render.psf import spikes as psf_spikes
from truesky.render.psf.model import Psf
from truesky.render.sources import galaxy_shapes, selection
from truesky.render.sources.galaxy_shapes import Shapes
from truesky.render.sources.source_list import Sources

# Sides with fast transforms. The last one limits the memory (its planes have 134 MB).
SIZES = np.array(
    [32, 40, 48, 56, 64, 72, 80, 96, 112, 128, 160, 192, 256, 320, 384, 512, 640, 768, 1024, 1280, 1536, 2048]
)
# Radius of the aperture about the source in which aliased light is counted, arcsec.
_APERTURE = 1.0
# Light of all periodic images in the middle of a source, relative to its light one stamp's side away: the sum of r^-3
# over the square lattice (wings of the PSF), and the sum for the flattest wings of galaxies.
_LATTICE_PSF, _LATTICE_GALAXY = 9.03, 6.0
# Logarithmic slope of aliased light from which its response to shear matters more than its flux; and the ratio of radii
# between which the slope is measured.
_RESPONSE, _SLOPE_RATIO = 3.0, 1.05
# Additional width of a galaxy's stamp, in half-light radii.
_EXTENT = 4.0
# Axis ratio of the thinnest sources: edge-on discs with the scale height of galaxy_shapes.py.
_THINNEST = 0.1
# Double precision is needed for sources with more than BRIGHT electrons, and for sources of which less than the
# fraction ROUNDING of the flux may be neglected.
BRIGHT, ROUNDING = 1e7, 2.5e-8
# Amplitude of the ringing, relative to the largest neglected sample, for a point source in good seeing.
_RINGING = 1.5
# Trails are drawn in pieces of at most this length, pixels, each on a separate stamp.
_PIECE = 64.0
# Fraction of a galaxy's light that may stay aliased at the edges of its stamp: about the error of single precision.
_OUTSIDE = 2e-6
# Fraction of a galaxy's light beyond its stamp that may be drawn too close to it: a tenth of the error 3e-3 of the
# light in circles about the galaxy.
_LOST = 3e-4
# Distances up to which that light is drawn, in half stamps, and the largest one, pixels.
_STEPS, _FARTHEST = (1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0), 2048.0


def stamp_sizes(
    electrons: Float,
    shape: Int,
    shapes: Shapes,
    psf: Psf,
    noise: float,
    settings: Settings,
    extra_pixels: Float | None = None,
) -> Int:
    """Sides of the stamps of sources.

    Parameters
    ----------
    electrons : float array, shape (n,)
        Expected electrons.
    shape : int array, shape (n,)
        Number of the galaxy in `shapes`, -1 for point sources.
    shapes : Shapes
        Shapes of galaxies.
    psf : Psf
        PSF of the detector.
    noise : float
        Noise per pixel, electrons.
    settings : Settings
        Settings for the accuracy.
    extra_pixels : float array, shape (n,), optional
        Pixels by which a stamp must be wider than that of a point source: length of a piece of a trail, or side of a
        picture.

    Returns
    -------
    int array, shape (n,)
        Sides in pixels, from SIZES.
    """
    # Beyond a stamp the PSF's wings are drawn as for a point source, so larger galaxies need wider stamps.
    min_size = np.full(len(shape), float(settings.min_size_arcsec))
    body = shape >= 0
    min_size[body] += _EXTENT * galaxy_shapes.half_light(shapes)[shape[body]]
    # The PSF's spikes are as wide as its core, and a galaxy smears them over its width.
    smeared, core = np.ones(len(shape)), psf.fwhm / psf.pixel_scale
    smeared[body] = core / (core + 2.0 * galaxy_shapes.half_light(shapes)[shape[body]] / psf.pixel_scale)
    aperture = np.pi * (_APERTURE / psf.pixel_scale) ** 2
    allowed_sizes, remaining = np.full(len(shape), SIZES[-1]), np.arange(len(shape))
    for size in SIZES[:-1]:
        psf_light = _extrapolate_profile(psf, psf.surface, np.array([size // 2, size]))
        (rim,) = _extrapolate_profile(psf, psf.rim, np.array([size // 2]))
        psf_edge = psf_light[0] + smeared[remaining] * (rim - psf_light[0])
        light, body = np.zeros((len(remaining), 3)), shape[remaining] >= 0
        if body.any():
            at = np.array([size // 2, size, _SLOPE_RATIO * size]) * psf.pixel_scale
            light[body] = galaxy_shapes.surface_brightness(shapes.take(shape[remaining[body]]), at) * psf.pixel_scale**2
        edge, one_side_away, farther_away = light.T
        steepness = np.log(np.maximum(one_side_away, 1e-300) / np.maximum(farther_away, 1e-300))
        # The effect of shear on aliased light is proportional to its slope.
        steeper = np.maximum(steepness / (_RESPONSE * np.log(_SLOPE_RATIO)), 1.0)
        # A PSF in planes is cut to the stamp and is not aliased.
        wings = _LATTICE_PSF * psf_light[1] * (psf.planes is None)
        wrapped = (wings + _LATTICE_GALAXY * steeper * one_side_away) * aperture
        enough = (electrons[remaining] * (psf_edge + edge) < settings.edge * noise) & (wrapped < settings.aliased)
        enough &= size * psf.pixel_scale >= min_size[remaining]
        # A point has no light beyond the PSF's planes.
        enough |= ~body & (psf.planes is not None) & (size >= psf.side)
        allowed_sizes[remaining[enough]] = size
        remaining = remaining[~enough]
    if extra_pixels is None:
        return np.asarray(allowed_sizes)
    return np.asarray(SIZES[np.minimum(np.searchsorted(SIZES, allowed_sizes + extra_pixels), len(SIZES) - 1)])


def smallest_allowed_sizes(sizes: Int, min_sides: Float) -> Int:
    """Return the smallest allowed sides [n] of at least `sizes` and `min_sides` pixels, or the largest allowed one."""
    return np.asarray(SIZES[np.minimum(np.searchsorted(SIZES, np.maximum(sizes, min_sides)), len(SIZES) - 1)])


def reach(pixel_scale: float) -> float:
    """Largest distance from a source at which its light is drawn, beyond the corners of the largest stamp, arcsec.

    Sources up to this distance from a detector are read.
    """
    return _FARTHEST * pixel_scale


def min_noticeable_electrons(distance: float, pixel_scale: float, noise: float, settings: Settings) -> float:
    """Smallest number of electrons with which a source may be noticeable at a distance.

    Parameters
    ----------
    distance : float
        Distance from the middle of the source, arcsec.
    pixel_scale : float
        Arcsec per pixel.
    noise : float
        Noise per pixel, electrons.
    settings : Settings
        Settings for the accuracy.

    Returns
    -------
    float
        Electrons.

    Notes
    -----
    No profile rises outward: at its edge, an ellipse is no brighter than all its light spread over its area. Noticeable
    light of sources thinner than 1 : 10, the edge-on disc, may be missed.
    """
    pixels = np.pi * _THINNEST * (distance / pixel_scale) ** 2
    return float(settings.edge * noise * pixels)


def _extrapolate_profile(psf: Psf, light: Float, radius: Int) -> Float:
    """Values of `psf.surface` or `psf.rim` at any radius in pixels: wings of r^-3 beyond the table, 0 beyond planes."""
    last = len(light) - 1
    wing = light[np.minimum(radius, last)] * (np.minimum(radius, last) / radius) ** 3
    return np.where((radius < psf.side) | (psf.planes is None), wing, 0.0)


def neglected_flux(electrons: Float, noise: float, settings: Settings) -> Float:
    """Fourier samples that may be neglected for each source, as a fraction of its flux.

    Parameters
    ----------
    electrons : float array, shape (n,)
        Expected electrons.
    noise : float
        Noise per pixel, electrons.
    settings : Settings
        Settings for the accuracy: limits relative to the flux and to the noise.

    Returns
    -------
    float array, shape (n,)
        The fractions.
    """
    return np.minimum(settings.floor, settings.edge * noise / np.maximum(_RINGING * electrons, 1e-30))


def piece_length(length: Float) -> Float:
    """Lengths of the pieces of trails [n], pixels."""
    return np.asarray(length / piece_count(length))


def piece_count(length: Float) -> Int:
    """Numbers of the pieces of trails [n] of given lengths in pixels."""
    return np.maximum(np.ceil(length / _PIECE), 1.0).astype(np.int64)


def touching_frame(sources: Sources, sizes: Int, psf: Psf, noise: float, nx: int, ny: int) -> Bool:
    """Find the sources at rest whose light may be noticeable on the frame, from their stamps or beyond them.

    Parameters
    ----------
    sources : Sources
        n sources.
    sizes : int array, shape (n,)
        Sides of their stamps, pixels.
    psf : Psf
        PSF of the detector.
    noise : float
        Noise per pixel, electrons.
    nx, ny : int
        Columns and rows of the frame.

    Returns
    -------
    bool array, shape (n,)
        True if light may be noticeable.
    """
    column, row, electrons, shape, shapes = (
        sources.column, sources.row, sources.electrons, sources.shape, sources.shapes,
    )  # fmt: skip
    visible_sides_of_sources = visible_sides(electrons, sizes, shape, sources.picture, psf, noise)
    largest = on_largest(shape, sizes)
    farthest = outskirts.reach(
        electrons[largest], shapes.take(shape[largest]), psf.pixel_scale, noise, 0.5 * SIZES[-1] * psf.pixel_scale
    )
    visible_sides_of_sources[largest] = np.ceil(2.0 * farthest / psf.pixel_scale).astype(np.int64)
    on_frame = selection.overlaps_frame(column, row, visible_sides_of_sources, nx, ny)
    # Galaxies outside the frame are included if their light beyond the stamp reaches it.
    max_sides = 2.0 * np.minimum(_STEPS[-1] * sizes / 2, _FARTHEST)
    candidates = np.flatnonzero(~on_frame & (shape >= 0) & ~largest)
    candidates = candidates[
        selection.overlaps_frame(column[candidates], row[candidates], wings.region_side(max_sides[candidates]), nx, ny)
    ]
    light_reach, _ = light_beyond_stamps(shapes.take(shape[candidates]), sizes[candidates], psf.pixel_scale)
    on_frame[candidates] = (light_reach > 0) & selection.overlaps_frame(
        column[candidates], row[candidates], wings.region_side(2.0 * light_reach), nx, ny
    )
    return on_frame


def has_far_light(electrons: Float, sizes: Int, shape: Int, picture: Int | None, psf: Psf) -> Bool:
    """Find the point sources that are bright enough to shine beyond the PSF's plane.

    Parameters
    ----------
    electrons : float array, shape (n,)
        Expected electrons.
    sizes : int array, shape (n,)
        Sides of their stamps, pixels.
    shape : int array, shape (n,)
        Number of the shape, -1 for point sources.
    picture : int array, shape (n,), or None
        Number of the picture, -1 for none; None if no source has a picture.
    psf : Psf
        PSF of the detector.

    Returns
    -------
    bool array, shape (n,)
        True for these point sources.
    """
    point = shape < 0 if picture is None else (shape < 0) & (picture < 0)
    return np.asarray(point & (sizes >= psf.side) & (electrons > BRIGHT) & (psf.edges is not None))


def visible_sides(
    electrons: Float,
    sizes: Int,
    shape: Int,
    picture: Int | None,
    psf: Psf,
    noise: float,
    length: Float | None = None,
) -> Int:
    """Sides of the squares about sources outside which their light is not noticeable.

    Parameters
    ----------
    electrons : float array, shape (n,)
        Expected electrons.
    sizes : int array, shape (n,)
        Sides of their stamps, pixels.
    shape : int array, shape (n,)
        Number of the shape, -1 for point sources.
    picture : int array, shape (n,), or None
        Number of the picture, -1 for none; None if no source has a picture.
    psf : Psf
        PSF of the detector.
    noise : float
        Noise per pixel, electrons.
    length : float array, shape (n,), optional
        Lengths of trails, pixels.

    Returns
    -------
    int array, shape (n,)
        Sides, pixels.

    Notes
    -----
    The squares contain the stamps and the PSF's wings beyond them. For points with far light they contain all sky that
    is read (`reach`), or more if the spikes exceed a tenth of the pixel noise beyond it. `touching_frame` takes into
    account light of galaxies beyond their stamps.
    """
    length = np.zeros(len(sizes)) if length is None else length
    pieces = piece_count(length)
    sides = np.maximum(sizes, 0.0 if psf.planes is None else 2.0 * wings.MARGIN * wings.BLOCK)
    with_far_light = has_far_light(electrons / pieces, sizes, shape, picture, psf)
    if psf.edges is not None and with_far_light.any():
        spikes = psf_spikes.reach(psf.edges, electrons[with_far_light], NOTICEABLE * noise)
        sides[with_far_light] = 2.0 * np.maximum(spikes, reach(1.0))
    return np.ceil(sides + length).astype(np.int64)


def on_largest(shape: Int, sizes: Int) -> Bool:
    """Mask [n] of the galaxies that are larger than the largest stamp."""
    return np.asarray((shape >= 0) & (sizes >= SIZES[-1]))


def light_beyond_stamps(shapes: Shapes, sizes: Int, pixel_scale: float) -> tuple[Float, Float]:
    """Reach and fraction of the light of galaxies beyond their stamps.

    Parameters
    ----------
    shapes : Shapes
        Shapes of n galaxies.
    sizes : int array, shape (n,)
        Sides of their stamps, pixels.
    pixel_scale : float
        Arcsec per pixel.

    Returns
    -------
    (float array, float array)
        Distance up to which the light is drawn, pixels, 0 if there is no light beyond the stamp; and the fraction of
        the light outside the stamp.

    Notes
    -----
    At most the fraction _LOST of the light lies farther out.
    """
    half = sizes / 2
    outside_fraction = galaxy_shapes.flux_outside(shapes, half * pixel_scale)
    light_reach, remaining = np.full(len(half), _STEPS[0]), np.flatnonzero(outside_fraction > _LOST)
    for step, next_step in pairwise(_STEPS):
        remaining = remaining[
            galaxy_shapes.flux_outside(shapes.take(remaining), half[remaining] * step * pixel_scale) > _LOST
        ]
        light_reach[remaining] = next_step
    light_reach = np.maximum(np.minimum(half * light_reach, _FARTHEST), _STEPS[0] * half)
    return np.where(outside_fraction > _OUTSIDE, light_reach, 0.0), outside_fraction
