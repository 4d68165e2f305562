"""Light that the pupil's edges diffract far from a bright star, where its PSF's plane has ended.

Star      one of them
add       what a star shines outside the plane, onto a frame
unfold    what of it the plane has inside, taken off
left      how the plane fades there
seconds, unfold_seconds   what `add` and `unfold` take

Rings fall as r^-3, spikes are tabulated (psf/spikes.py).  The plane of side N fades over 24 pixels by the smooth step
s(z) = z^2 (3 - 2 z) in columns and in rows; `add` draws 1 - s s of the light there and all of it farther out, so that
the sum has no seam.

A star that moves by L pixels shines 1 / L of its light from each pixel of its trail.  With d the distance of a pixel
from the trail's line and a .. b the stretch of the trail, measured from the pixel's foot on that line,

    integral of ds / (s^2 + d^2)^(3/2) = [s / (d^2 h)],  h = sqrt(s^2 + d^2),

of which s / (d^2 h) = 1 / d^2 - 1 / (h (h + s)) for s > 0: the second form has no difference of large numbers on the
line itself.  A spike is a product of a slow function along and a table across it: each part of the trail that moves
8 pixels along the spike brings the table's integral over what it moves across.

The plane itself is a discrete transform of the pupil and repeats itself after a period Q: a pixel at r of the middle
holds what belongs at r + Q m, too (m whole numbers), weakened by the softened edges of the sampled pupil to
sinc^2(|r + Q m| / Q) against sinc^2(|r| / Q) of its own.  `unfold` keeps of each pixel own / (own + folded).

Ref : Born & Wolf, Principles of Optics, sections 8.5.1 (a straight bar) and 8.5.2 (a circle, far out)
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from jobs.render.drawing.kernels import far_light
from jobs.render.drawing.kernels.far_light import FOLDED, SPARED
from jobs.render.drawing.kernels.frame import FIXED_POINT
from jobs.render.psf import spikes
from jobs.render.psf.spikes import ARCSEC, FARTHEST, LONG, STEP, Edges
from lake_schema.arrays import Array, Float, Int

# Light is drawn to where it is this part of what may be left out: its border is not to be seen.
_FAINTEST = 0.5
# Of a trail's piece, the pixels that count as a point where a plane is unfolded; its spikes as a line.
_PART = 16.0
# CPU s, measured (2.5 GHz, one core), of a frame's pixel: about a star, a trail, and for each pixel of its length; and
# of a stamp's pixel and part of a piece.
_STAR_S, _TRAIL_S, _LONGER_S, _UNFOLD_S = 7e-9, 8e-8, 4e-10, 1.2e-7


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
    least: float
    edges: Edges | None
    trail: Float | None = None


def add(frame: Int, star: Star, unit: float = FIXED_POINT) -> None:
    """Adds what a star shines outside its plane, which fades by `left`, to a frame that has `unit` of an electron."""
    if star.edges is None:
        return
    column, row, edges = star.column, star.row, star.edges
    photons, turned, length, along = _seen(star.photons, edges, star.trail)
    farthest = _farthest_corner(frame, column, row, length, along)
    if length > 0.0:
        farthest = min(farthest, FARTHEST / edges.pixel_scale)
    level = star.electrons * spikes.ring(edges, photons)
    lines = star.electrons * spikes.spikes(edges, photons, max(farthest, edges.period))
    faintest = _FAINTEST * star.least
    radius = min((level / faintest) ** (1.0 / 3.0), farthest) if faintest > 0.0 else farthest
    inner = star.size / 2 - SPARED
    # What a spike shows outside the plane: so far out, so wide.
    shown = lines[:, int(inner / LONG) :] > faintest
    out, across = (np.flatnonzero(shown.any(axis=axes)) for axes in ((0, 2), (0, 1)))
    far = min(inner + LONG * float(out[-1] + 1) if len(out) else 0.0, farthest)
    wide = STEP * float(across[-1] + 1) if len(across) else 0.0
    level, lines = level * unit, lines * unit
    if length > 0.0:
        lines /= length
        fine = length / math.ceil(length / _finest(edges))
        far_light.streak(
            frame, column, row, *along, length, inner, level / length, radius, turned, lines, _sums(lines), far, wide,
            fine,
        )  # fmt: skip
        return
    far_light.outside(frame, column, row, inner, level, radius, turned, lines, far, wide)
    far_light.inside(frame, column, row, inner, level, turned, lines)


def _farthest_corner(frame: Int, column: float, row: float, length: float, along: tuple[float, float]) -> float:
    """Pixels from a trail to beyond the farthest corner's pixel."""
    ny, nx = frame.shape
    ends = np.array([-0.5, 0.5]) * length
    columns, rows = column + ends * along[0], row + ends * along[1]
    return float(np.hypot(max(columns.max() + 1.0, nx - columns.min()), max(rows.max() + 1.0, ny - rows.min())))


