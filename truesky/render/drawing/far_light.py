"""Draw light far from a bright star: diffraction by the edges of the pupil, and an aureole of scattered light.

The core of the star is drawn with an image of the PSF, which has a side of N pixels; this module draws the light beyond
it. Rings fall off as r^-3 and the aureole as r^-2; diffraction spikes are tabulated (psf/spikes.py). Near its border,
the PSF image fades to 0 over 24 pixels by the smooth step s = z^2 (3 - 2 z), where z falls from 1 to 0 towards the
border. With s_x for columns and s_y for rows, `add` draws the fraction 1 - s_x s_y of the light in this zone, and all
light farther out, so that the sum has no seam. A moving star is drawn as points along its trail, which are closer than
the finest fringe lambda / l of a bar of length l in the pupil.

The PSF image is a discrete transform of the pupil with a period Q. A pixel at r from the middle therefore also contains
the light of the positions r + Q m (m is a pair of integers), which is called aliased. The softened edges of the sampled
pupil weaken aliased light to sinc^2(|r + Q m| / Q), relative to sinc^2(|r| / Q) for the direct light at r.
`remove_aliased` multiplies each pixel by direct / (direct + aliased) light.

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
from truesky.render.psf.spikes import ARCSEC, FARTHEST, LONG, STEP, WIDE, Edges

# Light of a star is drawn down to this fraction of `Star.negligible_electrons` (electrons per pixel that may be
# neglected), so that the border of the drawn light is invisible.
_FAINTEST = 0.5
# Spacing of the points with which the trail of a moving star is drawn, as a fraction of the width of the finest
# diffraction fringe. The table of a spike ends abruptly, which causes a step in the light at each point of the trail. A
# value below 1 makes these steps smaller.
_ALONG = 0.6
# Number of points by which tables of spikes are longer than the spikes are visible.
_MORE_POINTS = 4
# Spacing of points along the trail of a moving star when aliased light is removed, pixels. It can be wide, since only
# the ratio of direct and aliased light is needed.
_POINT_SPACING = 4.0
# Measured CPU time of drawing the light of one bright star at rest beyond its PSF image, s per pixel of the detector
# (2.5 GHz, one core).
_STAR_S = 7e-9
# Measured additional CPU time of drawing the light of a moving star beyond its PSF image: s per pixel of the detector,
# for each pixel of the length of the star's trail.
_LONGER_S = 1.6e-9
# Measured CPU time of removing aliased light from a star's stamp (2.5 GHz, one core): s per pixel of the stamp, for
# each of the points with which the trail of a moving star is approximated (1 for a star at rest).
_UNFOLD_S = 5e-8


@dataclass(frozen=True, slots=True)
class Star:
    """A bright star whose light is drawn also beyond the border of its PSF image (called plane here).

    Attributes
    ----------
    column, row : float
        Position, or middle of the trail of a moving star, 0-based pixels.
    electrons : float
        Expected electrons in total.
    photons : float array, shape (w,), or None
        Fraction of the photons in each of w sub-bands of the passband; None if all are equal.
    size : int
        Side of the plane (PSF image), pixels.
    negligible_electrons : float
        Electrons per pixel that may be neglected; 0 to neglect nothing.
    edges : Edges or None
        Edges of the telescope's pupil, which diffract light, and aureole; None to draw nothing beyond the plane.
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
    """Add the light of a star outside its PSF image, and the light that the image lacks near its border, to a frame.

    The PSF image must have been multiplied by `fading_window` when it was drawn. Nothing is added if `star.edges` is
    None.

    Parameters
    ----------
    frame : int array, shape (ny, nx)
        Image of the detector in integers, changed in place.
    star : Star
        The star, which may lie outside the frame.
    unit : float
        Factor from electrons to the integers of the frame.
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
    faintest = _FAINTEST * star.negligible_electrons
    halo, core = star.electrons * edges.aureole[0], edges.aureole[1]
    # Distance from the star in pixels beyond which diffraction rings and aureole are both fainter than `faintest`.
    radius = max((level / faintest) ** (1.0 / 3.0), (halo / faintest) ** 0.5) if faintest > 0.0 else farthest
    radius = min(radius, farthest)
    inner = star.size / 2 - SPARED
    if _misses_frame(frame, (x, y), max(radius, inner * np.sqrt(2.0)), bar_directions):
        # The tables of the spikes take longer than everything else if the frame is a small part of a detector.
        return
    table_reach = farthest
    if faintest > 0.0:
        # Spikes end where they are invisible. The kernels interpolate between this point and the next ones.
        max_reach = spikes.max_reach(edges, photons, faintest / star.electrons)
        table_reach = min(farthest, max(max_reach, inner * np.sqrt(2.0)) + _MORE_POINTS * LONG)
    lines = star.electrons * spikes.spike_light(edges, photons, max(table_reach, edges.period))
    # Outside the PSF image, diffraction spikes are drawn where they are brighter than `faintest` (electrons per pixel):
    # compute the distance from the star and the distance from the axis of a spike up to which they are, in pixels.
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


def _misses_frame(frame: Int, points: tuple[Float, Float], radius: float, bar_directions: Float) -> bool:
    """Return True if no light of a star is drawn on the frame.

    `points` are the columns and rows of the star, or of points along its trail. Up to `radius` pixels from them, rings
    and aureole are drawn. `bar_directions` [b, 2] are unit vectors along the bars of the pupil. The spike of a bar is
    perpendicular to it, and its table ends at WIDE pixels from its axis.
    """
    ny, nx = frame.shape
    x, y = points
    outside_x, outside_y = (np.maximum(np.maximum(-at, at - (count - 1)), 0.0) for at, count in ((x, nx), (y, ny)))
    if (np.hypot(outside_x, outside_y) <= radius).any():
        return False
    # Distances [b, point, corner] of the corners of the frame from the axis of a spike. If the axis crosses the frame,
    # they have both signs.
    corner_x, corner_y = np.array([0.0, nx - 1.0, 0.0, nx - 1.0]), np.array([0.0, 0.0, ny - 1.0, ny - 1.0])
    distance = (corner_x - x[:, None]) * bar_directions[:, 0, None, None]
    distance = distance + (corner_y - y[:, None]) * bar_directions[:, 1, None, None]
    limit = WIDE + STEP
    return bool(((distance.min(axis=2) > limit) | (distance.max(axis=2) < -limit)).all())


def _farthest_corner(frame: Int, x: Float, y: Float) -> float:
    """Return an upper limit, in pixels, of the distance from any of the points (x, y) to the pixels of the frame."""
    ny, nx = frame.shape
    return float(np.hypot(max(x.max() + 1.0, nx - x.min()), max(y.max() + 1.0, ny - y.min())))


def remove_aliased(star: Star, stamp: Array, x0: int, y0: int, nx: int, ny: int) -> None:
    """Remove the aliased light of a star's PSF image from its stamp; it is up to a fifth of the light in the corners.

    The PSF image is a periodic discrete transform, so it also contains light of periodic copies of the star.

    Parameters
    ----------
    star : Star
        The star.
    stamp : array, shape (N, N)
        Image of the star, electrons, changed in place.
    x0, y0 : int
        Column and row of the detector at which the first pixel of the stamp lies.
    nx, ny : int
        Number of columns and of rows of the detector. Pixels outside the detector are not changed.

    Notes
    -----
    Each pixel is multiplied by d / (d + a), where d and a are the expected direct and aliased light. A subtraction of a
    would be wrong: the amplitudes interfere, and where they cancel, the pixel contains less aliased light. Nothing is
    changed if the aliased light is negligible, or if `star.edges` is None or has the period 0.
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
    """Predict the CPU time of `add` for n stars.

    Parameters
    ----------
    length : float array, shape (n,)
        Displacements of the stars during the exposure, pixels; 0 for stars at rest.
    nx, ny : int
        Number of columns and of rows of the detector.

    Returns
    -------
    float
        CPU time of all stars together on one core of 2.5 GHz, s, accurate to a factor of 2. If the light is hardly
        noticeable, the true time is shorter.
    """
    return float((_STAR_S + _LONGER_S * length).sum()) * nx * ny


