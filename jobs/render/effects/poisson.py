"""Shot noise: expected electrons become whole electrons."""

from __future__ import annotations

import numpy as np

from jobs.render.effects.effect import Effect, Frame, Scene

# numpy draws Poisson numbers as int64; far below that a normal deviate is the same to 1e-5 of the noise.
_NORMAL_ABOVE = 1e9


def apply(frame: Frame, rng: np.random.Generator) -> Frame:
    """Expected e- [ny, nx] -> counted e-, whole; a negative expectation (a transform's ringing) is 0."""
    expected = np.maximum(frame, 0.0)
    huge = expected > _NORMAL_ABOVE
    counted = rng.poisson(np.where(huge, 0.0, expected)).astype(float)
    if huge.any():
        mean = expected[huge]
        counted[huge] = np.rint(mean + np.sqrt(mean) * rng.standard_normal(mean.size))
    return counted


def _contribution(scene: Scene) -> float:
    return float(np.sqrt(max(scene.peak_electrons, 0.0) + scene.sky_electrons))


EFFECT = Effect("poisson", apply, lambda scene: (), _contribution, cost=6e-2)
