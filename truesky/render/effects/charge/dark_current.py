"""Dark current: thermal electrons, counted; and hot pixels, that have many."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from lake_schema.errors import OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.effects import pixel_random
from truesky.render.effects.charge import poisson
from truesky.render.effects.effect import Effect, map_pixels
from truesky.render.effects.scene import Frame, Scene

# Electrons of a hot pixel in a warm detector: many times what any well holds, so that more makes no difference.
_MAX_HOT_ELECTRONS = 1e11
# Means below this are counted in runs of so many pixels, to counts of which a pixel has no more with this certainty.
_BLOCKWISE_BELOW, _BLOCK, _CERTAIN = 2.0, 512, 1.0 - 2e-16


def apply(frame: Frame, electrons: float, rng: np.random.Generator) -> Frame:
    """frame [ny, nx] e- -> frame + Poisson(electrons) in every pixel."""
    if not 0.0 <= electrons < np.inf:
        raise OutOfRange("dark electrons", electrons, 0.0, np.inf)
    return map_pixels(_add_counts, frame, electrons, pixel_random.draw_key(rng))


@jit
def _add_counts(frame: Any, out: Any, mean: float, key: Any) -> None:
    p_zero = math.exp(-mean)
    if mean >= _BLOCKWISE_BELOW:
        for i in range(len(frame)):
            out[i] = frame[i] + poisson.draw_count(mean, p_zero, pixel_random.pixel_bits(key, i))
        return
    # Few electrons: of each count, all pixels of a run together.
    u = np.empty(_BLOCK)
    for first in range(0, len(frame), _BLOCK):
        block, block_before = out[first : first + _BLOCK], frame[first : first + _BLOCK]
        for j in range(len(block)):
            u[j], block[j] = pixel_random.uniform(pixel_random.pixel_bits(key, first + j)), block_before[j]
        term, cumulative, count = p_zero, p_zero, 0.0
        while cumulative < _CERTAIN and term > 0.0:
            for j in range(len(block)):
                block[j] += 1.0 if u[j] > cumulative else 0.0
            count += 1.0
            term *= mean / count
            cumulative += term


def apply_hot(frame: Frame, fraction: float, electrons: float, rng: np.random.Generator) -> Frame:
    """frame [ny, nx] e- -> plus whole electrons in hot pixels.

    fraction  : of the pixels;  electrons : mean of a hot pixel, exponentially distributed
    rng       : random numbers of the detector's pixels
    Error     : the count of a hot pixel has no noise of its own from exposure to exposure
    """
    if not 0.0 <= fraction <= 1.0:
        raise OutOfRange("hot pixels", fraction, 0.0, 1.0)
    if not 0.0 <= electrons < 1e12:
        raise OutOfRange("hot electrons", electrons, 0.0, 1e12)
    out = np.array(frame, dtype=float)
    count = int(rng.binomial(out.size, fraction))
    hot_pixels = rng.integers(0, max(out.size, 1), count)
    np.add.at(out.reshape(-1), hot_pixels, np.rint(electrons * rng.standard_exponential(count)))
    return out


def _hot_parameters(scene: Scene) -> tuple[float, float]:
    rate = scene.value("hot_current", "electron / (s pix)") * scene.dark_current_scaling
    return scene.value("hot_pixels", ""), min(rate * scene.exposure_time_s, _MAX_HOT_ELECTRONS)


def _contribution(scene: Scene) -> float:
    """Of what it adds: its mean, and its own shot noise."""
    return float(np.sqrt(scene.dark_electrons * (1.0 + scene.dark_electrons)))


EFFECT = Effect(
    "dark_current",
    apply,
    lambda scene: (scene.dark_electrons,),
    _contribution,
    cost=2e-3,
    systematic=lambda scene: scene.dark_electrons,
)
HOT = Effect(
    "hot_pixels",
    apply_hot,
    _hot_parameters,
    lambda scene: _hot_parameters(scene)[1] * (_hot_parameters(scene)[0] > 0),
    fixed=True,
    cost=2e-3,
)
