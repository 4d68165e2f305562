"""How large a source's stamp is, and how far beyond it the source may shine.

stamp_sizes     pixels, from flux, shape, PSF, noise and settings
reach, least_electrons   how far a source may show, and what it takes to show there
touching_frame  sources that `draw` puts light of onto a frame
has_far_light   points that do so beyond their stamps;  reaches : and how far

A stamp of side N is periodic: a pixel at x from the source's middle has F sum_m f(x + N m) electrons, where F is the
flux, f(r) its fraction in a pixel at r, and m runs over pairs of whole numbers. A side is large enough if

1. the light at the edge, F f(N / 2), is less than `edge` of a pixel's noise: a cut that is seen is a square around the
   source. Of a PSF with spikes f(N / 2) is the largest along columns and rows; over a galaxy it is smeared.
2. what is aliased is less than `aliased` of the flux in an aperture of area a about the source. There x is small, and
   for f = c r^-k the sum over m other than 0 is c N^-k Z(k), with the lattice sum Z(k) = sum |m|^-k: 9.03 for the PSF's
   k = 3, and no more than 6 for the flattest wings of galaxies. So a Z f(N) < aliased.
   What biases shear is the part of it that changes with shear, d ln f / d gamma = k; from k = 3 on this counts for more
   than the flux, and Z is multiplied by k / 3, k being taken between N and 1.05 N.
3. it has the least side that an accuracy asks for, for the PSF's wings are drawn as a point's beyond the stamp
   (wings.py): 4 half-light radii more for a galaxy.

A PSF in planes is cut to the stamp; its wings are not aliased. A cut by noise alone would bias faint sources, since
what is aliased is coherent: condition 2 does not know the noise.
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

# Sides whose transforms are fast; the last bounds memory (its planes have 134 MB).
SIZES = np.array(
    [32, 40, 48, 56, 64, 72, 80, 96, 112, 128, 160, 192, 256, 320, 384, 512, 640, 768, 1024, 1280, 1536, 2048]
)
# Light that wraps is counted in this aperture about the source: radius, arcsec.
_APERTURE = 1.0
# A source's light a stamp's side away, times this, is what all its periodic images bring to its middle: the sum of
# r^-3 over the square lattice (the PSF's wings), and of the flattest wings of galaxies.
_LATTICE_PSF, _LATTICE_GALAXY = 9.03, 6.0
# Logarithmic slope of the light that wraps from which on its response to shear is what counts, not its flux; and the
# ratio of radii between which the slope is taken.
_RESPONSE, _SLOPE_RATIO = 3.0, 1.05
# Of a galaxy's half-light radius, that its stamp is wider than a point's.
_EXTENT = 4.0
# Axis ratio of the thinnest sources: discs of the scale height galaxy_shapes.py draws, seen edge-on.
_THINNEST = 0.1
# Above this many electrons the rounding of single precision would show; and where no pixel may miss more than this of a
# source's flux.
BRIGHT, ROUNDING = 1e7, 2.5e-8
# Of a point behind good seeing, how much higher than the largest sample that is left out the rest may ring.
_RINGING = 1.5
# A trail is drawn in pieces no longer than this, pixels, each on a stamp of its own.
_PIECE = 64.0
# Of a galaxy's light, what may stay where it comes in at the stamp's edges: about what single precision sums to.
_OUTSIDE = 2e-6
# Of a galaxy's light, what may lie nearer than it should, beyond the stamp: a tenth of the 3e-3 that circles about it
# are known to.
_LOST = 3e-4
# Half stamps, and pixels, as far as which it is drawn.
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
    """Side of each source's stamp, pixels: int64[n], one of SIZES.

    wider : float64[n] pixels that a stamp is wider than a point's: the length of a piece of a trail, a picture's side
    noise : of a pixel, electrons. A cut by noise alone biases faint sources, for what wraps is coherent: the second
            condition holds it to a part of the flux, from the wings of the PSF and of high-n bulges alike
    electrons : float64[n] expected;  shape : int64[n] number in `shapes` of galaxies, -1 of points
    psf       : of the detector;  settings : of the accuracy
    """
    # The PSF's wings beyond a stamp are those of a point: the larger a galaxy, the farther out that may begin.
    min_size = np.full(len(shape), float(settings.min_size_arcsec))
    body = shape >= 0
    min_size[body] += _EXTENT * galaxy_shapes.half_light(shapes)[shape[body]]
    # Of a galaxy the PSF's spikes, as wide as its core, are smeared over its width.
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
        # What shear makes of the light that wraps goes with how steeply it falls.
        steeper = np.maximum(steepness / (_RESPONSE * np.log(_SLOPE_RATIO)), 1.0)
        # A PSF in planes is cut to the stamp and does not wrap.
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
    """Sides [n], one of SIZES, that are no smaller; wanted : [n] pixels that they hold besides, as far as any does."""
    return np.asarray(SIZES[np.minimum(np.searchsorted(SIZES, np.maximum(sizes, min_sides)), len(SIZES) - 1)])


def reach(pixel_scale: float) -> float:
    """How far from a source it may shine, arcsec: beyond the corners of the largest stamp. So far sources are read."""
    return _FARTHEST * pixel_scale


def min_noticeable_electrons(distance: float, pixel_scale: float, noise: float, settings: Settings) -> float:
    """Electrons of which a source must have more to show at a distance, arcsec, from its middle.

    No profile rises outward: at its edge an ellipse is no brighter than all of the light spread over it.
    pixel_scale : arcsec;  noise : of a pixel, electrons;  settings : of the accuracy
    Error : of a source thinner than 1 : 10, the edge-on disc, what shows may be left out
    """
    pixels = np.pi * _THINNEST * (distance / pixel_scale) ** 2
    return float(settings.edge * noise * pixels)


def _extrapolate_profile(psf: Psf, light: Float, radius: Int) -> Float:
    """psf.surface or psf.rim at any radius, pixels: wings of r^-3 beyond the table, nothing beyond planes."""
    last = len(light) - 1
    wing = light[np.minimum(radius, last)] * (np.minimum(radius, last) / radius) ** 3
    return np.where((radius < psf.side) | (psf.planes is None), wing, 0.0)


def neglected_flux(electrons: Float, noise: float, settings: Settings) -> Float:
    """Per source, the Fourier samples that `draw` may leave out: of its flux, and in the noise."""
    return np.minimum(settings.floor, settings.edge * noise / np.maximum(_RINGING * electrons, 1e-30))


def piece_length(length: Float) -> Float:
    """Of the pieces that trails [n] of a length are drawn in, pixels."""
    return np.asarray(length / piece_count(length))


def piece_count(length: Float) -> Int:
    """How many they are [n]."""
    return np.maximum(np.ceil(length / _PIECE), 1.0).astype(np.int64)


def touching_frame(sources: Sources, sizes: Int, psf: Psf, noise: float, nx: int, ny: int) -> Bool:
    """[n] True of sources at rest of which light may be noticed on the frame: their stamps', or what is drawn beyond.

    noise : of a pixel, electrons
    sources, sizes : n sources and their stamps' sides;  psf : of the detector;  nx, ny : its pixels
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
    # What else of a galaxy may be seen there is looked at closer.
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
    """[n] True of points so bright that their light does not end where the PSF's plane does: `draw` takes it on.

    electrons, sizes : float64[n] expected, int64[n] stamps' sides;  psf : of the detector
    shape, picture   : int64[n] as of Sources, -1 of points; picture None: there are none
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
    """Sides of the squares about sources outside which none of their light is noticed, pixels: int64[n].

    Of stamps, and of the PSF's wings beyond them; about points that shine beyond these all that is read of the sky
    around (`reach`), and for their spikes more: to where no pixel has a tenth of its noise. Of a galaxy's own light
    beyond its stamp `touching_frame` knows.
    length : float64[n] of trails, pixels;  noise : of a pixel, electrons
    electrons, sizes, shape, picture, psf : as of `has_far_light`
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
    """[n] True of galaxies that no stamp holds."""
    return np.asarray((shape >= 0) & (sizes >= SIZES[-1]))


def light_beyond_stamps(shapes: Shapes, sizes: Int, pixel_scale: float) -> tuple[Float, Float]:
    """Of galaxies [n], (how far their light is drawn, pixels, 0 where none is beyond its stamp; the part of it there).

    Until no more than _LOST of the light lies farther out.
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
