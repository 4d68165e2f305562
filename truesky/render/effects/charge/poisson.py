"""Shot noise: expected electrons become whole electrons, each pixel by random numbers of its own."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from truesky.numerics.compiling import jit
from truesky.render.effects import pixel_random
from truesky.render.effects.effect import Effect, map_pixels, zero_contribution
from truesky.render.effects.scene import Frame, Scene

# Below this the sum of the probabilities is followed, above it the law is inverted by its asymptotic series.
_EXACT_BELOW = 10.0


def apply(frame: Frame, rng: np.random.Generator) -> Frame:
    """Expected e- [..] -> counted e-, whole; a negative expectation (a transform's ringing) is 0.

    Error : of the probability of a count: 6e-4 of it at an expectation of 10, 2e-5 at 100
    Ref   : Giles 2016, ACM Trans. Math. Softw. 42, 7: the inverse of Poisson's law to second order in its width
    """
    return map_pixels(_draw_counts, frame, pixel_random.draw_key(rng))


@jit
def _draw_counts(means: Any, counts: Any, key: Any) -> None:
    for i in range(len(means)):
        mean = max(means[i], 0.0)
        p_zero = math.exp(-mean) if mean < _EXACT_BELOW else 0.0
        counts[i] = draw_count(mean, p_zero, pixel_random.pixel_bits(key, i))


@jit
def draw_count(mean: float, p_zero: float, bits: Any) -> Any:
    """A count of an expectation >= 0, by a pixel's random bits; none : exp(-mean) where that is below 10."""
    if mean < _EXACT_BELOW:
        u, term, count = pixel_random.uniform(bits), p_zero, 0.0
        while u > term and count < 200.0:
            u -= term
            count += 1.0
            term *= mean / count
        return count
    w, root = pixel_random.normal(bits), math.sqrt(mean)
    square, inverse = w * w, 1.0 / root
    third = inverse * (-8.0 / 405.0 + square * (7.0 / 810.0 + square / 270.0))
    second = inverse * (w * (-1.0 / 36.0 - square / 72.0) + third)
    return max(np.floor(mean + root * w + (1.0 / 3.0 + square / 6.0) + second), 0.0)


def _contribution(scene: Scene) -> float:
    return float(np.sqrt(max(scene.peak_electrons, 0.0) + scene.sky_electrons))


EFFECT = Effect("poisson", apply, lambda scene: (), _contribution, cost=1.1e-2, systematic=zero_contribution)
