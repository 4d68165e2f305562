"""Crosstalk between amplifiers of a detector: they are read at the same time, and each signal appears in the others."""

from __future__ import annotations

from typing import Any

import numpy as np

from lake_schema.errors import BadInput, OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.camera import amplifiers
from truesky.render.effects.effect import Effect
from truesky.render.effects.scene import Frame, Scene

# Coupling across the diagonal as a fraction of the coupling between neighbours (assumed).
_DIAGONAL = 0.5
_BLOCK = 1024
# Each iteration multiplies the error by the sum of an amplifier's coefficients, which is 0.01 or less.
_ITERATIONS = 3


def apply(frame: Frame, coefficients: Frame, rng: np.random.Generator | None = None) -> Frame:
    """Add to each amplifier a share of the signals of all others.

    Parameters
    ----------
    frame : float array, shape (q, ny, nx)
        Electrons of each amplifier in readout order.
    coefficients : float array, shape (q, q)
        Share of the signal of the second index that appears in the first, -1 to 1; 0 on the diagonal.
    rng : numpy.random.Generator, optional
        Not used.

    Returns
    -------
    float array, shape (q, ny, nx)
        Electrons including crosstalk.

    Raises
    ------
    BadInput
        If the number of coefficients does not match the number of amplifiers.
    OutOfRange
        If a coefficient is outside its limits.
    """
    count = len(frame)
    if coefficients.shape != (count, count):
        raise BadInput(f"crosstalk coefficients have the shape {coefficients.shape}, must be {(count, count)}")
    if not np.all(np.abs(coefficients) <= 1.0):
        raise OutOfRange("crosstalk", float(np.abs(coefficients).max()), 0.0, 1.0)
    flat = np.ascontiguousarray(frame, dtype=float).reshape(count, -1)
    out = np.empty_like(flat)
    _mix(flat, np.asarray(coefficients, float), out)
    return out.reshape(frame.shape)


def remove(frame: Frame, coefficients: Frame) -> Frame:
    """Remove crosstalk from frames: the inverse of `apply`, for calibration.

    The relative error is the fourth power of the sum of an amplifier's coefficients: 1e-8 of the light of the others.
    """
    out = apply(frame, -coefficients)
    for _ in range(_ITERATIONS - 1):
        out = frame - (apply(out, coefficients) - out)
    return out


@jit
def _mix(frame: Any, coefficients: Any, out: Any) -> None:
    # Blocks of pixels are small enough for the cache of the processor.
    for start in range(0, frame.shape[1], _BLOCK):
        for victim in range(len(frame)):
            line = out[victim, start : start + _BLOCK]
            line[:] = frame[victim, start : start + _BLOCK]
            for source in range(len(frame)):
                share, other = coefficients[victim, source], frame[source, start : start + _BLOCK]
                if source != victim and share != 0.0:
                    for i in range(len(line)):
                        line[i] += share * other[i]


def coefficients(scene: Scene) -> Frame:
    """Return the crosstalk coefficients of a scene's detector, shape (q, q).

    Detectors that are read in quadrants have the mission's value for neighbours, and half of it across the diagonal.
    Ground cameras have coefficients for each pair of amplifiers.
    """
    if scene.layout is not None and scene.detector is not None:
        largest = scene.value("crosstalk_max", "")
        return amplifiers.crosstalk_couplings(scene.value("crosstalk", ""), largest, scene.detector, scene.layout)
    row_neighbour = column_neighbour = scene.value("crosstalk", "")
    diagonal = _DIAGONAL * row_neighbour
    # E F G H: upper left, upper right, lower right, lower left.
    return np.array(
        [
            [0, row_neighbour, diagonal, column_neighbour],
            [row_neighbour, 0, column_neighbour, diagonal],
            [diagonal, column_neighbour, 0, row_neighbour],
            [column_neighbour, diagonal, row_neighbour, 0],
        ]
    )


def _contribution(scene: Scene) -> float:
    full = min(scene.brightest_electrons, scene.value("full_well", "electron") + scene.sky_electrons)
    return float(np.abs(coefficients(scene)).max()) * full


EFFECT = Effect("crosstalk", apply, lambda scene: (coefficients(scene),), _contribution, cost=4e-3)
