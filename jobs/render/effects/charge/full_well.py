"""Full well: a pixel holds no more than its capacity (the excess is lost: ground cameras; in VIS it bleeds)."""

from __future__ import annotations

import numpy as np

from jobs.render.effects.effect import Effect
from jobs.render.effects.scene import Frame, Scene
from lake_schema.errors import OutOfRange


def apply(frame: Frame, capacity: float, rng: np.random.Generator | None = None) -> Frame:
    """frame [ny, nx] e- -> clipped at `capacity` e-."""
    if not 0.0 < capacity < np.inf:
        raise OutOfRange("full well", capacity, 0.0, np.inf)
    return np.minimum(frame, capacity)


def capacity(scene: Scene) -> float:
    """Electrons."""
    return scene.value("full_well", "electron")


def contribution(scene: Scene) -> float:
    """What the brightest pixel has too many."""
    return max(scene.brightest_electrons - capacity(scene), 0.0)


EFFECT = Effect("full_well", apply, lambda scene: (capacity(scene),), contribution, cost=3e-3)
