"""Sizes of the stamps (square images around sources), and the distance up to which sources shine beyond their stamps.

A stamp of side N pixels is periodic, since it is drawn by a Fourier transform. A pixel at x (column and row in pixels)
from the source's middle has F sum_m f(x + N m) electrons. Here F is the flux in electrons, f(r) its fraction in a pixel
at r pixels from the middle, and m runs over pairs of integers; terms with m other than 0 are aliased light. A side is
large enough if it meets three conditions (`edge` and `aliased` are attributes of `settings.Settings`):

1. The light at the edge, F f(N / 2), is less than `edge` times the pixel noise, since a visible cut appears as a square
   around the source. For a PSF with diffraction spikes, f(N / 2) is the largest value along columns and rows. A galaxy
   smears the spikes, which reduces this value.
2. The aliased light in an aperture of area a about the source is less than `aliased` times the flux. In the aperture x
   is small. For f = c r^-k the sum over all m except 0 is c N^-k Z(k), with the lattice sum Z(k) = sum |m|^-k. Z is
   9.03 for the wings of the PSF with k = 3, and at most 6 for the flattest wings of galaxies. The condition is
   therefore a Z f(N) < aliased. The measured shear is biased by the part of the aliased light that changes with the
   shear gamma: to first order d ln f / d gamma = k. For k > 3 this bias matters more than that of the flux, and Z is
   multiplied by k / 3, with k measured between N and 1.05 N.
3. N is at least the smallest side in `Settings`, plus 4 half-light radii for a galaxy, since the PSF's wings beyond the
   stamp are drawn as for a point source (wings.py).

A PSF that is given as images (planes) is cut to the stamp, so its wings are not aliased. A limit by noise alone would
bias faint sources, since aliased light is the same in every exposure. Condition 2 does not depend on the noise.
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

# Allowed sides of stamps, pixels, with fast Fourier transforms. The last one limits the memory: the PSF for a stamp of
# 2048 pixels needs 134 MB.
SIZES = np.array(
    [32, 40, 48, 56, 64, 72, 80, 96, 112, 128, 160, 192, 256, 320, 384, 512, 640, 768, 1024, 1280, 1536, 2048]
)
# Radius of the aperture about the source in which aliased light is counted, arcsec.
_APERTURE = 1.0
# Aliased light of the PSF's wings in the middle of a stamp (light of the periodic copies of the source), relative to
# the light of the PSF in a pixel at a distance of one stamp's side from the source. It is the sum of r^-3 over a square
# lattice of spacing 1 without the origin.
_LATTICE_PSF = 9.03
# Aliased light of a galaxy in the middle of its stamp (light of its periodic copies), relative to its light in a pixel
# at a distance of one stamp's side. The value is for galaxies with the flattest wings, and an upper limit for others.
_LATTICE_GALAXY = 6.0
# Slope k of a source's light, proportional to r^-k. For larger k, aliased light biases the measured shear by more than
# the measured flux.
_RESPONSE = 3.0
# Ratio of the two radii between which the logarithmic slope of a galaxy's light is measured.
_SLOPE_RATIO = 1.05
# Number of half-light radii of a galaxy that are added to the smallest side of a stamp.
_EXTENT = 4.0
# Axis ratio of the thinnest galaxies for which it is computed at what distance they are noticeable: edge-on discs.
_THINNEST = 0.1
# Sources with more expected electrons than this are drawn in double precision.
BRIGHT = 1e7
# Fourier samples of a source below a limit, a fraction of its flux, may be neglected. Sources with a limit below this
# value are also drawn in double precision, since the rounding errors of single precision would exceed the limit.
ROUNDING = 2.5e-8
# Amplitude (electrons per pixel) of the ringing in an image that is caused by neglecting Fourier samples, relative to
# the largest neglected sample (electrons), for a point source in good seeing.
_RINGING = 1.5
# Trails of moving sources are drawn in pieces of at most this length, pixels, each on a separate stamp.
_PIECE = 64.0
# Fraction of a galaxy's light that may stay aliased at the edges of its stamp: about the error of single precision.
_OUTSIDE = 2e-6
# Fraction of a galaxy's light that may lie beyond the distance up to which its light outside the stamp is drawn. This
# fraction is drawn too close to the galaxy instead. The drawn light inside a circle about a galaxy has an error of 3e-3
# for other reasons; the value is a tenth of this error.
_LOST = 3e-4
# Possible distances from a galaxy up to which its light outside its stamp is drawn, in half sides of the stamp. The
# smallest distance is used beyond which less than _LOST of the light lies.
_STEPS = (1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0)
# Largest distance up to which a galaxy's light outside its stamp is drawn, pixels.
_FARTHEST = 2048.0


def stamp_sizes(
    electrons: Float,
    shape: Int,
    shapes: Shapes,
    psf: Psf,
    noise: float,
    settings: Settings,
    extra_pixels: Float | None = None,
) -> Int:
    """Return the sides of the stamps on which n sources are drawn.

    Parameters
    ----------
    electrons : float array, shape (n,)
        Expected electrons.
    shape : int array, shape (n,)
        Index of the galaxy in `shapes`, -1 for point sources.
    shapes : Shapes
        Bulge and disc parameters of galaxies.
    psf : Psf
        PSF of the detector.
    noise : float
        Noise of a pixel without sources, electrons rms.
    settings : Settings
        Limits for the light that is neglected: at the edge of a stamp, and by aliasing; and smallest side of a stamp.
    extra_pixels : float array, shape (n,), optional
        Pixels by which each stamp must be wider than computed: displacement of a moving source on its stamp, or side of
        the image of a source that is not a profile. 0 for other sources.

    Returns
    -------
    int array, shape (n,)
        Smallest side of SIZES that meets the conditions, pixels; the largest of SIZES if none does.
    """
    # Beyond a stamp the PSF's wings are drawn as for a point source, so the stamp of a larger galaxy must be wider.
    min_size = np.full(len(shape), float(settings.min_size_arcsec))
    body = shape >= 0
    min_size[body] += _EXTENT * galaxy_shapes.half_light(shapes)[shape[body]]
    # Diffraction spikes are as wide as the core of the PSF. The image of a galaxy is the convolution with its profile,
    # which spreads each spike over the width of the galaxy.
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
        # Aliased light changes with shear in proportion to the slope d ln(light) / d ln(radius) of the galaxy. For
        # slopes steeper than _RESPONSE, the limit for aliased light is therefore stricter.
        steeper = np.maximum(steepness / (_RESPONSE * np.log(_SLOPE_RATIO)), 1.0)
        # A PSF given as images (planes) is cut to the stamp, so its wings are not aliased.
        wings = _LATTICE_PSF * psf_light[1] * (psf.planes is None)
        wrapped = (wings + _LATTICE_GALAXY * steeper * one_side_away) * aperture
        enough = (electrons[remaining] * (psf_edge + edge) < settings.edge * noise) & (wrapped < settings.aliased)
        enough &= size * psf.pixel_scale >= min_size[remaining]
        # A point source has no light on its stamp beyond the border of the PSF images, so it needs no larger stamp.
        enough |= ~body & (psf.planes is not None) & (size >= psf.side)
        allowed_sizes[remaining[enough]] = size
        remaining = remaining[~enough]
    if extra_pixels is None:
        return np.asarray(allowed_sizes)
    return np.asarray(SIZES[np.minimum(np.searchsorted(SIZES, allowed_sizes + extra_pixels), len(SIZES) - 1)])


def smallest_allowed_sizes(sizes: Int, min_sides: Float) -> Int:
    """Return the smallest side of SIZES that is at least `sizes` and `min_sides` pixels, for each of n stamps.

    The result is the largest of SIZES if all are too small.
    """
    return np.asarray(SIZES[np.minimum(np.searchsorted(SIZES, np.maximum(sizes, min_sides)), len(SIZES) - 1)])


def reach(pixel_scale: float) -> float:
    """Return the distance from a detector, arcsec, up to which sources must be read from the catalogue.

    It is 2048 pixels, the largest distance at which light outside the stamp of a galaxy is drawn. Only stars that are
    drawn beyond their PSF images, and galaxies that exceed the largest stamp, may shine on a detector from farther
    away. The unit of `pixel_scale` is arcsec per pixel.
    """
    return _FARTHEST * pixel_scale


def min_noticeable_electrons(distance: float, pixel_scale: float, noise: float, settings: Settings) -> float:
    """Return a lower limit of the electrons of a source that is noticeable at a given distance from its middle.

    Parameters
    ----------
    distance : float
        Distance from the middle of the source, arcsec.
    pixel_scale : float
        Arcsec per pixel.
    noise : float
        Noise of a pixel, electrons rms.
    settings : Settings
        Limits for neglected light: light is noticeable above `settings.edge` times the noise.

    Returns
    -------
    float
        Total electrons of the source. Fainter sources are not noticeable at this distance.

    Notes
    -----
    No profile rises outward. On the edge of an ellipse, it is at most as bright as if all its light were spread evenly
    over the area of the ellipse. The axis ratio is taken as 0.1, so light of thinner sources may be missed.
    """
    pixels = np.pi * _THINNEST * (distance / pixel_scale) ** 2
    return float(settings.edge * noise * pixels)


def _extrapolate_profile(psf: Psf, light: Float, radius: Int) -> Float:
    """Return `light`, which is `psf.surface` or `psf.rim`, at radii in pixels that may be beyond the end of this table.

    Beyond the table, the light falls off as r^-3. For a PSF that is given as images (planes), it is 0 from the radius
    `psf.side` on, which is twice the length of the table.
    """
    last = len(light) - 1
    wing = light[np.minimum(radius, last)] * (np.minimum(radius, last) / radius) ** 3
    return np.where((radius < psf.side) | (psf.planes is None), wing, 0.0)


def neglected_flux(electrons: Float, noise: float, settings: Settings) -> Float:
    """Return the size up to which samples of each source's Fourier transform may be neglected.

    Parameters
    ----------
    electrons : float array, shape (n,)
        Expected electrons. Values of 0 are allowed.
    noise : float
        Noise of a pixel, electrons rms.
    settings : Settings
        Limits for neglected light: `floor` relative to the flux, and `edge` relative to the noise.

    Returns
    -------
    float array, shape (n,)
        Size of the samples as a fraction of the flux, the smaller of both limits.
    """
    return np.minimum(settings.floor, settings.edge * noise / np.maximum(_RINGING * electrons, 1e-30))


def piece_length(length: Float) -> Float:
    """Return the length of the pieces into which each trail of a moving source is divided, pixels.

    `length` [n] are the lengths of the trails in pixels. The pieces of a trail have equal lengths of at most 64 pixels.
    """
    return np.asarray(length / piece_count(length))


def piece_count(length: Float) -> Int:
    """Return the number of pieces, at least 1, into which each trail is divided; `length` [n] are lengths in pixels."""
    return np.maximum(np.ceil(length / _PIECE), 1.0).astype(np.int64)


def touching_frame(sources: Sources, sizes: Int, psf: Psf, noise: float, nx: int, ny: int) -> Bool:
    """Find the sources at rest whose light may be noticeable on the image of a detector (frame).

    Both the light on a source's stamp and the light that is drawn beyond the stamp count.

    Parameters
    ----------
    sources : Sources
        n sources.
    sizes : int array, shape (n,)
        Sides of their stamps, pixels.
    psf : Psf
        PSF of the detector.
    noise : float
        Noise of a pixel, electrons rms.
    nx, ny : int
        Number of columns and of rows of the frame.

    Returns
    -------
    bool array, shape (n,)
        True if light of the source may be noticeable on the frame.
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
    # A galaxy whose stamp does not touch the frame is included if the light beyond its stamp reaches the frame.
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
    """Find the stars that are so bright that their light is drawn also beyond the border of the PSF images.

    Parameters
    ----------
    electrons : float array, shape (n,)
        Expected electrons.
    sizes : int array, shape (n,)
        Sides of their stamps, pixels.
    shape : int array, shape (n,)
        Index of the galaxy's bulge and disc parameters, -1 for a source without them.
    picture : int array, shape (n,), or None
        Index of the image that is drawn for the source, -1 for none; None if no source has such an image.
    psf : Psf
        PSF of the detector.

    Returns
    -------
    bool array, shape (n,)
        True for point sources with more than BRIGHT electrons whose stamp is at least as large as the PSF images. False
        for all sources if `psf.edges` is None.
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
    """Return the sides of squares about n sources, outside which the light of the source is not noticeable.

    Parameters
    ----------
    electrons : float array, shape (n,)
        Expected electrons.
    sizes : int array, shape (n,)
        Sides of their stamps, pixels.
    shape : int array, shape (n,)
        Index of the galaxy's bulge and disc parameters, -1 for a source without them.
    picture : int array, shape (n,), or None
        Index of the image that is drawn for the source, -1 for none; None if no source has such an image.
    psf : Psf
        PSF of the detector.
    noise : float
        Noise of a pixel, electrons rms.
    length : float array, shape (n,), optional
        Displacements of the sources during the exposure, pixels. By default all sources are at rest.

    Returns
    -------
    int array, shape (n,)
        Sides, pixels.

    Notes
    -----
    A square contains the stamp and the PSF's wings beyond it. For a star that is drawn beyond the PSF images
    (`has_far_light`), the half side is at least 2048 pixels. It is larger if diffraction spikes or the aureole exceed a
    tenth of the pixel noise farther out. Light of galaxies beyond their stamps is not included; `touching_frame` adds
    it.
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
    """Return the mask [n] of the galaxies that have the largest possible stamp and may exceed it; False for stars."""
    return np.asarray((shape >= 0) & (sizes >= SIZES[-1]))


def light_beyond_stamps(shapes: Shapes, sizes: Int, pixel_scale: float) -> tuple[Float, Float]:
    """Return how far and how much n galaxies shine beyond their stamps.

    Parameters
    ----------
    shapes : Shapes
        Bulge and disc parameters of n galaxies.
    sizes : int array, shape (n,)
        Sides of the galaxies' stamps, pixels.
    pixel_scale : float
        Arcsec per pixel.

    Returns
    -------
    (float array, float array)
        Distance from the galaxy up to which its light is drawn, pixels, 0 if less than the fraction 2e-6 lies outside
        the stamp; and an upper limit of the fraction of the light outside the stamp. Both have the shape (n,).

    Notes
    -----
    At most the fraction 3e-4 of the light lies beyond the distance, unless the distance is limited to 16 half stamps or
    2048 pixels.
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
