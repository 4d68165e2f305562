"""Compiled loops for the light of stars far from them: diffraction rings, aureole and diffraction spikes.

The core of a star is drawn with an image of the PSF (plane), which fades to 0 at its border. These functions draw the
light beyond it. In all functions, a pixel at r pixels from the star has the light `level` / r^3 from the rings and
`halo` / (r^2 + `core`) from the aureole (scattered light). `bar_directions` [b, 2] are unit vectors (column, row) along
the b bars that cross the telescope's pupil; the spike of a bar is perpendicular to it. The table `lines` [b, i, j]
contains the light of each bar's spike in a pixel. Its element [b, i, j] is for bar b, i * LONG pixels (i * 8) from the
star along the spike, and j * STEP pixels (j * 0.25) from the axis of the spike.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lake_schema.arrays import Float
from truesky.numerics.compiling import jit
from truesky.render.psf.spikes import LONG, STEP

# Width of the border zone in which the PSF image of a star fades to 0, pixels.
_FADING = 24.0
# Number of pixels along each side of a star's PSF image that are not used, because the stamp on which it is drawn is
# periodic: light at one edge would appear at the opposite edge.
SPARED = 2.0
# Upper limit of the aliased light in a star's PSF image (copies of the star from the periodic transform), as a fraction
# of the light of the diffraction rings in the middle of a side of the image.
FOLDED = 0.2
# Distance from the star within which aliased light in the PSF image is negligible, as a fraction of the period of the
# discrete transform with which the image was computed.
_MIN_FOLDED_RADIUS = 0.15


@jit
def _spike_light(bar_directions: Any, lines: Any, b: int, dx: float, dy: float) -> Any:
    """Return the light of a star's diffraction spike in a pixel at (dx, dy) pixels (columns, rows) from the star.

    `b` is the index of the bar in the telescope's pupil that causes the spike, and `bar_directions` [bars, 2] are unit
    vectors along all bars. `lines` [bars, i, j] is the light at i * 8 pixels from the star along the spike and j * 0.25
    pixels from its axis. It is interpolated linearly; the result has its unit, and is 0 beyond the table.
    """
    t = abs(dx * bar_directions[b, 0] + dy * bar_directions[b, 1]) / STEP
    r = abs(dy * bar_directions[b, 0] - dx * bar_directions[b, 1]) / LONG
    i, j = int(r), int(t)
    if i + 1 >= lines.shape[1] or j + 1 >= lines.shape[2]:
        return 0.0
    u, v = r - i, t - j
    lower = (1.0 - v) * lines[b, i, j] + v * lines[b, i, j + 1]
    return (1.0 - u) * lower + u * ((1.0 - v) * lines[b, i + 1, j] + v * lines[b, i + 1, j + 1])


@jit
def _ring_and_aureole_light(square: float, level: float, halo: float, core: float) -> Any:
    """Return the light of a star's diffraction rings and aureole, level / r^3 + halo / (r^2 + core).

    `square` is r^2, the squared distance from the star in pixels. The result has the unit of `level` and `halo`.
    """
    return level / (square * np.sqrt(square)) + halo / (square + core)


@jit
def add_outside(
    frame: Any,
    x: float,
    y: float,
    inner: float,
    level: float,
    halo: float,
    core: float,
    radius: float,
    bar_directions: Any,
    lines: Any,
    spike_reach: float,
    spike_half_width: float,
) -> None:
    """Add the light of a star outside a square around it to the image of a detector.

    Parameters
    ----------
    frame : int array, shape (ny, nx)
        Image of the detector in integers, changed in place.
    x, y : float
        Position of the star, pixels.
    inner : float
        Half side of the square, pixels.
    level, halo, core : float
        The light at r pixels from the star is level / r^3 (diffraction rings) plus halo / (r^2 + core) (aureole of
        scattered light), in the integers of the frame.
    radius : float
        Radius up to which rings and aureole are drawn, pixels.
    bar_directions : float array, shape (b, 2)
        Unit vectors (column, row) along the bars in the telescope's pupil; their spikes are perpendicular to them.
    lines : float array, shape (b, i, j)
        Light of each bar's diffraction spike in the integers of the frame: element [b, i, j] at i * 8 pixels from the
        star along the spike and j * 0.25 pixels from its axis.
    spike_reach : float
        Radius up to which spikes are drawn, pixels.
    spike_half_width : float
        Half width of the spikes, pixels; 0 to draw no spikes.
    """
    ny, nx = frame.shape
    for r in range(ny):
        dy = r - y
        row_crosses_square = abs(dy) < inner
        chord = np.sqrt(radius * radius - dy * dy) if abs(dy) < radius else -1.0
        for c in range(max(0, int(np.ceil(x - chord))), min(nx, int(np.floor(x + chord)) + 1)):
            if not (row_crosses_square and abs(c - x) < inner):
                square = (c - x) * (c - x) + dy * dy
                frame[r, c] += np.int64(np.rint(_ring_and_aureole_light(square, level, halo, core)))
        for b in range(len(bar_directions) if spike_half_width > 0.0 else 0):
            first, stop = 0, nx
            if abs(bar_directions[b, 0]) > 1e-9:
                middle, half = (
                    x - dy * bar_directions[b, 1] / bar_directions[b, 0],
                    spike_half_width / abs(bar_directions[b, 0]),
                )
                first = int(max(middle - half, 0.0))
                stop = int(np.floor(min(max(middle + half, -1.0), nx - 1.0))) + 1
            for c in range(first, stop):
                if (
                    not (row_crosses_square and abs(c - x) < inner)
                    and (c - x) * (c - x) + dy * dy < spike_reach * spike_reach
                ):
                    frame[r, c] += np.int64(np.rint(_spike_light(bar_directions, lines, b, c - x, dy)))


@jit
def add_inside(
    frame: Any,
    x: float,
    y: float,
    inner: float,
    level: float,
    halo: float,
    core: float,
    bar_directions: Any,
    lines: Any,
) -> None:
    """Add the light that a star's PSF image lacks near its border, where it has been faded to 0.

    Parameters
    ----------
    frame : int array, shape (ny, nx)
        Image of the detector in integers, changed in place.
    x, y : float
        Position of the star, pixels.
    inner : float
        Half side of the square outside which the PSF image is 0, pixels. Only pixels inside the square are changed.
    level, halo, core : float
        The light at r pixels from the star is level / r^3 (diffraction rings) plus halo / (r^2 + core) (aureole of
        scattered light), in the integers of the frame.
    bar_directions : float array, shape (b, 2)
        Unit vectors (column, row) along the bars in the telescope's pupil; their spikes are perpendicular to them.
    lines : float array, shape (b, i, j)
        Light of each bar's diffraction spike in the integers of the frame: element [b, i, j] at i * 8 pixels from the
        star along the spike and j * 0.25 pixels from its axis.
    """
    ny, nx = frame.shape
    for r in range(max(int(np.ceil(y - inner)), 0), min(int(np.ceil(y + inner)), ny)):
        for c in range(max(int(np.ceil(x - inner)), 0), min(int(np.ceil(x + inner)), nx)):
            dx, dy = c - x, r - y
            if abs(dx) < inner and abs(dy) < inner:
                fading = fading_compiled(abs(dx), inner) * fading_compiled(abs(dy), inner)
                if fading < 1.0:
                    frame[r, c] += np.int64(
                        np.rint((1.0 - fading) * _light(dx, dy, level, halo, core, bar_directions, lines))
                    )


@jit
def remove_aliased_compiled(
    stamp: Any, x: Float, y: Float, inner: float, level: float, bar_directions: Any, lines: Any, period: float,
) -> None:  # fmt: skip
    """Multiply each pixel of a star's stamp by d / (d + a), where d is the expected direct and a the aliased light.

    Aliased light comes from copies of the star, because the PSF image is a periodic discrete transform.

    Parameters
    ----------
    stamp : float array, shape (rows, columns)
        Image of the star, changed in place.
    x, y : float array, shape (p,)
        Positions of the star, or of points along its trail, in pixels of the stamp.
    inner : float
        Half side of the square outside which the PSF image of the star is 0, pixels.
    level : float
        Light of the diffraction rings of each point, extrapolated to a distance of one pixel, electrons.
    bar_directions : float array, shape (b, 2)
        Unit vectors (column, row) along the bars in the telescope's pupil; their spikes are perpendicular to them.
    lines : float array, shape (b, i, j)
        Light of each bar's diffraction spike for each point, electrons: element [b, i, j] at i * 8 pixels from the
        point along the spike and j * 0.25 pixels from its axis.
    period : float
        Period of the discrete transform with which the PSF image was computed, pixels.
    """
    for r in range(stamp.shape[0]):
        for c in range(stamp.shape[1]):
            folded = 0.0
            for p in range(len(x)):
                dx, dy = c - x[p], r - y[p]
                if abs(dx) < inner and abs(dy) < inner and dx * dx + dy * dy > (_MIN_FOLDED_RADIUS * period) ** 2:
                    fading = fading_compiled(abs(dx), inner) * fading_compiled(abs(dy), inner)
                    folded += fading * _folded_light(dx, dy, level, bar_directions, lines, period)
            if folded > 0.0:
                direct = 0.0
                for p in range(len(x)):
                    dx, dy = c - x[p], r - y[p]
                    fading = fading_compiled(abs(dx), inner) * fading_compiled(abs(dy), inner)
                    direct += fading * _light(dx, dy, level, 0.0, 1.0, bar_directions, lines)
                stamp[r, c] *= direct / (direct + folded)


@jit
def fading_compiled(distance: float, inner: float) -> Any:
    """Return the factor from 0 to 1 by which a star's PSF image is multiplied near its border, for one axis.

    `distance` is the distance from the middle along this axis, and `inner` is the distance at which the factor becomes
    0, both in pixels. The factor is a smooth step over 24 pixels.
    """
    z = min(max((inner - distance) / _FADING, 0.0), 1.0)
    return z * z * (3.0 - 2.0 * z)


@jit
def _light(dx: float, dy: float, level: float, halo: float, core: float, bar_directions: Any, lines: Any) -> Any:
    """Return the light of a star in a pixel at (dx, dy) pixels from it: rings, aureole and all diffraction spikes.

    At r pixels, the rings have level / r^3 and the aureole halo / (r^2 + core). `lines` are tables of the spikes of the
    bars in the telescope's pupil, whose directions are `bar_directions` [b, 2]. All have the unit of the result.
    """
    light = _ring_and_aureole_light(dx * dx + dy * dy, level, halo, core)
    for b in range(len(bar_directions)):
        light += _spike_light(bar_directions, lines, b, dx, dy)
    return light


@jit
def _folded_light(dx: float, dy: float, level: float, bar_directions: Any, lines: Any, period: float) -> Any:
    """Return the aliased light of a star in a pixel at (dx, dy) pixels from it.

    It comes from positions one `period` (pixels) away along columns, rows or both, because the PSF image is a periodic
    discrete transform. Relative to direct light, it is weakened by a ratio of sinc^2 functions, because the edges of
    the sampled pupil are softened. The light at r pixels from a star is `level` / r^3 from diffraction rings, plus the
    spikes of the pupil's bars (directions `bar_directions`, tables `lines`).
    """
    total = 0.0
    for up in range(-1, 2):
        for right in range(-1, 2):
            ax, ay = dx + right * period, dy + up * period
            square = ax * ax + ay * ay
            # Light from positions more than one period away from the star is negligible.
            if (up != 0 or right != 0) and square < period * period:
                softening = _edge_softening(np.sqrt(square) / period)
                total += _light(ax, ay, level, 0.0, 1.0, bar_directions, lines) * softening
    return total / _edge_softening(np.sqrt(dx * dx + dy * dy) / period)


@jit
def _edge_softening(angle: float) -> Any:
    turn = np.pi * angle
    return (np.sin(turn) / turn) ** 2 if turn > 1e-6 else 1.0
