"""Crosstalk between detectors that are read by one board: each sees a little of the others' bright stars.

Amplifiers of the same number see each other, pixel by pixel in the order in which they are read.
"""

from __future__ import annotations

import numpy as np

from lake_schema.errors import OutOfRange
from truesky.render.effects.effect import Effect, zero_contribution
from truesky.render.effects.scene import Frame, NeighbourCharge, Scene


def apply(
    frame: Frame, neighbour_charge: NeighbourCharge | None, coefficient: float, rng: np.random.Generator | None = None
) -> Frame:
    """Parts [q, ny, nx] in readout order -> each plus its share of what the other detectors' have.

    frame       : of the detector's amplifiers
    elsewhere   : charge of the other detectors, None = none that is noticed;  rng : not used
    coefficient : of signal of one into another
    """
    if not abs(coefficient) <= 1.0:
        raise OutOfRange("crosstalk between detectors", coefficient, -1.0, 1.0)
    out = np.array(frame, dtype=float, order="C")
    if neighbour_charge is not None:
        # No pixel is in it twice.
        out.reshape(-1)[neighbour_charge.pixel] += coefficient * neighbour_charge.electrons
    return out


def coefficient(scene: Scene) -> float:
    """Of the mission database; 0 of a camera that has none."""
    key = f"{scene.section}.crosstalk_detectors"
    return scene.mission.value(key) if key in scene.mission else 0.0


def _contribution(scene: Scene) -> float:
    brightest = 0.0 if scene.neighbour_charge is None else float(scene.neighbour_charge.electrons.max(initial=0.0))
    return abs(coefficient(scene)) * brightest


# An image of a star is a small part of what means are taken of, and lies elsewhere in the next exposure.
EFFECT = Effect(
    "detector_crosstalk",
    apply,
    lambda scene: (scene.neighbour_charge, coefficient(scene)),
    _contribution,
    cost=2e-3,
    systematic=zero_contribution,
)
