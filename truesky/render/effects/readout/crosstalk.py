"""Crosstalk between the amplifiers of a detector: they are read at the same time, and each signal appears in others."""

from __future__ import annotations

from typing import Any

import numpy as np

from lake_schema.errors import BadInput, OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.camera import amplifiers
from truesky.render.effects.effect import Effect, copy_frame
from truesky.render.effects.scene import Frame, Scene

# Crosstalk coefficient of diagonally opposite quadrants of a detector, divided by that of quadrants with a common side
# (assumed).
_DIAGONAL = 0.5
# Number of pixels of each amplifier that are treated together, so that they fit into the cache of the processor.
_BLOCK = 1024
# Number of iterations of `remove`. Each multiplies the remaining crosstalk by the sum of the crosstalk coefficients of
# an amplifier, which is at most 0.01 for real detectors.
_ITERATIONS = 3


def apply(frame: Frame, coefficients: Frame, rng: np.random.Generator | None = None, out: Frame | None = None) -> Frame:
    """Add to the signal of each amplifier a share of the signals of all other amplifiers.

    Parameters
    ----------
    frame : float array, shape (q, ny, nx)
        Electrons of each of the q amplifiers, with the pixel at [0, 0] read first.
    coefficients : float array, shape (q, q)
        Element [i, j] is the share of the signal of amplifier j that appears in amplifier i, -1 to 1. Elements on the
        diagonal are ignored.
    rng : numpy.random.Generator, optional
        Not used.
    out : float64 array, shape of `frame`, optional
        Array for the result, which may be `frame` itself. By default a new array.

    Returns
    -------
    float array, shape (q, ny, nx)
        Electrons including crosstalk.

    Raises
    ------
    BadInput
        If the shape of `coefficients` is not (q, q).
    OutOfRange
        If a coefficient is outside its limits or NaN.
    """
    count = len(frame)
    if coefficients.shape != (count, count):
        raise BadInput(f"crosstalk coefficients have the shape {coefficients.shape}, must be {(count, count)}")
    if not np.all(np.abs(coefficients) <= 1.0):
        raise OutOfRange("crosstalk", float(np.abs(coefficients).max()), 0.0, 1.0)
    out = copy_frame(frame, out)
    _mix(out.reshape(count, -1), np.asarray(coefficients, float))
    return out


def remove(frame: Frame, coefficients: Frame) -> Frame:
    """Remove crosstalk between amplifiers from a frame (q, ny, nx) for calibration: the inverse of `apply`.

    Element [i, j] of `coefficients`, shape (q, q), is the share of the signal of amplifier j that appears in amplifier
    i. The remaining error is the light of the other amplifiers times the fourth power of the sum of an amplifier's
    coefficients, or 1e-8 for a sum of 0.01.
    """
    out = apply(frame, -coefficients)
    for _ in range(_ITERATIONS - 1):
        out = frame - (apply(out, coefficients) - out)
    return out


@jit
def _mix(frame: Any, coefficients: Any) -> None:
    """Add the crosstalk to a frame [amplifier, pixel] in place."""
    block = np.empty((len(frame), _BLOCK))
    # Add the crosstalk to `_BLOCK` pixels of all amplifiers before the next pixels: these fit into the processor's
    # cache.
    for start in range(0, frame.shape[1], _BLOCK):
        size = min(_BLOCK, frame.shape[1] - start)
        block[:, :size] = frame[:, start : start + size]
        for victim in range(len(frame)):
            line = frame[victim, start : start + size]
            for source in range(len(frame)):
                share, other = coefficients[victim, source], block[source]
                if source != victim and share != 0.0:
                    for i in range(len(line)):
                        line[i] += share * other[i]


def coefficients(scene: Scene) -> Frame:
    """Return the crosstalk coefficients of a scene's detector, shape (q, q) for q amplifiers.

    Element [i, j] is the share of the electrons of amplifier j that appears in amplifier i. Detectors that are read in
    quadrants have the coefficient of the mission database for neighbours, and half of it for diagonally opposite
    quadrants. Ground cameras have a coefficient for each pair of amplifiers: a measured one if there is one, which can
    be negative.
    """
    if scene.layout is not None and scene.detector is not None:
        measured = amplifiers.measured_crosstalk(scene.detector, scene.layout, scene.mission)
        if measured is not None:
            # Observatories measure crosstalk in ADU.
            gain = np.broadcast_to(scene.amplifier_values("gain", "electron / adu"), len(measured))
            return np.asarray(measured * (gain[:, None] / gain))
        largest = scene.value("crosstalk_max", "")
        return amplifiers.crosstalk_couplings(scene.value("crosstalk", ""), largest, scene.detector, scene.layout)
    row_neighbour = column_neighbour = scene.value("crosstalk", "")
    diagonal = _DIAGONAL * row_neighbour
    # The order of the quadrants is upper left (H), upper right (G), lower right (F), lower left (E).
    return np.array(
        [
            [0, row_neighbour, diagonal, column_neighbour],
            [row_neighbour, 0, column_neighbour, diagonal],
            [diagonal, column_neighbour, 0, row_neighbour],
            [column_neighbour, diagonal, row_neighbour, 0],
        ]
    )


def _contribution(scene: Scene) -> float:
    full = min(scene.brightest_electrons, scene.full_well + scene.sky_electrons)
    return float(np.abs(coefficients(scene)).max()) * full


EFFECT = Effect("crosstalk", apply, lambda scene: (coefficients(scene),), _contribution, cost=4e-3, in_place=True)
