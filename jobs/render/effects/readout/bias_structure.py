"""Structure of the bias: each amplifier's own offset, a settling of the first columns, stripes of columns."""

from __future__ import annotations

import numpy as np

from jobs.render.effects.effect import Effect
from jobs.render.effects.scene import Frame, Scene
from lake_schema.errors import OutOfRange


def apply(
    frame: Frame, offset: float, settling: float, length: float, stripes: float, rng: np.random.Generator
) -> Frame:
    """quadrants [q, ny, nx] e- in readout order -> plus `structure`, the same in every row."""
    shape = frame.reshape(-1, *frame.shape[-2:]).shape
    pattern = structure(shape[0], shape[2], offset, settling, length, stripes, rng)
    return np.asarray(frame + pattern.reshape(*frame.shape[:-2], 1, shape[2]))


def structure(
    quadrants: int, nx: int, offset: float, settling: float, length: float, stripes: float, rng: np.random.Generator
) -> Frame:
    """The pattern [quadrants, nx], e-.

    offset : rms between amplifiers, e-;  settling : of the first column, e-, falling off over `length` columns
    stripes : rms between columns, e-
    """
    for name, value, least in (
        ("bias offset", offset, 0.0), ("bias stripes", stripes, 0.0), ("bias settling length", length, 1e-3)
    ):  # fmt: skip
        if not least <= value < np.inf:
            raise OutOfRange(name, value, least, np.inf)
    own = offset * rng.standard_normal((quadrants, 1))
    settled = settling * np.exp(-np.arange(nx) / length)
    return np.asarray(own + settled + stripes * rng.standard_normal((quadrants, nx)))


def _parameters(scene: Scene) -> tuple[float, float, float, float]:
    gain = scene.value("gain", "electron / adu")
    offset, settling, stripes = (gain * scene.value(f"bias_{key}", "adu") for key in ("offset", "settling", "stripes"))
    return offset, settling, scene.value("bias_settling_length", "pix"), stripes


def _contribution(scene: Scene) -> float:
    offset, settling, _, stripes = _parameters(scene)
    return offset + abs(settling) + stripes


EFFECT = Effect("bias_structure", apply, _parameters, _contribution, fixed=True, cost=4e-3)
