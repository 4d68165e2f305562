"""Structure of the bias level: a fixed pattern, a slow drift, and noise that is common to the pixels of a row.

The pattern consists of offsets of amplifiers, settling in the first columns, and stripes along columns. Settling is an
additional offset that decays exponentially from the first column that is read. Stripes are random offsets of single
columns. The pattern is the same in every row and in every exposure.

The drift is one offset per amplifier and exposure. It changes slowly with the date, so that exposures within its
correlation time have almost the same offset. The noise of rows is drawn for each row of each amplifier and exposure.
Both change prescan and overscan like the pixels. The drift is removed with the mean of the overscan, and the noise of
rows with the mean of the overscan of each row.
"""

from __future__ import annotations

import numpy as np

from lake_schema.arrays import Float
from lake_schema.errors import OutOfRange
from truesky.render.effects.effect import Effect
from truesky.render.effects.scene import Frame, Scene

Number = float | Float
# Number of waves that add up to the drift of an amplifier.
_WAVES = 64


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
    _check_numbers(("bias offset", offset, 0.0), ("bias stripes", stripes, 0.0), ("bias settling length", length, 1e-3))
    offset, settling, length, stripes = (np.reshape(number, (-1, 1)) for number in (offset, settling, length, stripes))
    offsets = offset * rng.standard_normal((quadrants, 1))
    settled = settling * np.exp(-np.arange(nx) / length)
    return np.asarray(offsets + settled + stripes * rng.standard_normal((quadrants, nx)))


def apply_drift(
    frame: Frame, rms: Number, mjd: float, time: float, rng: np.random.Generator, out: Frame | None = None
) -> Frame:
    """Add the slow drift of the bias level: one offset for each amplifier, which depends on the date.

    Parameters
    ----------
    frame : float array, shape (q, ny, nx)
        Electrons of each of the q quadrants or amplifiers.
    rms : float or array, shape (q,)
        Standard deviation of the offsets in electrons, 0 or more.
    mjd : float
        Date of the exposure in days.
    time : float
        Correlation time in days, 1e-6 or more.
    rng : numpy.random.Generator
        Random generator of the detector, in the same state in every exposure.
    out : float64 array, shape of `frame`, optional
        Array for the result, which may be `frame` itself. By default a new array.

    Returns
    -------
    float array, shape of `frame`
        Electrons including the drift.

    Raises
    ------
    OutOfRange
        If `rms` or `time` is outside its limits, infinite or NaN.

    Notes
    -----
    The offset is a sum of 64 waves with random phases and normally distributed frequencies. Its autocorrelation, over
    many amplifiers, is exp(-(t / time)^2 / 2) after the time t.
    """
    _check_numbers(("bias drift", rms, 0.0), ("correlation time of the bias drift", time, 1e-6))
    count = len(frame.reshape(-1, *frame.shape[-2:]))
    frequencies = rng.standard_normal((count, _WAVES)) / (2.0 * np.pi * time)
    phases = rng.random((count, _WAVES))
    waves = np.cos(2.0 * np.pi * (frequencies * mjd + phases)).sum(axis=1) * np.sqrt(2.0 / _WAVES)
    return np.asarray(np.add(frame, (rms * waves).reshape(*frame.shape[:-2], 1, 1), out=out))


def apply_row_noise(frame: Frame, rms: Number, rng: np.random.Generator, out: Frame | None = None) -> Frame:
    """Add a random offset to each row of each amplifier.

    Parameters
    ----------
    frame : float array, shape (q, ny, nx)
        Electrons of each of the q quadrants or amplifiers.
    rms : float or array, shape (q,)
        Standard deviation of the offsets in electrons, 0 or more.
    rng : numpy.random.Generator
        Random generator of the exposure.
    out : float64 array, shape of `frame`, optional
        Array for the result, which may be `frame` itself. By default a new array.

    Returns
    -------
    float array, shape of `frame`
        Electrons including the noise.

    Raises
    ------
    OutOfRange
        If `rms` is negative, infinite or NaN.
    """
    _check_numbers(("noise of rows", rms, 0.0))
    rows = frame.reshape(-1, *frame.shape[-2:]).shape[:2]
    offsets = np.reshape(rms, (-1, 1)) * rng.standard_normal(rows)
    return np.asarray(np.add(frame, offsets.reshape(*frame.shape[:-1], 1), out=out))


def _check_numbers(*numbers: tuple[str, Number, float]) -> None:
    """Check that numbers, each (name, value, lowest allowed value), are finite and allowed; raise OutOfRange if not."""
    for name, value, lowest in numbers:
        if not (np.min(value) >= lowest and np.max(value) < np.inf):
            raise OutOfRange(name, value, lowest, np.inf)


def _parameters(scene: Scene) -> tuple[Number, Number, Number, Number]:
    offset, settling, stripes = (_in_electrons(scene, f"bias_{key}") for key in ("offset", "settling", "stripes"))
    return offset, settling, scene.amplifier_values("bias_settling_length", "pix"), stripes


def _contribution(scene: Scene) -> float:
    offset, settling, _, stripes = _parameters(scene)
    return float(np.max(offset + np.abs(settling) + stripes))


def _in_electrons(scene: Scene, key: str) -> Number:
    """Return a parameter of the amplifiers that the mission database has in ADU, such as "bias_drift", in electrons."""
    return scene.amplifier_values("gain", "electron / adu") * scene.amplifier_values(key, "adu")


EFFECT = Effect("bias_structure", apply, _parameters, _contribution, fixed=True, cost=4e-3, in_place=True)
DRIFT = Effect(
    "bias_drift",
    apply_drift,
    lambda scene: (_in_electrons(scene, "bias_drift"), scene.mjd, scene.value("bias_drift_scale", "h") / 24.0),
    lambda scene: float(np.max(_in_electrons(scene, "bias_drift"))),
    fixed=True,
    cost=3e-3,
    in_place=True,
)
ROW_NOISE = Effect(
    "row_noise",
    apply_row_noise,
    lambda scene: (_in_electrons(scene, "bias_row_noise"),),
    lambda scene: float(np.max(_in_electrons(scene, "bias_row_noise"))),
    cost=3e-3,
    in_place=True,
)
