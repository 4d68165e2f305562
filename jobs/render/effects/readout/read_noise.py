"""Read noise: the output amplifier adds a Gaussian to every pixel."""

from __future__ import annotations

from typing import Any

import numpy as np

from jobs.compiling import jit
from jobs.render.effects import pixel_random
from jobs.render.effects.effect import Effect, by_pixel, nothing
from jobs.render.effects.scene import Frame, Scene
from lake_schema.errors import OutOfRange


def apply(frame: Frame, sigma: float, rng: np.random.Generator) -> Frame:
    """frame [ny, nx] e- -> frame + N(0, sigma) e-."""
    if not 0.0 <= sigma < np.inf:
        raise OutOfRange("read noise", sigma, 0.0, np.inf)
    return by_pixel(_add, frame, sigma, pixel_random.key(rng))


@jit
def _add(frame: Any, out: Any, sigma: float, key: Any) -> None:
    for i in range(len(frame)):
        out[i] = frame[i] + sigma * pixel_random.normal(pixel_random.word(key, i))


def _sigma(scene: Scene) -> float:
    return scene.value("read_noise", "electron")


EFFECT = Effect("read_noise", apply, lambda scene: (_sigma(scene),), _sigma, cost=9e-3, repeated=nothing)
