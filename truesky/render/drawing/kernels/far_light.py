"""Compiled loops for the light of stars far from them: rings, aureole and diffraction spikes.

In all functions, `level` / r^3 is the light of the rings and `halo` / (r^2 + `core`) that of the aureole, for r in
pixels. `bar_directions` [b, 2] are unit vectors of the pupil's bars. The light of a bar's spike is in the table `lines`
[b, i, j], at the distance i LONG along the spike and j STEP across it.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lake_schema.arrays import Float
from truesky.numerics.compiling import jit
from truesky.render.psf.spikes import LONG, STEP

# Pixels over which the plane fades, and outermost pixels that are not used because a stamp is periodic.
_FADING, SPARED = 24.0, 2.0
# Largest aliased light in the corners, as a fraction of the light at the plane's sides; radius, as a fraction of the
# period, within which aliased light is negligible.
FOLDED, _MIN_FOLDED_RADIUS = 0.2, 0.15


@jit
def _spike_light(bar_directions: Any, lines: Any, b: int, dx: float, dy: float) -> Any:
    """Light of the spike of bar `b` at an offset (dx, dy)."""
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
    """Light of the rings of circular edges and of the aureole, at a squared distance."""
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
    """Add the light outside a square of half side `inner` to a frame.

    Parameters
    ----------
    frame : int array, shape (ny, nx)
        Frame, changed in place.
    x, y : float
        Position of the star, pixels.
    inner : float
        Half side of the square, pixels.
    level, halo, core : float
        Rings and aureole in units of the frame, see the module.
    radius : float
        Radius up to which rings and aureole are drawn, pixels.
    bar_directions : float array, shape (b, 2)
        Directions of the bars.
    lines : float array, shape (b, i, j)
        Light of the spikes in units of the frame.
    spike_reach : float
        Radius up to which spikes are drawn, pixels.
    spike_half_width : float
        Half width of the spikes, pixels; 0 without spikes.
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
                first, stop = int(max(middle - half, 0.0)), int(min(max(middle + half, -1.0), nx - 1.0)) + 1
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
    """Add the light that the faded plane lacks inside the square.

    Parameters
    ----------
    frame : int array, shape (ny, nx)
        Frame, changed in place.
    x, y : float
        Position of the star, pixels.
    inner : float
        Half side of the square, pixels.
    level, halo, core : float
        Rings and aureole in units of the frame, see the module.
    bar_directions : float array, shape (b, 2)
        Directions of the bars.
    lines : float array, shape (b, i, j)
        Light of the spikes in units of the frame.
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
    """Multiply each pixel of a stamp by the direct fraction of its direct and aliased light.

    Parameters
    ----------
    stamp : float array
        Stamp, changed in place.
    x, y : float array, shape (p,)
        Positions of points along the trail, pixels.
    inner : float
        Half side of the square outside which the plane has faded, pixels.
    level : float
        Rings of each point, electrons.
    bar_directions : float array, shape (b, 2)
        Directions of the bars.
    lines : float array, shape (b, i, j)
        Spikes of each point, electrons.
    period : float
        Period of the plane's transform, pixels.
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
    """Smooth step by which the plane fades, at a distance from its middle along one axis, pixels."""
    z = min(max((inner - distance) / _FADING, 0.0), 1.0)
    return z * z * (3.0 - 2.0 * z)


@jit
def _light(dx: float, dy: float, level: float, halo: float, core: float, bar_directions: Any, lines: Any) -> Any:
    """Light of a star in a pixel at an offset (dx, dy)."""
    light = _ring_and_aureole_light(dx * dx + dy * dy, level, halo, core)
    for b in range(len(bar_directions)):
        light += _spike_light(bar_directions, lines, b, dx, dy)
    return light


@jit
def _folded_light(dx: float, dy: float, level: float, bar_directions: Any, lines: Any, period: float) -> Any:
    """Light that is aliased from positions one period away, weakened by sinc^2 because the edges are softened."""
    total = 0.0
    for up in range(-1, 2):
        for right in range(-1, 2):
            ax, ay = dx + right * period, dy + up * period
            square = ax * ax + ay * ay
            # Light from beyond one period is negligible.
            if (up != 0 or right != 0) and square < period * period:
                softening = _edge_softening(np.sqrt(square) / period)
                total += _light(ax, ay, level, 0.0, 1.0, bar_directions, lines) * softening
    return total / _edge_softening(np.sqrt(dx * dx + dy * dy) / period)


@jit
def _edge_softening(angle: float) -> Any:
    turn = np.pi * angle
    return (np.sin(turn) / turn) ** 2 if turn > 1e-6 else 1.0
