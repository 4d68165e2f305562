"""Charge injection: blocks of rows filled electronically, to see how traps take charge and give it back.

apply, EFFECT        the charge: each column takes its own share, the same in every exposure
apply_noise, NOISE   what differs from row to row and from exposure to exposure
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lake_schema.errors import OutOfRange
from truesky.render.effects.effect import Effect, nothing
from truesky.render.effects.scene import Frame, Scene


def apply(frame: Frame, level: float, on: int, off: int, spread: float, rng: np.random.Generator) -> Frame:
    """frame [ny, nx] e- -> plus whole electrons in every block of `on` rows after `off` rows, from both registers.

    level : e-;  spread : rms between columns, of the level
    rng   : random numbers of the columns
    """
    for name, value in (("charge injection", level), ("injection spread", spread)):
        if not 0.0 <= value <= 1e9:
            raise OutOfRange(name, value, 0.0, 1e9)
    out = np.array(frame, dtype=float)
    columns = level * np.maximum(1.0 + spread * rng.standard_normal(out.shape[1]), 0.0)
    out[_rows(len(out), on, off)] += np.rint(columns)
    return out


def apply_noise(frame: Frame, on: int, off: int, noise: float, rng: np.random.Generator) -> Frame:
    """frame [ny, nx] e- >= 0 -> less or more by whole electrons in those rows, never below 0.

    noise : rms of a pixel, e-
    on, off : rows of a block, and before it;  rng : random numbers of the pixels
    """
    if not 0.0 <= noise <= 1e9:
        raise OutOfRange("injection noise", noise, 0.0, 1e9)
    out, rows = np.array(frame, dtype=float), _rows(len(frame), on, off)
    out[rows] = np.maximum(out[rows] + np.rint(noise * rng.standard_normal((len(rows), out.shape[1]))), 0.0)
    return out


def _rows(ny: int, on: int, off: int) -> npt.NDArray[np.intp]:
    """Those that are filled."""
    for name, count, least in (("injected rows", on, 1), ("rows between injections", off, 0)):
        if not least <= count <= 1_000_000:
            raise OutOfRange(name, count, least, 1_000_000)
    # Rows from the register that reads them.
    distance = np.minimum(np.arange(ny), ny - 1 - np.arange(ny))
    return np.flatnonzero(distance % (on + off) >= off)


def _parameters(scene: Scene) -> tuple[float, int, int, float]:
    return scene.value("injection.level", "electron"), *_blocks(scene), scene.value("injection.spread", "")


def _blocks(scene: Scene) -> tuple[int, int]:
    return int(scene.value("injection.on", "pix")), int(scene.value("injection.off", "pix"))


def _noise(scene: Scene) -> float:
    """Nothing varies where nothing is injected."""
    return scene.value("injection.noise", "electron") * (EFFECT.applied(scene) and _parameters(scene)[0] > 0.0)


EFFECT = Effect("charge_injection", apply, _parameters, lambda scene: _parameters(scene)[0], fixed=True, cost=6e-3)
NOISE = Effect(
    "injection_noise",
    apply_noise,
    lambda scene: (*_blocks(scene), _noise(scene)),
    _noise,
    cost=1.5e-2,
    repeated=nothing,
)