def unfold(star: Star, stamp: Array, left: int, low: int, nx: int, ny: int) -> None:
    """Takes off a star's stamp, in place, what its plane's transform had folded into it: a fifth of its corners.

    left, low : the stamp's first pixel on a frame of nx, ny, outside which nothing is done
    Of each pixel it is the share that folded light has in all that should be there: the two run through each other, and
    where they cancel there is less than of either.
    """
    if star.edges is None:
        return
    column, row, edges = star.column, star.row, star.edges
    photons, turned, length, along = _seen(star.photons, edges, star.trail)
    level, inner = star.electrons * spikes.ring(edges, photons), star.size / 2 - SPARED
    if FOLDED * level / inner**3 > _FAINTEST * star.least:
        lines = star.electrons * spikes.spikes(edges, photons, edges.period) / (length or 1.0)
        seen = stamp[max(-low, 0) : max(ny - low, 0), max(-left, 0) : max(nx - left, 0)]
        parts = max(math.ceil(length / _PART), 1)
        places = length * ((np.arange(parts) + 0.5) / parts - 0.5)
        x, y = column - max(left, 0) + places * along[0], row - max(low, 0) + places * along[1]
        far_light.unfold_compiled(
            seen, x, y, *along, length / parts, inner, level / parts, turned, lines, _sums(lines), edges.period
        )


def seconds(length: Float, nx: int, ny: int) -> float:
    """CPU s that `add` takes for trails of lengths, pixels, of which 0 are at rest.

    Error : half and twice; less where little of them is noticed
    """
    longer = np.minimum(length, nx + ny)
    return float(np.where(length > 0.0, _TRAIL_S + _LONGER_S * longer, _STAR_S).sum()) * nx * ny


def unfold_seconds(length: Float, sizes: Int) -> float:
    """CPU s that `unfold` takes for pieces of trails on stamps of sides, pixels."""
    return float((_UNFOLD_S * sizes.astype(float) ** 2 * np.maximum(np.ceil(length / _PART), 1.0)).sum())


def _seen(photons: Float | None, edges: Edges, trail: Float | None) -> tuple[Float, Float, float, tuple[float, float]]:
    """(photons [w], bars' directions [b, 2], a trail's length, pixels, 0 if it is as good as a point; direction)."""
    photons = np.full(len(edges.wavelength), 1.0 / len(edges.wavelength)) if photons is None else photons
    turned = np.stack([np.cos(edges.bars[:, 0]), np.sin(edges.bars[:, 0])], axis=1)
    length = 0.0 if trail is None else float(np.hypot(*trail))
    if trail is None or length <= _finest(edges):
        return photons, turned, 0.0, (0.0, 0.0)
    return photons, turned, length, (float(trail[0]) / length, float(trail[1]) / length)


def _sums(lines: Float) -> Float:
    """Of a spike's table from its middle outward, pixels times its unit."""
    whole = np.zeros(lines.shape)
    np.cumsum(0.5 * STEP * (lines[:, :, 1:] + lines[:, :, :-1]), axis=2, out=whole[:, :, 1:])
    return whole


def _finest(edges: Edges) -> float:
    """Pixels between points that shine as an even line does: across a spike no frequency is higher."""
    return float(edges.wavelength.min() * 1e-7 / edges.bars[:, 2].max() / (edges.pixel_scale * ARCSEC))


def left(size: int, samples: int, count: int) -> Float:
    """float64[count] what a star's plane is multiplied with along each axis, to fade into `add`'s light.

    size : of the plane, pixels;  samples : a pixel;  count : of samples, its middle in the middle
    """
    distance = np.abs(np.arange(count) - count // 2) / samples
    return np.array([far_light.left_compiled(float(d), size / 2 - SPARED) for d in distance])
