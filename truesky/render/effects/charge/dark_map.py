"""Dark current as it is expected of each pixel: it differs from pixel to pixel, and hot pixels have many times as much.

What is expected here is counted up the ramp, with the light.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lake_schema.errors import OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.effects import pixel_random
from truesky.render.effects.effect import Effect, by_pixel
from truesky.render.effects.scene import Frame, Scene

# A hot pixel of a warm detector: more would make no difference to any well.
_OVERFLOWING = 1e11


def apply(
    frame: Frame, electrons: float, spread: float, hot: float, hot_electrons: float, rng: np.random.Generator
) -> Frame:
    """Expected e- [ny, nx] -> plus the dark current's.

    frame         : expected e-
    electrons     : mean of all pixels but the hot ones;  spread : rms of its natural logarithm from pixel to pixel
    hot           : fraction of the pixels;  hot_electrons : mean of what they have more, exponentially distributed
    rng           : random numbers of the detector's pixels
    """
    for name, value, most in (
        ("dark electrons", electrons, 1e12), ("spread of the dark current", spread, 3.0),
        ("hot pixels", hot, 1.0), ("hot electrons", hot_electrons, 1e12),
    ):  # fmt: skip
        if not 0.0 <= value <= most:
            raise OutOfRange(name, value, 0.0, most)
    # The mean of exp(s z) is exp(s^2 / 2).
    out = by_pixel(_add, frame, electrons * np.exp(-0.5 * spread**2), spread, pixel_random.key(rng))
    count = int(rng.binomial(out.size, hot))
    where = rng.integers(0, max(out.size, 1), count)
    np.add.at(out.reshape(-1), where, hot_electrons * rng.standard_exponential(count))
    return out


@jit
def _add(frame: Any, out: Any, electrons: float, spread: float, key: Any) -> None:
    for i in range(len(frame)):
        out[i] = frame[i] + electrons * np.exp(spread * pixel_random.normal(pixel_random.word(key, i)))


def _parameters(scene: Scene) -> tuple[float, float, float, float]:
    rate = scene.value("hot_current", "electron / (s pix)") * scene.dark_current_scaling
    hot = min(rate * scene.exposure_time_s, _OVERFLOWING)
    return scene.dark_electrons, scene.value("dark_spread", ""), scene.value("hot_pixels", ""), hot


def _contribution(scene: Scene) -> float:
    electrons, _, hot, hot_electrons = _parameters(scene)
    return electrons + hot_electrons * (hot > 0.0)


EFFECT = Effect("dark_map", apply, _parameters, _contribution, fixed=True, cost=1e-2)
