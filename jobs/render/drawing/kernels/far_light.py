"""Compiled: light of stars far from them, wings and diffraction spikes, on a frame and on a stamp."""

from __future__ import annotations

from typing import Any

import numpy as np

from jobs.compiling import jit
from jobs.render.psf.spikes import LONG, STEP, WIDE
from lake_schema.arrays import Float

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
def outside(
    frame: Any, x: float, y: float, inner: float, level: float, radius: float, turned: Any, lines: Any, far: float,
    wide: float,
) -> None:  # fmt: skip
    """Adds what lies outside a square of half side `inner`: the ring up to `radius`, spikes up to `far`.

    level, lines : in the frame's units, as below
    """
    ny, nx = frame.shape
    for r in range(ny):
        dy = r - y
        own = abs(dy) < inner
        chord = np.sqrt(radius * radius - dy * dy) if abs(dy) < radius else -1.0
        for c in range(max(0, int(np.ceil(x - chord))), min(nx, int(np.floor(x + chord)) + 1)):
            if not (own and abs(c - x) < inner):
                square = (c - x) * (c - x) + dy * dy
                frame[r, c] += np.int64(np.rint(level / (square * np.sqrt(square))))
        for b in range(len(turned) if wide > 0.0 else 0):
            left, right = 0, nx
            if abs(turned[b, 0]) > 1e-9:
                middle, half = x - dy * turned[b, 1] / turned[b, 0], wide / abs(turned[b, 0])
                left, right = int(max(middle - half, 0.0)), int(min(max(middle + half, -1.0), nx - 1.0)) + 1
            for c in range(left, right):
                if not (own and abs(c - x) < inner) and (c - x) * (c - x) + dy * dy < far * far:
                    frame[r, c] += np.int64(np.rint(_on_spike(turned, lines, b, c - x, dy)))


@jit
def inside(frame: Any, x: float, y: float, inner: float, level: float, turned: Any, lines: Any) -> None:
    """Adds what has faded of the plane, inside the square."""
    ny, nx = frame.shape
    for r in range(max(int(np.ceil(y - inner)), 0), min(int(np.ceil(y + inner)), ny)):
        for c in range(max(int(np.ceil(x - inner)), 0), min(int(np.ceil(x + inner)), nx)):
            dx, dy = c - x, r - y
            if abs(dx) < inner and abs(dy) < inner:
                left = left_compiled(abs(dx), inner) * left_compiled(abs(dy), inner)
                if left < 1.0:
                    frame[r, c] += np.int64(
                        np.rint((1.0 - left) * _light(dx, dy, level, turned, lines, lines, 0.0, 0.0, 0.0))
                    )


@jit
def streak(
    frame: Any, x: float, y: float, ux: float, uy: float, length: float, inner: float, level: float, radius: float,
    turned: Any, lines: Any, sums: Any, far: float, wide: float, fine: float,
) -> None:  # fmt: skip
    """Adds what `_outside` and `_inside` add of each point of a trail along (ux, uy) about x, y.

    level, lines : of a pixel of the trail;  fine : pixels between points in the square's border, where light fades
    """
    ny, nx = frame.shape
    end, core = 0.5 * length, inner - _FADING
    for r in range(ny):
        for c in range(nx):
            dx, dy = c - x, r - y
            # The points in whose square the pixel lies, and those in whose square's border.
            first, last = _covering(dx, dy, ux, uy, inner, end)
            light = 0.0
            nearest = min(max(dx * ux + dy * uy, -end), end)
            if (dx - nearest * ux) ** 2 + (dy - nearest * uy) ** 2 < radius * radius:
                light += level * (_ring_of(dx, dy, ux, uy, -end, first) + _ring_of(dx, dy, ux, uy, last, end))
            for b in range(len(turned) if wide > 0.0 else 0):
                for low, high in ((-end, first), (last, end)):
                    light += _spike_of(turned, lines, sums, b, dx, dy, ux, uy, low, high, far, wide)
            if first < last:
                start, stop = _covering(dx, dy, ux, uy, core, end)
                if start >= stop:
                    start, stop = last, last
                for low, high in ((first, start), (stop, last)):
                    points = int(np.ceil((high - low) / fine))
                    for p in range(points):
                        s = low + (high - low) * (p + 0.5) / points
                        ax, ay = dx - s * ux, dy - s * uy
                        faded = 1.0 - left_compiled(abs(ax), inner) * left_compiled(abs(ay), inner)
                        # No trail, its sums are not asked for.
                        light += faded * _light(ax, ay, level, turned, lines, sums, ux, uy, 0.0) * (high - low) / points
            if light > 0.0:
                frame[r, c] += np.int64(np.rint(light))


@jit
def _covering(dx: float, dy: float, ux: float, uy: float, half: float, end: float) -> Any:
    """Where along a trail, from -end to end, a pixel is within `half` of it in columns and in rows; else end, end."""
    low, high = -end, end
    for d, u in ((dx, ux), (dy, uy)):
        if abs(u) > 1e-9:
            low, high = max(low, d / u - half / abs(u)), min(high, d / u + half / abs(u))
        elif abs(d) >= half:
            return end, end
    return (low, high) if low < high else (end, end)


@jit
def _ring_of(dx: float, dy: float, ux: float, uy: float, low: float, high: float) -> Any:
    """Integral of r^-3 over a trail from `low` to `high`, in forms that lose no digits on its own line."""
    if low >= high:
        return 0.0
    along, beside = dx * ux + dy * uy, dx * uy - dy * ux
    a, b = low - along, high - along
    if a < 0.0 < b:
        square = beside * beside
        return (b / np.hypot(b, beside) - a / np.hypot(a, beside)) / square
    if b <= 0.0:
        a, b = -b, -a
    near, away = np.hypot(a, beside), np.hypot(b, beside)
    return 1.0 / (near * (near + a)) - 1.0 / (away * (away + b))


