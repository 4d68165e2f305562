"""Light diffracted by the pupil's edges far from a bright star, beyond the plane of its PSF.

Rings fall off as r^-3 and an aureole as r^-2; spikes are tabulated (psf/spikes.py). The plane of side N fades over 24
pixels by the smooth step s(z) = z^2 (3 - 2 z) in columns and in rows. `add` draws the fraction 1 - s s of the light
there and all light farther out, so that the sum has no seam. A moving star is drawn as points along its trail, which
are closer than the finest fringe lambda / l of a bar.

The plane is a discrete transform of the pupil with a period Q. A pixel at r from the middle therefore also contains the
light of the positions r + Q m (m is a pair of integers). The softened edges of the sampled pupil weaken that light to
sinc^2(|r + Q m| / Q), relative to sinc^2(|r| / Q) for the light at r itself. `remove_aliased` multiplies each pixel by
direct / (direct + aliased) light.

References
----------
Born & Wolf, Principles of Optics, sections 8.5.1 (a straight bar) and 8.5.2 (a circle, far out).
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

# Light is drawn down to this fraction of the negligible light, so that its border is invisible.
_FAINTEST = 0.5
# Spacing of points along a trail, in finest fringes. It is below 1 to reduce steps at the end of a spike's table.
_ALONG = 0.6
# Spacing of points along a piece of a trail when aliased light is removed, pixels. Only a ratio is needed there.
_POINT_SPACING = 4.0
# Measured CPU time, s (2.5 GHz, one core): per pixel of the frame for a star, and in addition per pixel of a trail's
# length; per pixel of a stamp and point along a piece.
_STAR_S, _LONGER_S, _UNFOLD_S = 7e-9, 1.6e-9, 5e-8


@dataclass(frozen=True, slots=True)
class Star:
    """A point source that shines beyond the plane of its PSF.

    Attributes
    ----------
    column, row : float
        Position, or the middle of its trail, pixels.
    electrons : float
        Expected electrons.
    photons : float array, shape (w,), or None
        Fraction of the photons in each sub-band; None if all are equal.
    size : int
        Side of the plane, pixels.
    negligible_electrons : float
        Electrons per pixel that may be neglected.
    edges : Edges or None
        Diffracting edges of the pupil; None if there is no diffraction.
    trail : float array, shape (2,), or None
        Displacement of the star and its plane during the exposure, pixels; None if it is at rest.
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
    """Add the light of a star outside its plane, which fades by `fading_window`, to a frame.

    Parameters
    ----------
    frame : int array, shape (ny, nx)
        Frame, changed in place.
    star : Star
        The star.
    unit : float
        Units of the frame per electron.
    """
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
    # Radius at which rings and aureole have both become negligible.
    radius = max((level / faintest) ** (1.0 / 3.0), (halo / faintest) ** 0.5) if faintest > 0.0 else farthest
    radius = min(radius, farthest)
    inner = star.size / 2 - SPARED
    # Length and half width of the visible part of the spikes outside the plane.
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
    """Largest distance from the points to a corner of the frame, plus a pixel."""
    ny, nx = frame.shape
    return float(np.hypot(max(x.max() + 1.0, nx - x.min()), max(y.max() + 1.0, ny - y.min())))


def remove_aliased(star: Star, stamp: Array, x0: int, y0: int, nx: int, ny: int) -> None:
    """Remove the aliased light of a star's plane from its stamp, up to a fifth of the light in the corners.

    Parameters
    ----------
    star : Star
        The star.
    stamp : array, shape (N, N)
        Stamp, changed in place.
    x0, y0 : int
        First column and row of the stamp on the frame.
    nx, ny : int
        Columns and rows of the frame. Pixels outside the frame are not changed.

    Notes
    -----
    Each pixel is multiplied by the direct fraction of the expected direct and aliased light. The two interfere, and
    where they cancel, both are smaller.
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
    """Predicted CPU time of `add`.

    Parameters
    ----------
    length : float array, shape (n,)
        Lengths of trails, pixels; 0 for stars at rest.
    nx, ny : int
        Columns and rows of the frame.

    Returns
    -------
    float
        CPU time, s, accurate to a factor of 2. If the light is hardly noticeable, the true time is shorter.
    """
    return float((_STAR_S + _LONGER_S * length).sum()) * nx * ny


def remove_aliased_seconds(length: Float, sizes: Int) -> float:
    """Predicted CPU time of `remove_aliased`, s, for pieces of trails [n] of given lengths and stamp sides, pixels."""
    return float((_UNFOLD_S * sizes.astype(float) ** 2 * np.maximum(np.ceil(length / _POINT_SPACING), 1.0)).sum())


def _photons_and_directions(photons: Float | None, edges: Edges) -> tuple[Float, Float]:
    """Photons by sub-band [w], and directions of the bars [b, 2]."""
    photons = np.full(len(edges.wavelength), 1.0 / len(edges.wavelength)) if photons is None else photons
    return photons, np.stack([np.cos(edges.bars[:, 0]), np.sin(edges.bars[:, 0])], axis=1)


def _trail_points(star: Star, spacing: float) -> tuple[Float, Float]:
    """Columns and rows [p] of points along a trail, at most `spacing` pixels apart; one point if it is shorter."""
    length = 0.0 if star.trail is None else float(np.hypot(*star.trail))
    if star.trail is None or length <= spacing:
        return np.array([star.column]), np.array([star.row])
    count = math.ceil(length / spacing)
    along = (np.arange(count) + 0.5) / count - 0.5
    return star.column + along * star.trail[0], star.row + along * star.trail[1]


def _finest_fringe(edges: Edges) -> float:
    """Width of the finest fringe across a spike, pixels; points at this spacing look like a continuous line."""
    return float(edges.wavelength.min() * 1e-7 / edges.bars[:, 2].max() / (edges.pixel_scale * ARCSEC))


def fading_window(size: int, samples: int, count: int) -> Float:
    """Factors by which a star's plane is multiplied along each axis, to fade into the light of `add`.

    Parameters
    ----------
    size : int
        Side of the plane, pixels.
    samples : int
        Samples per pixel.
    count : int
        Number of samples, centred on the plane.

    Returns
    -------
    float array, shape (count,)
        Factors from 0 to 1.
    """
    distance = np.abs(np.arange(count) - count // 2) / samples
    return np.array([far_light.fading_compiled(float(d), size / 2 - SPARED) for d in distance])
