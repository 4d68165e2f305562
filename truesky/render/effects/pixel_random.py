"""Generate random numbers per pixel in compiled code, so that a change in one pixel affects no other pixel.

Each frame (array of pixels) has a random 64-bit key. A pixel derives its random bits from the key of the frame and from
the index of the pixel in the frame. The functions are called from compiled code of detector effects; a random number
takes a few ns.

References
----------
Steele, Lea & Flood 2014 (SplitMix64, which makes random bits). Marsaglia & Tsang 2000 (ziggurat, a method for normal
deviates). Doornik 2005 (separate bits for the layer of the ziggurat and the position in it).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from lake_schema.arrays import Float
from truesky.numerics.compiling import jit
from truesky.randomness.rng import GOLDEN, mix_bits
from truesky.render.camera.windows import DetectorPart

# Number of pixels for which `fill_normals` is called at once, so that its numbers stay in the cache of the processor.
BLOCK = 512
# Number of bits by which 64 random bits are shifted right, so that the remaining 53 fit into a float64.
_S11 = np.uint64(11)
# Mask of the 8 random bits that select one of the 256 layers of the ziggurat (a method for normal deviates).
_LAYER = np.uint64(255)
# Mask of the random bit that selects the sign of a normal deviate.
_SIGN = np.uint64(256)
# The ziggurat method covers the curve exp(-x^2 / 2), x > 0, with 256 layers of equal area (Doornik 2005). This is the
# position x at which the tail in the lowest layer begins.
_TAIL = 3.6541528853610088
# Area of each of the 256 layers with which the ziggurat method covers the curve exp(-x^2 / 2), x > 0 (Doornik 2005).
_AREA = 4.92867323399e-3


def draw_key(rng: np.random.Generator) -> np.uint64:
    """Draw the 64-bit key of a frame, from which all of its pixels derive their random bits."""
    return rng.integers(0, 2**64, dtype=np.uint64)


def split_key(key: np.uint64, part: DetectorPart) -> list[tuple[slice, np.uint64]]:
    """Return keys with which the pixels of a window have the random bits that they have in the frame of the detector.

    Parameters
    ----------
    key : uint64
        Key of the frame of the detector.
    part : DetectorPart
        Window and size of the detector.

    Returns
    -------
    list of (slice, uint64)
        Range of flat indices in the window, and the key for the indices that begin at 0 in this range.
    """
    window = part.window
    if window.nx == part.nx:
        # The rows of the window follow each other in the frame of the detector.
        ranges, first_pixels = [slice(None)], np.array([window.row * part.nx], np.uint64)
    else:
        ranges = [slice(row * window.nx, (row + 1) * window.nx) for row in range(window.ny)]
        rows = np.arange(window.row, window.row + window.ny, dtype=np.uint64)
        first_pixels = rows * np.uint64(part.nx) + np.uint64(window.column)
    # `pixel_bits` adds GOLDEN to the key for each pixel. The sum of arrays wraps around at 2^64 without a warning.
    return list(zip(ranges, np.array([key]) + first_pixels * GOLDEN, strict=True))


def _layers() -> Float:
    """Return the right end x of each layer of the ziggurat, float64[257], from the lowest layer to 0 at the top.

    The ziggurat covers the curve exp(-x^2 / 2), x > 0, with 256 horizontal layers of equal area. The lowest layer
    contains the tail of the curve. Its end is the width of a rectangle with the same area and height.
    """
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
    """Return 64 random bits (uint64) of a pixel, from the key of its frame (uint64) and its flat index in the frame."""
    return _mix_bits(frame_key + np.uint64(pixel) * GOLDEN)


@jit
def next_bits(bits: Any) -> Any:
    """Return the next 64 random bits (uint64) of a pixel, computed from its previous bits (uint64)."""
    return _mix_bits(bits + GOLDEN)


@jit
def uniform(bits: Any) -> Any:
    """Return a uniform number in (0, 1], a multiple of 2^-53, from 64 random bits (uint64)."""
    return (float(bits >> _S11) + 1.0) * 2.0**-53


@jit
def normal(bits: Any) -> Any:
    """Return a standard normal deviate from 64 random bits (uint64), by the ziggurat method.

    In about one of a hundred calls, further bits are derived from the given ones with `next_bits`.
    """
    while True:
        # Take the layer of the ziggurat (bits 0 to 7), the sign (bit 8) and the position in the layer (bits 11 to 63)
        # from different bits, so that they are independent.
        layer = np.int64(bits & _LAYER)
        part = float(bits >> _S11) * 2.0**-53
        x = part * _ENDS[layer]
        if part >= _INSIDE[layer]:
            sign = bits & _SIGN
            bits = next_bits(bits)
            if layer == 0:
                # Draw from the tail of the normal distribution with Marsaglia's exponential method.
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


@jit
def fill_normals(out: Any, bits: Any, frame_key: Any, first: int) -> None:
    """Fill an array with the standard normal deviates of successive pixels.

    Parameters
    ----------
    out : float64 array, shape (n,)
        Array for the deviates.
    bits : uint64 array, shape (n,) or longer
        Memory for random bits.
    frame_key : uint64
        Key of the frame.
    first : int
        Flat index of the first pixel in the frame.

    Notes
    -----
    The numbers equal the results of `normal` for the random bits of the pixels, and take half the time: a loop without
    branches draws 99 % of the numbers, and the other numbers are drawn again.
    """
    for i in range(len(out)):
        bits[i] = pixel_bits(frame_key, first + i)
    outside = 0
    for i in range(len(out)):
        layer, part = np.int64(bits[i] & _LAYER), np.float64(np.int64(bits[i] >> _S11)) * 2.0**-53
        x = part * _ENDS[layer]
        out[i] = -x if bits[i] & _SIGN else x
        outside += part >= _INSIDE[layer]
    if outside:
        for i in range(len(out)):
            layer, part = np.int64(bits[i] & _LAYER), np.float64(np.int64(bits[i] >> _S11)) * 2.0**-53
            if part >= _INSIDE[layer]:
                out[i] = normal(bits[i])
