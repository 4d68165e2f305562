"""Dark current: thermal electrons, counted."""

from __future__ import annotations

import numpy as np

from jobs.render.effects.effect import Effect, Frame
from lake_schema.errors import OutOfRange


def apply(frame: Frame, electrons: float, rng: np.random.Generator) -> Frame:
    """frame [ny, nx] e- -> frame + Poisson(electrons) in every pixel."""
    if not 0.0 <= electrons < np.inf:
        raise OutOfRange("dark electrons", electrons, 0.0, np.inf)
    return frame + rng.poisson(electrons, frame.shape)


EFFECT = Effect("dark_current", apply, lambda scene: (scene.dark_electrons,), lambda scene: scene.dark_electrons)
