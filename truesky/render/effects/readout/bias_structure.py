"""Structure of the bias: each amplifier's own offset, a settling of the first columns, stripes of columns."""

from __future__ import annotations

import numpy as np

from lake_schema.arrays import Float
from lake_schema.errors import OutOfRange
from truesky.render.effects.effect import Effect
from truesky.render.effects.scene import Frame, Scene

Number = float | Float


def apply(
    frame: Frame, offset: Number, settling: Number, length: Number, stripes: Number, rng: np.random.Generator
) -> Frame:
    """quadrants [q, ny, nx] e- in readout order -> plus `structure`, the same in every row.

    frame, rng                        : e-, and random numbers of the detector
    offset, settling, length, stripes : as of `structure`
    """
    shape = frame.reshape(-1, *frame.shape[-2:]).shape
    pattern = structure(shape[0], shape[2], offset, settling, length, stripes, rng)
    return np.asarray(frame + pattern.reshape(*frame.shape[:-2], 1, shape[2]))


def structure(
    quadrants: int, nx: int, offset: Number, settling: Number, length: Number, stripes: Number, rng: np.random.Generator
) -> Frame:
    """The pattern [quadrants, nx], e-; each number may be [quadrants].

    offset : rms between amplifiers, e-;  settling : of the first column, e-, falling off over `length` columns
    stripes : rms between columns, e-
    quadrants, nx : amplifiers, and columns of each;  rng : random numbers of the detector
    """
    for name, value, lowest in (
        ("bias offset", offset, 0.0), ("bias stripes", stripes, 0.0), ("bias settling length", length, 1e-3)
    ):  # fmt: skip
        if not (np.min(value) >= lowest and np.max(value) < np.inf):
            raise OutOfRange(name, value, lowest, np.inf)
    offset, settling, length, stripes = (np.reshape(number, (-1, 1)) for number in (offset, settling, length, stripes))
    offsets = offset * rng.standard_normal((quadrants, 1))
    settled = settling * np.exp(-np.arange(nx) / length)
    return np.asarray(offsets + settled + stripes * rng.standard_normal((quadrants, nx)))


def _parameters(scene: Scene) -> tuple[Number, Number, Number, Number]:
    gain = scene.amplifier_values("gain", "electron / adu")
    offset, settling, stripes = (
        gain * scene.amplifier_values(f"bias_{key}", "adu") for key in ("offset", "settling", "stripes")
    )
    return offset, settling, scene.amplifier_values("bias_settling_length", "pix"), stripes


def _contribution(scene: Scene) -> float:
    offset, settling, _, stripes = _parameters(scene)
    return float(np.max(offset + np.abs(settling) + stripes))


EFFECT = Effect("bias_structure", apply, _parameters, _contribution, fixed=True, cost=4e-3)