@jit
def _spike_of(
    turned: Any, lines: Any, sums: Any, b: int, dx: float, dy: float, ux: float, uy: float, low: float, high: float,
    far: float, wide: float,
) -> Any:  # fmt: skip
    """Integral of bar b's spike over a trail from `low` to `high`, as far as it lies within `far` and `wide`."""
    t, ut = dx * turned[b, 0] + dy * turned[b, 1], ux * turned[b, 0] + uy * turned[b, 1]
    r, ur = dy * turned[b, 0] - dx * turned[b, 1], uy * turned[b, 0] - ux * turned[b, 1]
    for d, u, half in ((t, ut, wide), (r, ur, far)):
        if abs(u) > 1e-9:
            low, high = max(low, d / u - half / abs(u)), min(high, d / u + half / abs(u))
        elif abs(d) >= half:
            return 0.0
    if low >= high:
        return 0.0
    total, parts = 0.0, int((high - low) * abs(ur) / LONG) + 1
    step = (high - low) / parts
    for p in range(parts):
        s = low + (p + 0.5) * step
        out, across = abs(r - s * ur), t - s * ut
        passed = step * abs(ut)
        if passed > 0.1 * STEP:
            side = 0.5 * passed
            total += (
                step
                / passed
                * (_sum_at(lines, sums, b, out, across + side) - _sum_at(lines, sums, b, out, across - side))
            )
        else:
            total += step * _on_spike(turned, lines, b, dx - s * ux, dy - s * uy)
    return total


@jit
def _sum_at(lines: Any, sums: Any, b: int, r: float, t: float) -> Any:
    """Integral across bar b's spike from its middle to t, of the table's straight pieces."""
    i, j = int(r / LONG), int(abs(t) / STEP)
    if i + 1 >= lines.shape[1]:
        return 0.0
    j = min(j, lines.shape[2] - 2)
    u, v = r / LONG - i, min(abs(t) / STEP - j, 1.0)
    near = sums[b, i, j] + STEP * v * (lines[b, i, j] + 0.5 * v * (lines[b, i, j + 1] - lines[b, i, j]))
    away = sums[b, i + 1, j] + STEP * v * (lines[b, i + 1, j] + 0.5 * v * (lines[b, i + 1, j + 1] - lines[b, i + 1, j]))
    found = (1.0 - u) * near + u * away
    return found if t >= 0.0 else -found


@jit
def unfold_compiled(
    stamp: Any, x: Float, y: Float, ux: float, uy: float, length: float, inner: float, level: float, turned: Any,
    lines: Any, sums: Any, period: float,
) -> None:  # fmt: skip
    """Multiplies a stamp by what is not folded of the light that points at x, y send to each pixel.

    length : that each of them stands for, of a trail along (ux, uy): as of `_light`
    """
    for r in range(stamp.shape[0]):
        for c in range(stamp.shape[1]):
            folded = 0.0
            for p in range(len(x)):
                dx, dy = c - x[p], r - y[p]
                if abs(dx) < inner and abs(dy) < inner and dx * dx + dy * dy > (_NEAR * period) ** 2:
                    left = left_compiled(abs(dx), inner) * left_compiled(abs(dy), inner)
                    folded += left * _folded(dx, dy, level, turned, lines, sums, ux, uy, length, period)
            if folded > 0.0:
                own = 0.0
                for p in range(len(x)):
                    dx, dy = c - x[p], r - y[p]
                    left = left_compiled(abs(dx), inner) * left_compiled(abs(dy), inner)
                    own += left * _light(dx, dy, level, turned, lines, sums, ux, uy, length)
                stamp[r, c] *= own / (own + folded)


@jit
def left_compiled(distance: float, inner: float) -> Any:
    """Of the plane's light, pixels from its middle along one axis: a smooth step."""
    z = min(max((inner - distance) / _FADING, 0.0), 1.0)
    return z * z * (3.0 - 2.0 * z)


@jit
def _light(
    dx: float, dy: float, level: float, turned: Any, lines: Any, sums: Any, ux: float, uy: float, length: float
) -> Any:
    """What a star shines in a pixel at an offset; or a short trail of a length along (ux, uy), lines of its pixel."""
    square = dx * dx + dy * dy
    light = level / (square * np.sqrt(square))
    for b in range(len(turned)):
        if length > 0.0:
            light += _spike_of(turned, lines, sums, b, dx, dy, ux, uy, -0.5 * length, 0.5 * length, np.inf, 1.0 * WIDE)
        else:
            light += _on_spike(turned, lines, b, dx, dy)
    return light


@jit
def _folded(
    dx: float, dy: float, level: float, turned: Any, lines: Any, sums: Any, ux: float, uy: float, length: float,
    period: float,
) -> Any:  # fmt: skip
    """What of it the plane has that lies a period away; the pupil's soft edges had weakened that by sinc^2."""
    total = 0.0
    for up in range(-1, 2):
        for right in range(-1, 2):
            ax, ay = dx + right * period, dy + up * period
            square = ax * ax + ay * ay
            # From farther away than a period next to nothing has passed.
            if (up != 0 or right != 0) and square < period * period:
                passed = _passed(np.sqrt(square) / period)
                total += _light(ax, ay, level, turned, lines, sums, ux, uy, length) * passed
    return total / _passed(np.sqrt(dx * dx + dy * dy) / period)


@jit
def _passed(angle: float) -> Any:
    turn = np.pi * angle
    return (np.sin(turn) / turn) ** 2 if turn > 1e-6 else 1.0
