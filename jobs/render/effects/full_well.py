"""Full well: a pixel holds no more than its capacity (the excess is lost; nothing bleeds yet)."""

from __future__ import annotations

import numpy as np

from jobs.render.effects.effect import Effect, Frame, Scene
from lake_schema.errors import OutOfRange


def apply(frame: Frame, capacity: float, rng: np.random.Generator | None = None) -> Frame:
    """frame [ny, nx] e- -> clipped at `capacity` e-."""
    if not 0.0 < capacity < np.inf:
        raise OutOfRange("full well", capacity, 0.0, np.inf)
    return np.minimum(frame, capacity)


def _capacity(scene: Scene) -> float:
    return scene.value("full_well", "electron")


def _contribution(scene: Scene) -> float:
    return max(scene.peak_electrons + scene.sky_electrons - _capacity(scene), 0.0)


EFFECT = Effect("full_well", apply, lambda scene: (_capacity(scene),), _contribution, cost=3e-3)
