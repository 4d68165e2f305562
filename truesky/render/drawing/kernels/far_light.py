"""Compiled: light of stars far from them, wings and diffraction spikes, on a frame and on a stamp."""

from __future__ import annotations

from typing import Any

import numpy as np

from lake_schema.arrays import Float
from truesky.numerics.compiling import jit
from truesky.render.psf.spikes import LONG, STEP

# Pixels over which the plane fades, and its outermost, which are not used: a stamp is periodic.
_FADING, SPARED = 24.0, 2.0
# Of the light at the plane's sides, at most what was folded into its corners; none to speak of so near to its middle,
# of the period.
FOLDED, _NEAR = 0.2, 0.15


@jit
def _on_spike(turned: Any, lines: Any, b: int, dx: float, dy: float) -> Any:
    """Bar b's spike at an offset; turned : [b, 2] along the bar."""
    t = abs(dx * turned[b, 0] + dy * turned[b, 1]) / STEP
    r = abs(dy * turned[b, 0] - dx * turned[b, 1]) / LONG
    i, j = int(r), int(t)
    if i + 1 >= lines.shape[1] or j + 1 >= lines.shape[2]:
        return 0.0
    u, v = r - i, t - j
    near = (1.0 - v) * lines[b, i, j] + v * lines[b, i, j + 1]
    return (1.0 - u) * near + u * ((1.0 - v) * lines[b, i + 1, j] + v * lines[b, i + 1, j + 1])


@jit
def _round(square: float, level: float, halo: float, core: float) -> Any:
    """Rings of the pupil's circles and the aureole, at a squared distance."""
    return level / (square * np.sqrt(square)) + halo / (square + core)


@jit
def outside(
    frame: Any, x: float, y: float, inner: float, level: float, halo: float, core: float, radius: float, turned: Any,
    lines: Any, far: float, wide: float,
) -> None:  # fmt: skip
    """Adds what lies outside a square of half side `inner`: ring and aureole up to `radius`, spikes up to `far`.

    level, halo, core, lines : in the frame's units, as below
    frame : integers;  x, y : of the star, pixels
    turned : [b, 2] directions of the bars;  wide : half width of a spike's table, pixels, 0 = no spikes
    """
    ny, nx = frame.shape
    for r in range(ny):
        dy = r - y
        own = abs(dy) < inner
        chord = np.sqrt(radius * radius - dy * dy) if abs(dy) < radius else -1.0
        for c in range(max(0, int(np.ceil(x - chord))), min(nx, int(np.floor(x + chord)) + 1)):
            if not (own and abs(c - x) < inner):
                square = (c - x) * (c - x) + dy * dy
                frame[r, c] += np.int64(np.rint(_round(square, level, halo, core)))
        for b in range(len(turned) if wide > 0.0 else 0):
            left, right = 0, nx
            if abs(turned[b, 0]) > 1e-9:
                middle, half = x - dy * turned[b, 1] / turned[b, 0], wide / abs(turned[b, 0])
                left, right = int(max(middle - half, 0.0)), int(min(max(middle + half, -1.0), nx - 1.0)) + 1
            for c in range(left, right):
                if not (own and abs(c - x) < inner) and (c - x) * (c - x) + dy * dy < far * far:
                    frame[r, c] += np.int64(np.rint(_on_spike(turned, lines, b, c - x, dy)))


@jit
def inside(
    frame: Any, x: float, y: float, inner: float, level: float, halo: float, core: float, turned: Any, lines: Any
) -> None:
    """Adds what has faded of the plane, inside the square.

    frame, x, y, inner, level, halo, core, turned, lines : as of `outside`
    """
    ny, nx = frame.shape
    for r in range(max(int(np.ceil(y - inner)), 0), min(int(np.ceil(y + inner)), ny)):
        for c in range(max(int(np.ceil(x - inner)), 0), min(int(np.ceil(x + inner)), nx)):
            dx, dy = c - x, r - y
            if abs(dx) < inner and abs(dy) < inner:
                left = left_compiled(abs(dx), inner) * left_compiled(abs(dy), inner)
                if left < 1.0:
                    frame[r, c] += np.int64(np.rint((1.0 - left) * _light(dx, dy, level, halo, core, turned, lines)))


@jit
def remove_aliased_compiled(
    stamp: Any, x: Float, y: Float, inner: float, level: float, turned: Any, lines: Any, period: float,
) -> None:  # fmt: skip
    """Multiplies a stamp by what is not folded of the light that points at x, y send to each pixel.

    inner        : half side of the square outside which the plane has faded, pixels
    level, lines : ring and spikes of each point, electrons;  turned : [b, 2] directions of the bars
    period       : of the plane's transform, pixels
    """
    for r in range(stamp.shape[0]):
        for c in range(stamp.shape[1]):
            folded = 0.0
            for p in range(len(x)):
                dx, dy = c - x[p], r - y[p]
                if abs(dx) < inner and abs(dy) < inner and dx * dx + dy * dy > (_NEAR * period) ** 2:
                    left = left_compiled(abs(dx), inner) * left_compiled(abs(dy), inner)
                    folded += left * _folded(dx, dy, level, turned, lines, period)
            if folded > 0.0:
                own = 0.0
                for p in range(len(x)):
                    dx, dy = c - x[p], r - y[p]
                    left = left_compiled(abs(dx), inner) * left_compiled(abs(dy), inner)
                    own += left * _light(dx, dy, level, 0.0, 1.0, turned, lines)
                stamp[r, c] *= own / (own + folded)


@jit
def left_compiled(distance: float, inner: float) -> Any:
    """Of the plane's light, pixels from its middle along one axis: a smooth step."""
    z = min(max((inner - distance) / _FADING, 0.0), 1.0)
    return z * z * (3.0 - 2.0 * z)


@jit
def _light(dx: float, dy: float, level: float, halo: float, core: float, turned: Any, lines: Any) -> Any:
    """What a star shines in a pixel at an offset."""
    light = _round(dx * dx + dy * dy, level, halo, core)
    for b in range(len(turned)):
        light += _on_spike(turned, lines, b, dx, dy)
    return light


@jit
def _folded(dx: float, dy: float, level: float, turned: Any, lines: Any, period: float) -> Any:
    """What of it the plane has that lies a period away; the pupil's soft edges had weakened that by sinc^2."""
    total = 0.0
    for up in range(-1, 2):
        for right in range(-1, 2):
            ax, ay = dx + right * period, dy + up * period
            square = ax * ax + ay * ay
            # From farther away than a period next to nothing has passed.
            if (up != 0 or right != 0) and square < period * period:
                passed = _passed(np.sqrt(square) / period)
                total += _light(ax, ay, level, 0.0, 1.0, turned, lines) * passed
    return total / _passed(np.sqrt(dx * dx + dy * dy) / period)


@jit
def _passed(angle: float) -> Any:
    turn = np.pi * angle
    return (np.sin(turn) / turn) ** 2 if turn > 1e-6 else 1.0
