"""Read noise: the output amplifier adds a Gaussian to every pixel."""

from __future__ import annotations

import numpy as np

from jobs.render.effects.effect import Effect, Frame, Scene
from lake_schema.errors import OutOfRange


def apply(frame: Frame, sigma: float, rng: np.random.Generator) -> Frame:
    """frame [ny, nx] e- -> frame + N(0, sigma) e-."""
    if not 0.0 <= sigma < np.inf:
        raise OutOfRange("read noise", sigma, 0.0, np.inf)
    noise = rng.standard_normal(frame.shape)
    noise *= sigma
    noise += frame
    return noise


def _sigma(scene: Scene) -> float:
    return scene.value("read_noise", "electron")


EFFECT = Effect("read_noise", apply, lambda scene: (_sigma(scene),), _sigma, cost=2e-2)
