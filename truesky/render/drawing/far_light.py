"""Light that the pupil's edges diffract far from a bright star, where its PSF's plane has ended.

Star             one of them
add              what a star shines outside the plane, onto a frame
remove_aliased   what of it the plane has inside, taken off
left             how the plane fades there
seconds, remove_aliased_seconds   what `add` and `remove_aliased` take

Rings fall as r^-3, an aureole as r^-2, spikes are tabulated (psf/spikes.py).  The plane of side N fades over 24 pixels
by the smooth step s(z) = z^2 (3 - 2 z) in columns and in rows; `add` draws 1 - s s of the light there and all of it
farther out, so that the sum has no seam.

A star that moves is drawn as points along its trail, closer than the finest fringe lambda / l of a bar.

The plane itself is a discrete transform of the pupil and repeats itself after a period Q: a pixel at r of the middle
holds what belongs at r + Q m, too (m whole numbers), weakened by the softened edges of the sampled pupil to
sinc^2(|r + Q m| / Q) against sinc^2(|r| / Q) of its own.  `remove_aliased` keeps of each pixel own / (own + folded).

Ref : Born & Wolf, Principles of Optics, sections 8.5.1 (a straight bar) and 8.5.2 (a circle, far out)
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from lake_schema.arrays import Array, Float, Int
from truesky.render.drawing.kernels import far_light
from truesky.render.drawing.kernels.far_light import FOLDED, SPARED
from truesky.render.drawing.kernels.frame import FIXED_POINT
from truesky.render.psf import spikes
from truesky.render.psf.spikes import ARCSEC, FARTHEST, LONG, STEP, Edges

# Light is drawn to where it is this part of what may be left out: its border is not to be seen.
_FAINTEST = 0.5
# Of the finest fringe, between points along a trail: where a spike's table ends, a point more or less is a step.
_ALONG = 0.6
# Pixels between points along a piece of a trail where a plane is unfolded, of which a share is asked for.
_POINT_SPACING = 4.0
# CPU s, measured (2.5 GHz, one core), of a frame's pixel: about a star, and for each pixel of a trail's length; and of
# a stamp's pixel and part of a piece.
_STAR_S, _LONGER_S, _UNFOLD_S = 7e-9, 1.6e-9, 5e-8


@dataclass(frozen=True, slots=True)
class Star:
    """A point that shines beyond its PSF's plane.

    column, row : pixels, of its middle where it moves;  electrons : expected
    photons : [w] share of each sub-band, None = equal
    size    : of the plane, pixels
    least   : electrons in a pixel that may be left out
    edges   : what diffracts; None: nothing does
    trail   : [2] pixels that it moves by, with its plane; None: it is at rest
    """

    column: float
    row: float
    electrons: float
    photons: Float | None
    size: int
    negligible_electrons: float
    edges: Edges | None
    trail: Float | None = None


def add(frame: Int, star: Star, unit: float = FIXED_POINT) -> None:
    """Adds what a star shines outside its plane, which fades by `left`, to a frame that has `unit` of an electron."""
    if star.edges is None:
        return
    edges = star.edges
    photons, bar_directions = _photons_and_directions(star.photons, edges)
    x, y = _trail_points(star, _ALONG * _finest_fringe(edges))
    farthest = _farthest_corner(frame, x, y)
    if len(x) > 1:
        farthest = min(farthest, FARTHEST / edges.pixel_scale)
    level = star.electrons * spikes.ring_light(edges, photons)
    lines = star.electrons * spikes.spike_light(edges, photons, max(farthest, edges.period))
    faintest = _FAINTEST * star.negligible_electrons
    halo, core = star.electrons * edges.aureole[0], edges.aureole[1]
    # Where each of the two is as faint.
    radius = max((level / faintest) ** (1.0 / 3.0), (halo / faintest) ** 0.5) if faintest > 0.0 else farthest
    radius = min(radius, farthest)
    inner = star.size / 2 - SPARED
    # What a spike shows outside the plane: so far out, so wide.
    visible = lines[:, int(inner / LONG) :] > faintest
    out, across = (np.flatnonzero(visible.any(axis=axes)) for axes in ((0, 2), (0, 1)))
    spike_reach = min(inner + LONG * float(out[-1] + 1) if len(out) else 0.0, farthest)
    spike_half_width = STEP * float(across[-1] + 1) if len(across) else 0.0
    level, halo, lines = level * unit / len(x), halo * unit / len(x), lines * unit / len(x)
    for column, row in zip(x.tolist(), y.tolist(), strict=True):
        far_light.add_outside(
            frame, column, row, inner, level, halo, core, radius, bar_directions, lines, spike_reach, spike_half_width
        )
        far_light.add_inside(frame, column, row, inner, level, halo, core, bar_directions, lines)


def _farthest_corner(frame: Int, x: Float, y: Float) -> float:
    """Pixels from points to beyond the farthest corner's pixel."""
    ny, nx = frame.shape
    return float(np.hypot(max(x.max() + 1.0, nx - x.min()), max(y.max() + 1.0, ny - y.min())))


