"""Charge injection: blocks of rows filled electronically, to see how traps take charge and give it back."""

from __future__ import annotations

import numpy as np

from jobs.render.effects.effect import Effect, Frame, Scene
from lake_schema.errors import OutOfRange


def apply(
    frame: Frame, level: float, on: int, off: int, spread: float, noise: float, rng: np.random.Generator
) -> Frame:
    """frame [ny, nx] e- -> plus whole electrons in every block of `on` rows after `off` rows, from both registers.

    level : e-;  spread : rms between columns, of the level;  noise : rms of a pixel, e-
    """
    for name, value in (("charge injection", level), ("injection spread", spread), ("injection noise", noise)):
        if not 0.0 <= value <= 1e9:
            raise OutOfRange(name, value, 0.0, 1e9)
    for name, count, least in (("injected rows", on, 1), ("rows between injections", off, 0)):
        if not least <= count <= 1_000_000:
            raise OutOfRange(name, count, least, 1_000_000)
    ny, nx = frame.shape
    # Rows from the register that reads them.
    distance = np.minimum(np.arange(ny), ny - 1 - np.arange(ny))
    rows = np.flatnonzero(distance % (on + off) >= off)
    columns = level * np.maximum(1.0 + spread * rng.standard_normal(nx), 0.0)
    out = np.array(frame, dtype=float)
    if level:
        out[rows] += np.rint(np.maximum(columns + noise * rng.standard_normal((len(rows), nx)), 0.0))
    return out


def _parameters(scene: Scene) -> tuple[float, int, int, float, float]:
    return (
        scene.value("injection.level", "electron"),
        int(scene.value("injection.on", "pix")),
        int(scene.value("injection.off", "pix")),
        scene.value("injection.spread", ""),
        scene.value("injection.noise", "electron"),
    )


def _contribution(scene: Scene) -> float:
    level, *_, noise = _parameters(scene)
    return (level + noise) * (level > 0.0)


EFFECT = Effect("charge_injection", apply, _parameters, _contribution, cost=2e-2)
