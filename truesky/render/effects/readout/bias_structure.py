"""Structure of the bias level: offsets of amplifiers, settling in the first columns, and stripes along columns.

Settling is an additional offset that decays exponentially from the first column that is read. Stripes are random
offsets of single columns. The whole pattern is the same in every row and in every exposure.
"""

from __future__ import annotations

import numpy as np

from lake_schema.arrays import Float
from lake_schema.errors import OutOfRange
from truesky.render.effects.effect import Effect
from truesky.render.effects.scene import Frame, Scene

Number = float | Float


def apply(
    frame: Frame,
    offset: Number,
    settling: Number,
    length: Number,
    stripes: Number,
    rng: np.random.Generator,
    out: Frame | None = None,
) -> Frame:
    """Add the bias pattern to a frame. It is the same in every row and in every exposure.

    Parameters
    ----------
    frame : float array, shape (q, ny, nx)
        Electrons of each of the q quadrants or amplifiers, with the pixel at [0, 0] read first.
    offset : float or array, shape (q,)
        Standard deviation of the offsets of amplifiers in electrons, 0 or more.
    settling : float or array, shape (q,)
        Additional offset of the first column that is read, in electrons.
    length : float or array, shape (q,)
        Number of columns in which the additional offset falls by a factor of e, 1e-3 or more.
    stripes : float or array, shape (q,)
        Standard deviation of the random offsets of single columns in electrons, 0 or more.
    rng : numpy.random.Generator
        Random generator of the detector, in the same state in every exposure, so that the pattern does not change.
    out : float64 array, shape of `frame`, optional
        Array for the result, which may be `frame` itself. By default a new array.

    Returns
    -------
    float array, shape of `frame`
        Electrons including the bias pattern.

    Raises
    ------
    OutOfRange
        If `offset`, `stripes` or `length` is outside its limits, infinite or NaN.
    """
    shape = frame.reshape(-1, *frame.shape[-2:]).shape
    pattern = structure(shape[0], shape[2], offset, settling, length, stripes, rng)
    return np.asarray(np.add(frame, pattern.reshape(*frame.shape[:-2], 1, shape[2]), out=out))


def structure(
    quadrants: int, nx: int, offset: Number, settling: Number, length: Number, stripes: Number, rng: np.random.Generator
) -> Frame:
    """Draw the bias pattern of every amplifier, one value per column.

    Parameters
    ----------
    quadrants : int
        Number of amplifiers.
    nx : int
        Columns per amplifier.
    offset : float or array, shape (quadrants,)
        Standard deviation of the offsets of amplifiers in electrons, 0 or more.
    settling : float or array, shape (quadrants,)
        Additional offset of the first column that is read, in electrons.
    length : float or array, shape (quadrants,)
        Number of columns in which the additional offset falls by a factor of e, 1e-3 or more.
    stripes : float or array, shape (quadrants,)
        Standard deviation of the random offsets of single columns in electrons, 0 or more.
    rng : numpy.random.Generator
        Random generator of the detector, in the same state in every exposure, so that the pattern does not change.

    Returns
    -------
    float array, shape (quadrants, nx)
        Electrons to add to each column, in the order in which columns are read.

    Raises
    ------
    OutOfRange
        If `offset`, `stripes` or `length` is outside its limits, infinite or NaN.
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


EFFECT = Effect("bias_structure", apply, _parameters, _contribution, fixed=True, cost=4e-3, in_place=True)
