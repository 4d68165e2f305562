"""Charge traps, followed roughly: all lines at once, with the traps of a pixel in a few levels of height.

As traps.py does it in one sweep, but in place of the watermarks that clouds leave a level only knows how full it is:
a cloud that ends within one fills that part of all its traps. Most levels lie where most packets end. A tenth of the
time, and an error in proportion to the damage: for young detectors.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lake_schema.arrays import Float
from truesky.numerics.compiling import jit

# Packets that are looked at to place the levels; between these quantiles of them lie a third of the levels.
_SAMPLE, _USUAL = 100_000, (0.002, 0.99)
# Levels below those.
_BELOW = 2
# Electrons above the notch that are no level of their own: the last of a trail fades to below single precision.
_THINNEST = 1e-6
# With fewer there are no levels where most packets do not end.
FEWEST = 6
# Lines that are followed together.
_BLOCK = 256
# Pixels that are always full: numbers that fade to below single precision take the processor a hundred times longer.
_LEAST = np.float32(1e-30)


def heights(frame: Float, notch: float, count: int) -> Float:
    """Ends of levels, electrons, ascending from the notch to the fullest packet of a frame, at least 1 e- above it.

    count   : of the levels
    returns : [count + 1], or fewer where ends would coincide, as in a frame of one brightness, or of none above it
    """
    flat = frame.reshape(-1)
    some = flat[:: max(len(flat) // _SAMPLE, 1)]
    some = some[some > notch]
    most = max(float(flat.max(initial=0.0)), notch + 1.0)
    low, high = np.quantile(some, _USUAL) if len(some) else (most, most)
    usual = max(count // 3, 1)
    steps = [
        np.linspace(notch, low, _BELOW, endpoint=False),
        np.quantile(some, np.linspace(*_USUAL, usual + 1)) if len(some) else np.array([most]),
        notch + np.geomspace(max(high - notch, 1e-6), most - notch, count - _BELOW - usual + 1),
    ]
    ends = np.unique(np.concatenate(steps))
    return ends[(ends <= notch) | (ends > notch + _THINNEST)]


def shift(
    plane: Float, axis: int, pixels: int, density: Float, released: Float, ends: Float, volume: Float
) -> float:  # fmt: skip
    """Lines plane[:, k] (axis -2) or plane[k, :] (axis -1), in place, over the traps of `pixels` pixels.

    ends, volume : electrons and parts of a pixel's volume at the levels' ends
    plane             : [n, m] e-
    density, released : [species] traps a pixel, and the part of the full ones that is released in a step
    returns      : what is still trapped
    """
    some = density > 0.0
    silicon = pixels, density[some], released[some], ends, volume
    if axis == -2:
        return float(_follow(plane, *silicon))
    trapped = 0.0
    for start in range(0, len(plane), _BLOCK):
        packets = np.array(plane[start : start + _BLOCK].T, order="C")
        trapped += _follow(packets, *silicon)
        plane[start : start + _BLOCK] = packets.T
    return trapped


@jit
def _follow(packets: Float, pixels: int, density: Float, released: Float, ends: Float, volume: Float) -> float:
    """Lines packets[:, k]."""
    n, total = packets.shape
    gain, taken = np.empty(_BLOCK), np.empty(_BLOCK)
    cloud, part = np.empty(_BLOCK, np.float32), np.empty(_BLOCK, np.float32)
    # Traps that are full: of each level in pixels, of all in electrons.
    full, held = np.empty((len(density), len(ends) - 1, _BLOCK), np.float32), np.empty((len(density), _BLOCK))
    trapped = 0.0
    for first in range(0, total, _BLOCK):
        m = min(_BLOCK, total - first)
        full[:], held[:] = np.float32(0.0), 0.0
        for i in range(n):
            line, count = packets[i, first : first + m], min(i + 1, pixels)
            passed, inverse = np.float32(count), 1.0 / max(count, 1)
            gain[:], taken[:] = 0.0, 0.0
            for s in range(len(density)):
                own = held[s]
                for c in range(m):
                    back = released[s] * own[c]
                    own[c] -= back
                    gain[c] += back
            for c in range(m):
                cloud[c] = line[c] + gain[c] * inverse
            for s in range(len(density)):
                own, left = held[s], np.float32(1.0 - released[s])
                part[:] = np.float32(0.0)
                for k in range(len(ends) - 1):
                    slope, thick = np.float32(1.0 / (ends[k + 1] - ends[k])), np.float32(volume[k + 1] - volume[k])
                    _fill(cloud[:m], full[s, k], part, np.float32(ends[k]), slope, thick, passed, left)
                for c in range(m):
                    # Never more than the packet has.
                    new = min(density[s] * part[c], line[c] + gain[c] - taken[c])
                    taken[c] += new
                    own[c] += new
            for c in range(m):
                line[c] += gain[c] - taken[c]
        trapped += held.sum()
    return trapped


@jit
def _fill(cloud: Any, full: Any, part: Any, start: Any, slope: Any, thick: Any, passed: Any, left: Any) -> None:
    """One level of one species: the packets `cloud`, what is full of it, in pixels, and what they fill, in volumes."""
    none, one = np.float32(0.0), np.float32(1.0)
    for c in range(len(cloud)):
        reached = min(max((cloud[c] - start) * slope, none), one)
        before = full[c] * left + _LEAST
        new = reached * (passed - before)
        full[c] = before + new
        part[c] += thick * new
