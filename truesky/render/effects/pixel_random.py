"""Random numbers per pixel: each has its own, so that what changes in one pixel changes no other.

key         of a frame's random numbers, from an effect's generator
word        64 random bits of a pixel
next_word   the next 64 of the same pixel
uniform     in (0, 1] of a word
normal      standard normal deviate of a word

Compiled; they are called from effects' kernels. A number takes a few ns.

Ref : Steele, Lea & Flood 2014 (SplitMix64); Marsaglia & Tsang 2000 (ziggurat), with the bits apart as in Doornik 2005
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from lake_schema.arrays import Float
from truesky.numerics.compiling import jit
from truesky.randomness.rng import GOLDEN, mix_bits

_S11, _LAYER, _SIGN = np.uint64(11), np.uint64(255), np.uint64(256)
# Of 256 layers of equal area under exp(-x^2 / 2): where the tail begins, and the area (Doornik 2005).
_TAIL, _AREA = 3.6541528853610088, 4.92867323399e-3


def draw_key(rng: np.random.Generator) -> np.uint64:
    """What a frame's random numbers count on from."""
    return rng.integers(0, 2**64, dtype=np.uint64)


def _layers() -> Float:
    """Right ends of the layers, from the lowest, whose end stands for its tail, to 0."""
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
    """64 random bits, uint64, of a pixel of the frame that has the key (uint64); pixel : its number in the frame."""
    return _mix_bits(frame_key + np.uint64(pixel) * GOLDEN)


@jit
def next_bits(bits: Any) -> Any:
    """64 more, where a pixel wants more than one number; before : its last ones."""
    return _mix_bits(bits + GOLDEN)


@jit
def uniform(bits: Any) -> Any:
    """Uniform in (0, 1], a multiple of 2^-53; bits : of `word` or `next_word`."""
    return (float(bits >> _S11) + 1.0) * 2.0**-53


@jit
def normal(bits: Any) -> Any:
    """Standard normal deviate; bits : of `word` or `next_word`. Of one in a hundred the ziggurat draws more."""
    while True:
        # Layer, sign and place are of different bits.
        layer = np.int64(bits & _LAYER)
        part = float(bits >> _S11) * 2.0**-53
        x = part * _ENDS[layer]
        if part >= _INSIDE[layer]:
            sign = bits & _SIGN
            bits = next_bits(bits)
            if layer == 0:
                # Beyond the last layer: Marsaglia's exponential tail.
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
