"""Crosstalk: a detector's amplifiers read at the same time, and each sees a little of the others.

apply       parts of a detector -> each with its share of the others
removed     its inverse: what a calibration does
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lake_schema.errors import BadInput, OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.camera import amplifiers
from truesky.render.effects.effect import Effect
from truesky.render.effects.scene import Frame, Scene

# Of the coupling between neighbours (assumed).
_DIAGONAL = 0.5
_BLOCK = 1024
# Each time what is left is smaller by the sum of an amplifier's coefficients: a hundredth at most.
_ITERATIONS = 3


def apply(frame: Frame, coefficients: Frame, rng: np.random.Generator | None = None) -> Frame:
    """Parts [q, ny, nx] in readout order -> each plus its share of the others, all at once.

    coefficients : [q, q] of signal from the second index into the first, 0 on the diagonal
    """
    count = len(frame)
    if coefficients.shape != (count, count):
        raise BadInput(f"crosstalk of {coefficients.shape} coefficients for {count} amplifiers")
    if not np.all(np.abs(coefficients) <= 1.0):
        raise OutOfRange("crosstalk", float(np.abs(coefficients).max()), 0.0, 1.0)
    flat = np.ascontiguousarray(frame, dtype=float).reshape(count, -1)
    out = np.empty_like(flat)
    _mix(flat, np.asarray(coefficients, float), out)
    return out.reshape(frame.shape)


def remove(frame: Frame, coefficients: Frame) -> Frame:
    """Parts [q, ny, nx] as `apply` left them -> as they were.

    coefficients : of `apply`
    Error        : the fourth power of the sum of an amplifier's coefficients: 1e-8 of the light of the others
    """
    out = apply(frame, -coefficients)
    for _ in range(_ITERATIONS - 1):
        out = frame - (apply(out, coefficients) - out)
    return out


@jit
def _mix(frame: Any, coefficients: Any, out: Any) -> None:
    # As many pixels at a time as the processor has near at hand.
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
    """Of quadrants: the mission's for neighbours along a side, half of it across the diagonal; else of each pair."""
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
