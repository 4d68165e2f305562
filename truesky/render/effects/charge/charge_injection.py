"""Charge injection: blocks of rows filled electronically, to measure how traps capture and release charge."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lake_schema.errors import OutOfRange
from truesky.render.effects.effect import Effect, zero_contribution
from truesky.render.effects.scene import Frame, Scene


def apply(frame: Frame, level: float, rows_on: int, rows_off: int, spread: float, rng: np.random.Generator) -> Frame:
    """Add whole electrons to the injected rows.

    Starting at each of the two serial registers, `rows_off` empty rows and `rows_on` injected rows alternate.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Electrons.
    level : float
        Mean injected electrons per pixel, 0 to 1e9.
    rows_on, rows_off : int
        Rows per injected block (1 or more), and empty rows before each block (0 or more).
    spread : float
        Standard deviation between columns as a fraction of `level`.
    rng : numpy.random.Generator
        Random numbers of the columns, the same in every exposure.

    Returns
    -------
    float array, shape (ny, nx)
        Electrons including the injected charge.

    Raises
    ------
    OutOfRange
        If a parameter is outside its limits.
    """
    for name, value in (("charge injection", level), ("injection spread", spread)):
        if not 0.0 <= value <= 1e9:
            raise OutOfRange(name, value, 0.0, 1e9)
    out = np.array(frame, dtype=float)
    columns = level * np.maximum(1.0 + spread * rng.standard_normal(out.shape[1]), 0.0)
    out[_injected_rows(len(out), rows_on, rows_off)] += np.rint(columns)
    return out


def apply_noise(frame: Frame, rows_on: int, rows_off: int, noise: float, rng: np.random.Generator) -> Frame:
    """Add the noise of the injected charge.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Electrons, 0 or more.
    rows_on, rows_off : int
        Same as in `apply`.
    noise : float
        Standard deviation in electrons per pixel, 0 to 1e9.
    rng : numpy.random.Generator
        Random numbers of the pixels.

    Returns
    -------
    float array, shape (ny, nx)
        Electrons. The changes are whole electrons; no pixel falls below 0.

    Raises
    ------
    OutOfRange
        If a parameter is outside its limits.
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
    # Rows from the nearer serial register.
    distance = np.minimum(np.arange(ny), ny - 1 - np.arange(ny))
    return np.flatnonzero(distance % (rows_on + rows_off) >= rows_off)


def _parameters(scene: Scene) -> tuple[float, int, int, float]:
    return scene.value("injection.level", "electron"), *_block_rows(scene), scene.value("injection.spread", "")


def _block_rows(scene: Scene) -> tuple[int, int]:
    return int(scene.value("injection.on", "pix")), int(scene.value("injection.off", "pix"))


def _noise(scene: Scene) -> float:
    """Return the noise in electrons, 0 if nothing is injected."""
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