def remove_aliased(star: Star, stamp: Array, x0: int, y0: int, nx: int, ny: int) -> None:
    """Takes off a star's stamp, in place, what its plane's transform had folded into it: a fifth of its corners.

    left, low : the stamp's first pixel on a frame of nx, ny, outside which nothing is done
    Of each pixel it is the share that folded light has in all that should be there: the two run through each other, and
    where they cancel there is less than of either.
    """
    if star.edges is None or star.edges.period == 0.0:
        return
    edges = star.edges
    photons, bar_directions = _photons_and_directions(star.photons, edges)
    level, inner = star.electrons * spikes.ring_light(edges, photons), star.size / 2 - SPARED
    if FOLDED * level / inner**3 > _FAINTEST * star.negligible_electrons:
        on_frame = stamp[max(-y0, 0) : max(ny - y0, 0), max(-x0, 0) : max(nx - x0, 0)]
        x, y = _trail_points(star, _POINT_SPACING)
        x, y = x - max(x0, 0), y - max(y0, 0)
        lines = star.electrons * spikes.spike_light(edges, photons, edges.period) / len(x)
        far_light.remove_aliased_compiled(on_frame, x, y, inner, level / len(x), bar_directions, lines, edges.period)


def seconds(length: Float, nx: int, ny: int) -> float:
    """CPU s that `add` takes for trails of lengths, pixels, of which 0 are at rest.

    Error : half and twice; less where little of them is noticed
    """
    return float((_STAR_S + _LONGER_S * length).sum()) * nx * ny


def remove_aliased_seconds(length: Float, sizes: Int) -> float:
    """CPU s that `remove_aliased` takes for pieces of trails on stamps of sides, pixels."""
    return float((_UNFOLD_S * sizes.astype(float) ** 2 * np.maximum(np.ceil(length / _POINT_SPACING), 1.0)).sum())


def _photons_and_directions(photons: Float | None, edges: Edges) -> tuple[Float, Float]:
    """(photons [w], bars' directions [b, 2])."""
    photons = np.full(len(edges.wavelength), 1.0 / len(edges.wavelength)) if photons is None else photons
    return photons, np.stack([np.cos(edges.bars[:, 0]), np.sin(edges.bars[:, 0])], axis=1)


def _trail_points(star: Star, spacing: float) -> tuple[Float, Float]:
    """Columns and rows [p] of points along a trail, at most so many pixels apart; one, if it is no longer than that."""
    length = 0.0 if star.trail is None else float(np.hypot(*star.trail))
    if star.trail is None or length <= spacing:
        return np.array([star.column]), np.array([star.row])
    count = math.ceil(length / spacing)
    along = (np.arange(count) + 0.5) / count - 0.5
    return star.column + along * star.trail[0], star.row + along * star.trail[1]


def _finest_fringe(edges: Edges) -> float:
    """Pixels between points that shine as an even line does: across a spike no frequency is higher."""
    return float(edges.wavelength.min() * 1e-7 / edges.bars[:, 2].max() / (edges.pixel_scale * ARCSEC))


def fading_window(size: int, samples: int, count: int) -> Float:
    """float64[count] what a star's plane is multiplied with along each axis, to fade into `add`'s light.

    size : of the plane, pixels;  samples : a pixel;  count : of samples, its middle in the middle
    """
    distance = np.abs(np.arange(count) - count // 2) / samples
    return np.array([far_light.fading_compiled(float(d), size / 2 - SPARED) for d in distance])
