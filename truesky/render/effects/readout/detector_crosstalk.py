"""Crosstalk between detectors that share a readout board: faint copies of the other detectors' bright stars appear.

Amplifiers with the same number are coupled, pixel by pixel in readout order.
"""

from __future__ import annotations

import numpy as np

from lake_schema.errors import OutOfRange
from truesky.render.effects.effect import Effect, zero_contribution
from truesky.render.effects.scene import Frame, NeighbourCharge, Scene


def apply(
    frame: Frame, neighbour_charge: NeighbourCharge | None, coefficient: float, rng: np.random.Generator | None = None
) -> Frame:
    """Add the crosstalk from detectors on the same board.

    Parameters
    ----------
    frame : float array, shape (q, ny, nx)
        Electrons of each amplifier in readout order.
    neighbour_charge : NeighbourCharge or None
        Charge of the other detectors. None if it is negligible.
    coefficient : float
        Share of the signal of one detector that appears in another, -1 to 1.
    rng : numpy.random.Generator, optional
        Not used.

    Returns
    -------
    float array, shape (q, ny, nx)
        Electrons including crosstalk.

    Raises
    ------
    OutOfRange
        If `coefficient` is outside its limits.
    """
    if not abs(coefficient) <= 1.0:
        raise OutOfRange("crosstalk between detectors", coefficient, -1.0, 1.0)
    out = np.array(frame, dtype=float, order="C")
    if neighbour_charge is not None:
        # The assignment is correct because indices of pixels are unique.
        out.reshape(-1)[neighbour_charge.pixel] += coefficient * neighbour_charge.electrons
    return out


def coefficient(scene: Scene) -> float:
    """Return the coefficient from the mission database, or 0 for cameras without it."""
    key = f"{scene.section}.crosstalk_detectors"
    return scene.mission.value(key) if key in scene.mission else 0.0


def _contribution(scene: Scene) -> float:
    brightest = 0.0 if scene.neighbour_charge is None else float(scene.neighbour_charge.electrons.max(initial=0.0))
    return abs(coefficient(scene)) * brightest


# The contribution averages out: a copy of a star covers few pixels, and different ones in the next exposure.
EFFECT = Effect(
    "detector_crosstalk",
    apply,
    lambda scene: (scene.neighbour_charge, coefficient(scene)),
    _contribution,
    cost=2e-3,
    systematic=zero_contribution,
)
