"""Crosstalk between detectors that are connected to the same readout board: faint copies of bright stars appear.

The signal of an amplifier of one detector appears in the amplifier with the same number of each other detector on the
board. The pixels that are read at the same time are coupled.
"""

from __future__ import annotations

import numpy as np

from lake_schema.errors import OutOfRange
from truesky.render.effects.effect import Effect, copy_frame, zero_contribution
from truesky.render.effects.scene import Frame, NeighbourCharge, Scene


def apply(
    frame: Frame,
    neighbour_charge: NeighbourCharge | None,
    coefficient: float,
    rng: np.random.Generator | None = None,
    out: Frame | None = None,
) -> Frame:
    """Add the crosstalk from the other detectors on the same readout board to a frame.

    Parameters
    ----------
    frame : float array, shape (q, ny, nx)
        Electrons of each of the q amplifiers, with the pixel at [0, 0] read first.
    neighbour_charge : NeighbourCharge or None
        Pixels of this detector, and the electrons that the other detectors read at the same time as each of them. None
        if this charge is negligible.
    coefficient : float
        Share of the signal of one detector that appears in another, -1 to 1.
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
    OutOfRange
        If `coefficient` is outside its limits or NaN.
    """
    if not abs(coefficient) <= 1.0:
        raise OutOfRange("crosstalk between detectors", coefficient, -1.0, 1.0)
    out = copy_frame(frame, out)
    if neighbour_charge is not None:
        # numpy adds only one value to an element whose index occurs several times in such a sum. This is no danger
        # here, because each pixel occurs only once in `neighbour_charge.pixel`.
        out.reshape(-1)[neighbour_charge.pixel] += coefficient * neighbour_charge.electrons
    return out


def coefficient(scene: Scene) -> float:
    """Return the fraction of a detector's signal that appears in each other detector on its readout board.

    It is 0 for cameras for which the mission database has no such parameter.
    """
    key = f"{scene.section}.crosstalk_detectors"
    return scene.mission.value(key) if key in scene.mission else 0.0


def _contribution(scene: Scene) -> float:
    brightest = 0.0 if scene.neighbour_charge is None else float(scene.neighbour_charge.electrons.max(initial=0.0))
    return abs(coefficient(scene)) * brightest


# `systematic` (the change of a pixel that remains in the mean of many exposures) is 0, because copies of stars are on
# other pixels in the next exposure.
EFFECT = Effect(
    "detector_crosstalk",
    apply,
    lambda scene: (scene.neighbour_charge, coefficient(scene)),
    _contribution,
    cost=2e-3,
    systematic=zero_contribution,
    in_place=True,
)