def remove_aliased_seconds(length: Float, sizes: Int) -> float:
    """Return the predicted CPU time, s, of `remove_aliased` for n stamps of stars together.

    `length` [n] are the displacements of the stars on their stamps during the exposure, pixels; 0 for stars at rest.
    `sizes` [n] are the sides of the stamps, pixels.
    """
    return float((_UNFOLD_S * sizes.astype(float) ** 2 * np.maximum(np.ceil(length / _POINT_SPACING), 1.0)).sum())


def _photons_and_directions(photons: Float | None, edges: Edges) -> tuple[Float, Float]:
    """Return the fractions of a star's photons in w sub-bands, and unit vectors [b, 2] along b bars in the pupil.

    `photons` [w] are these fractions; None is replaced by equal fractions. The bars cross the telescope's pupil and
    cause diffraction spikes.
    """
    photons = np.full(len(edges.wavelength), 1.0 / len(edges.wavelength)) if photons is None else photons
    return photons, np.stack([np.cos(edges.bars[:, 0]), np.sin(edges.bars[:, 0])], axis=1)


def _trail_points(star: Star, spacing: float) -> tuple[Float, Float]:
    """Return the columns and rows [p] of points along a star's trail, at most `spacing` pixels apart.

    A star at rest, or with a trail shorter than `spacing`, has one point.
    """
    length = 0.0 if star.trail is None else float(np.hypot(*star.trail))
    if star.trail is None or length <= spacing:
        return np.array([star.column]), np.array([star.row])
    count = math.ceil(length / spacing)
    along = (np.arange(count) + 0.5) / count - 0.5
    return star.column + along * star.trail[0], star.row + along * star.trail[1]


def _finest_fringe(edges: Edges) -> float:
    """Return the width in pixels of the finest fringe across a diffraction spike, lambda / l.

    lambda is the shortest wavelength, and l the length of the longest bar in the telescope's pupil.

    The spikes of points at this spacing along the trail of a moving star add up without gaps.
    """
    return float(edges.wavelength.min() * 1e-7 / edges.bars[:, 2].max() / (edges.pixel_scale * ARCSEC))


def fading_window(size: int, samples: int, count: int) -> Float:
    """Return the factors by which a star's PSF image is multiplied along each axis, to fade to 0 at its border.

    Parameters
    ----------
    size : int
        Side of the PSF image, pixels.
    samples : int
        Number of samples of the image per pixel.
    count : int
        Number of samples of the result. Its middle sample is that of the PSF image.

    Returns
    -------
    float array, shape (count,)
        Factors: 1 around the middle, and 0 from a distance of size / 2 - 2 pixels from the middle on. They fall from 1
        to 0 over the 24 pixels before this distance.
    """
    distance = np.abs(np.arange(count) - count // 2) / samples
    return np.array([far_light.fading_compiled(float(d), size / 2 - SPARED) for d in distance])
