"""Charge injection: blocks of rows are filled with charge electronically, to measure how traps capture it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lake_schema.errors import OutOfRange
from truesky.render.effects.effect import Effect, zero_contribution
from truesky.render.effects.scene import Frame, Scene


def apply(frame: Frame, level: float, rows_on: int, rows_off: int, spread: float, rng: np.random.Generator) -> Frame:
    """Add the injected charge, whole electrons, to the injected rows of a frame.

    Each half of the detector is read through a serial register at its outer edge. From there to the middle, blocks of
    `rows_off` empty rows and `rows_on` injected rows alternate.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Electrons.
    level : float
        Mean injected electrons per pixel, 0 to 1e9.
    rows_on, rows_off : int
        Number of rows in an injected block (1 to 1e6), and number of empty rows before each block (0 to 1e6).
    spread : float
        Standard deviation of the injected charge between columns, as a fraction of `level`, 0 to 1e9.
    rng : numpy.random.Generator
        Random generator of the differences between columns, in the same state in every exposure.

    Returns
    -------
    float array, shape (ny, nx)
        Electrons including the injected charge.

    Raises
    ------
    OutOfRange
        If `level`, `spread`, `rows_on` or `rows_off` is outside its limits or NaN.
    """
    for name, value in (("charge injection", level), ("injection spread", spread)):
        if not 0.0 <= value <= 1e9:
            raise OutOfRange(name, value, 0.0, 1e9)
    out = np.array(frame, dtype=float)
    columns = level * np.maximum(1.0 + spread * rng.standard_normal(out.shape[1]), 0.0)
    out[_injected_rows(len(out), rows_on, rows_off)] += np.rint(columns)
    return out


def apply_noise(frame: Frame, rows_on: int, rows_off: int, noise: float, rng: np.random.Generator) -> Frame:
    """Add random noise to the charge of the injected rows.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Electrons, 0 or more.
    rows_on, rows_off : int
        Number of rows in an injected block (1 to 1e6), and number of empty rows before each block (0 to 1e6). Blocks
        are counted from the serial registers at the first and the last row.
    noise : float
        Standard deviation of the noise in electrons per pixel, 0 to 1e9.
    rng : numpy.random.Generator
        Random generator of the noise of the pixels.

    Returns
    -------
    float array, shape (ny, nx)
        Electrons. Pixels change by whole electrons, and negative results are set to 0.

    Raises
    ------
    OutOfRange
        If `noise`, `rows_on` or `rows_off` is outside its limits or NaN.
    """
    if not 0.0 <= noise <= 1e9:
        raise OutOfRange("injection noise", noise, 0.0, 1e9)
    out, rows = np.array(frame, dtype=float), _injected_rows(len(frame), rows_on, rows_off)
    out[rows] = np.maximum(out[rows] + np.rint(noise * rng.standard_normal((len(rows), out.shape[1]))), 0.0)
    return out


def _injected_rows(ny: int, rows_on: int, rows_off: int) -> npt.NDArray[np.intp]:
    for name, count, lowest in (("injected rows", rows_on, 1), ("rows between injections", rows_off, 0)):
        if not lowest <= count <= 1_000_000:
            raise OutOfRange(name, count, lowest, 1_000_000)
    # Distance of each row from the nearer serial register, below the first row or above the last row.
    distance = np.minimum(np.arange(ny), ny - 1 - np.arange(ny))
    return np.flatnonzero(distance % (rows_on + rows_off) >= rows_off)


def _parameters(scene: Scene) -> tuple[float, int, int, float]:
    return scene.value("injection.level", "electron"), *_block_rows(scene), scene.value("injection.spread", "")


def _block_rows(scene: Scene) -> tuple[int, int]:
    return int(scene.value("injection.on", "pix")), int(scene.value("injection.off", "pix"))


def _noise(scene: Scene) -> float:
    """Return the rms noise of injected charge in electrons; 0 if the scene has no charge injection."""
    return scene.value("injection.noise", "electron") * (EFFECT.is_applied(scene) and _parameters(scene)[0] > 0.0)


EFFECT = Effect("charge_injection", apply, _parameters, lambda scene: _parameters(scene)[0], fixed=True, cost=6e-3)
NOISE = Effect(
    "injection_noise",
    apply_noise,
    lambda scene: (*_block_rows(scene), _noise(scene)),
    _noise,
    cost=1.5e-2,
    systematic=zero_contribution,
)
