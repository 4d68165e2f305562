"""Generate random numbers per pixel in compiled code, so that a change in one pixel affects no other pixel.

Each pixel derives its random bits from the key of the frame and from its index. The functions are called from compiled
code of effects; a number takes a few ns.

References
----------
Steele, Lea & Flood 2014 (SplitMix64). Marsaglia & Tsang 2000 (ziggurat). Doornik 2005 (separate bits for layer and
position).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from lake_schema.arrays import Float
from truesky.numerics.compiling import jit
from truesky.randomness.rng import GOLDEN, mix_bits

_S11, _LAYER, _SIGN = np.uint64(11), np.uint64(255), np.uint64(256)
# For 256 layers of equal area under exp(-x^2 / 2): start of the tail, and area of a layer (Doornik 2005).
_TAIL, _AREA = 3.6541528853610088, 4.92867323399e-3


def draw_key(rng: np.random.Generator) -> np.uint64:
    """Draw the key of a frame, from which all its pixels derive their random bits."""
    return rng.integers(0, 2**64, dtype=np.uint64)


def _layers() -> Float:
    """Right ends of the layers from the lowest, which includes the tail, to 0."""
    ends = [_AREA * math.exp(0.5 * _TAIL**2), _TAIL]
    while len(ends) < 256:
        ends.append(math.sqrt(-2.0 * math.log(_AREA / ends[-1] + math.exp(-0.5 * ends[-1] ** 2))))
    return np.array([*ends, 0.0])


_ENDS = _layers()
_INSIDE = _ENDS[1:] / _ENDS[:-1]
_HEIGHTS = np.exp(-0.5 * _ENDS**2)


_mix_bits = jit(mix_bits)


@jit
def pixel_bits(frame_key: Any, pixel: int) -> Any:
    """Return 64 random bits (uint64) of a pixel, by the key of its frame (uint64) and its index in the frame."""
    return _mix_bits(frame_key + np.uint64(pixel) * GOLDEN)


@jit
def next_bits(bits: Any) -> Any:
    """Return the next 64 random bits of a pixel, from its previous bits."""
    return _mix_bits(bits + GOLDEN)


@jit
def uniform(bits: Any) -> Any:
    """Return a uniform number in (0, 1], a multiple of 2^-53, from random bits."""
    return (float(bits >> _S11) + 1.0) * 2.0**-53


@jit
def normal(bits: Any) -> Any:
    """Return a standard normal deviate from random bits.

    In one case of a hundred the ziggurat method uses further bits.
    """
    while True:
        # Layer, sign and position use different bits.
        layer = np.int64(bits & _LAYER)
        part = float(bits >> _S11) * 2.0**-53
        x = part * _ENDS[layer]
        if part >= _INSIDE[layer]:
            sign = bits & _SIGN
            bits = next_bits(bits)
            if layer == 0:
                # The tail is drawn with Marsaglia's exponential method.
                x = -math.log(uniform(bits)) / _TAIL
                bits = next_bits(bits)
                y = -2.0 * math.log(uniform(bits))
                while y < x * x:
                    bits = next_bits(bits)
                    x = -math.log(uniform(bits)) / _TAIL
                    bits = next_bits(bits)
                    y = -2.0 * math.log(uniform(bits))
                return -_TAIL - x if sign else _TAIL + x
            low, high = _HEIGHTS[layer], _HEIGHTS[layer + 1]
            if low + uniform(bits) * (high - low) >= math.exp(-0.5 * x * x):
                bits = next_bits(bits)
                continue
            return -x if sign else x
        return -x if bits & _SIGN else x
