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
_LEVELS_BELOW = 2
# Electrons above the notch that are no level of their own: the last of a trail fades to below single precision.
_MIN_THICKNESS = 1e-6
# With fewer there are no levels where most packets do not end.
MIN_LEVELS = 6
# Lines that are followed together.
_BLOCK = 256
# Pixels that are always full: numbers that fade to below single precision take the processor a hundred times longer.
_MIN_FULL = np.float32(1e-30)


def level_ends(frame: Float, notch: float, count: int) -> Float:
    """Ends of levels, electrons, ascending from the notch to the fullest packet of a frame, at least 1 e- above it.

    count   : of the levels
    returns : [count + 1], or fewer where ends would coincide, as in a frame of one brightness, or of none above it
    """
    flat = frame.reshape(-1)
    sample = flat[:: max(len(flat) // _SAMPLE, 1)]
    sample = sample[sample > notch]
    fullest = max(float(flat.max(initial=0.0)), notch + 1.0)
    low, high = np.quantile(sample, _USUAL) if len(sample) else (fullest, fullest)
    usual = max(count // 3, 1)
    steps = [
        np.linspace(notch, low, _LEVELS_BELOW, endpoint=False),
        np.quantile(sample, np.linspace(*_USUAL, usual + 1)) if len(sample) else np.array([fullest]),
        notch + np.geomspace(max(high - notch, 1e-6), fullest - notch, count - _LEVELS_BELOW - usual + 1),
    ]
    ends = np.unique(np.concatenate(steps))
    return ends[(ends <= notch) | (ends > notch + _MIN_THICKNESS)]


def shift(
    plane: Float, axis: int, pixels: int, density: Float, released: Float, ends: Float, volume: Float
) -> float:  # fmt: skip
    """Lines plane[:, k] (axis -2) or plane[k, :] (axis -1), in place, over the traps of `pixels` pixels.

    ends, volume : electrons and parts of a pixel's volume at the levels' ends
    plane             : [n, m] e-
    density, released : [species] traps a pixel, and the part of the full ones that is released in a step
    returns      : what is still trapped
    """
    is_present = density > 0.0
    silicon = pixels, density[is_present], released[is_present], ends, volume
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
    gain, captured = np.empty(_BLOCK), np.empty(_BLOCK)
    cloud, filled = np.empty(_BLOCK, np.float32), np.empty(_BLOCK, np.float32)
    # Traps that are full: of each level in pixels, of all in electrons.
    full, held_charge = np.empty((len(density), len(ends) - 1, _BLOCK), np.float32), np.empty((len(density), _BLOCK))
    trapped = 0.0
    for first in range(0, total, _BLOCK):
        m = min(_BLOCK, total - first)
        full[:], held_charge[:] = np.float32(0.0), 0.0
        for i in range(n):
            line, count = packets[i, first : first + m], min(i + 1, pixels)
            passed, inverse = np.float32(count), 1.0 / max(count, 1)
            gain[:], captured[:] = 0.0, 0.0
            for s in range(len(density)):
                species_charge = held_charge[s]
                for c in range(m):
                    emitted = released[s] * species_charge[c]
                    species_charge[c] -= emitted
                    gain[c] += emitted
            for c in range(m):
                cloud[c] = line[c] + gain[c] * inverse
            for s in range(len(density)):
                species_charge, retained = held_charge[s], np.float32(1.0 - released[s])
                filled[:] = np.float32(0.0)
                for k in range(len(ends) - 1):
                    slope, thick = np.float32(1.0 / (ends[k + 1] - ends[k])), np.float32(volume[k + 1] - volume[k])
                    _fill(cloud[:m], full[s, k], filled, np.float32(ends[k]), slope, thick, passed, retained)
                for c in range(m):
                    # Never more than the packet has.
                    new = min(density[s] * filled[c], line[c] + gain[c] - captured[c])
                    captured[c] += new
                    species_charge[c] += new
            for c in range(m):
                line[c] += gain[c] - captured[c]
        trapped += held_charge.sum()
    return trapped


@jit
def _fill(cloud: Any, full: Any, filled: Any, start: Any, slope: Any, thick: Any, passed: Any, retained: Any) -> None:
    """One level of one species: the packets `cloud`, what is full of it, in pixels, and what they fill, in volumes."""
    zero, unity = np.float32(0.0), np.float32(1.0)
    for c in range(len(cloud)):
        reached = min(max((cloud[c] - start) * slope, zero), unity)
        remaining = full[c] * retained + _MIN_FULL
        new = reached * (passed - remaining)
        full[c] = remaining + new
        filled[c] += thick * new
