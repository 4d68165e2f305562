"""Photon shot noise: draw whole electrons from the expected electrons of each pixel."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from truesky.numerics.compiling import jit
from truesky.render.effects import pixel_random
from truesky.render.effects.effect import Effect, map_pixels, zero_contribution
from truesky.render.effects.scene import Frame, Scene

# For means below this number the cumulative probabilities are summed exactly. Above it an asymptotic series is used.
_EXACT_BELOW = 10.0


def apply(frame: Frame, rng: np.random.Generator, out: Frame | None = None) -> Frame:
    """Draw a random count of electrons for each pixel from a Poisson distribution.

    Parameters
    ----------
    frame : float array, any shape
        Expected electrons. Negative values, which ringing of Fourier transforms causes, are treated as 0.
    rng : numpy.random.Generator
        Random generator from which one 64-bit key is drawn. Each pixel derives its random number from the key and its
        index.
    out : float64 array, shape of `frame`, optional
        Array for the result, which may be `frame` itself. By default a new array.

    Returns
    -------
    float array, shape of `frame`
        Electrons, whole numbers.

    Notes
    -----
    Counts are found by inverting the cumulative distribution: exactly for means below 10, and otherwise by an
    expansion in 1 / sqrt(mean) [1]_. The relative error of the probability of a count is
    6e-4 at a mean of 10 and 2e-5 at a mean of 100.

    References
    ----------
    .. [1] Giles 2016, ACM Trans. Math. Softw. 42, 7: the inverse Poisson distribution to second order in its width.
    """
    return map_pixels(_draw_counts, frame, pixel_random.draw_key(rng), out=out)


@jit
def _draw_counts(pixels: Any, key: Any) -> None:
    """Replace expected electrons by random counts, in place. `key` is the random key of the frame."""
    normals, bits = np.empty(pixel_random.BLOCK), np.empty(pixel_random.BLOCK, np.uint64)
    for first in range(0, len(pixels), pixel_random.BLOCK):
        block = pixels[first : first + pixel_random.BLOCK]
        if block.min() >= _EXACT_BELOW:
            deviates = normals[: len(block)]
            pixel_random.fill_normals(deviates, bits, key, first)
            for i in range(len(block)):
                block[i] = _count_from_normal(block[i], deviates[i])
        else:
            for i in range(len(block)):
                mean = max(block[i], 0.0)
                p_zero = math.exp(-mean) if mean < _EXACT_BELOW else 0.0
                block[i] = draw_count(mean, p_zero, pixel_random.pixel_bits(key, first + i))


@jit
def draw_count(mean: float, p_zero: float, bits: Any) -> Any:
    """Draw a count from a Poisson distribution with given random bits.

    Parameters
    ----------
    mean : float
        Expected count, 0 or more.
    p_zero : float
        exp(-mean), which the caller computes once for many pixels. It is used only if `mean` < 10.
    bits : uint64
        Random bits of the pixel.

    Returns
    -------
    float
        The count, a whole number. For `mean` < 10 it is at most 200.
    """
    if mean < _EXACT_BELOW:
        u, term, count = pixel_random.uniform(bits), p_zero, 0.0
        while u > term and count < 200.0:
            u -= term
            count += 1.0
            term *= mean / count
        return count
    return _count_from_normal(mean, pixel_random.normal(bits))


@jit
def _count_from_normal(mean: float, w: float) -> Any:
    """Return the count of a Poisson distribution with a mean of 10 or more at the quantile of a normal deviate `w`."""
    root = math.sqrt(mean)
    square, inverse = w * w, 1.0 / root
    third = inverse * (-8.0 / 405.0 + square * (7.0 / 810.0 + square / 270.0))
    second = inverse * (w * (-1.0 / 36.0 - square / 72.0) + third)
    return max(np.floor(mean + root * w + (1.0 / 3.0 + square / 6.0) + second), 0.0)


def _contribution(scene: Scene) -> float:
    return float(np.sqrt(max(scene.peak_electrons, 0.0) + scene.sky_electrons))


EFFECT = Effect(
    "poisson", apply, lambda scene: (), _contribution, cost=1.1e-2, systematic=zero_contribution, in_place=True
)
