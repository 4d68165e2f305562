"""Full well and bleeding: charge above the full well of a pixel flows along its column, half in each direction.

A column of pixels is one segment, or one segment per amplifier. At one end of a segment is the serial register, through
which the segment is read: charge that arrives there is lost. At the other end charge is turned back. This other end is
at the charge-injection rows in VIS, and in the middle of the column in cameras that are read at both ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lake_schema.arrays import Bool
from lake_schema.errors import OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.effects.effect import Effect, copy_frame
from truesky.render.effects.scene import Frame, Scene

# Parts of every column that are read through one serial register: each (first row, last row + 1, True if the register
# is above the part and False if it is below).
Segments = Sequence[tuple[int, int, bool]]


def apply(
    frame: Frame, capacity: float, segments: Segments, rng: np.random.Generator | None = None, out: Frame | None = None
) -> Frame:
    """Limit every pixel to its full well and move the excess charge along its column.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Electrons, whole numbers of 0 or more.
    capacity : float
        Full well in electrons, 1 or more.
    segments : sequence of (int, int, bool)
        Parts of every column that are read through one serial register, each (first row, last row + 1, True if the
        register is above).
    rng : numpy.random.Generator, optional
        Not used.
    out : float64 array, shape of `frame`, optional
        Array for the result, which may be `frame` itself. By default a new array.

    Returns
    -------
    float array, shape (ny, nx)
        Electrons after bleeding, whole numbers. Charge that reaches a serial register is lost.

    Raises
    ------
    OutOfRange
        If `capacity` is less than 1, infinite or NaN, or if a segment is outside the frame.
    """
    return bleed(frame, capacity, segments, out)[0]


def bleed(frame: Frame, capacity: float, segments: Segments, out: Frame | None = None) -> tuple[Frame, float]:
    """Move charge above the full well along its column, and count the charge that leaves the detector.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Electrons, 0 or more.
    capacity : float
        Full well in electrons, 1 or more.
    segments : sequence of (int, int, bool)
        Parts of every column that are read through one serial register, each (first row, last row + 1, True if the
        register is above). Rows outside all segments are unchanged.
    out : float64 array, shape of `frame`, optional
        Array for the result, which may be `frame` itself. By default a new array.

    Returns
    -------
    frame : float array, shape (ny, nx)
        Electrons after bleeding. Whole electrons stay whole.
    lost : float
        Electrons that left through the serial registers. The sum of `frame` and `lost` equals the sum of the input
        exactly.

    Raises
    ------
    OutOfRange
        If `capacity` is less than 1, infinite or NaN, or if a segment is outside the frame.
    """
    if not 1.0 <= capacity < np.inf:
        raise OutOfRange("full well", capacity, 1.0, np.inf)
    for first, past, _ in segments:
        if not 0 <= first <= past <= len(frame):
            raise OutOfRange("rows of a column", first if first < 0 else past, 0, len(frame))
    out = copy_frame(frame, out)
    highest = out.max(axis=0, initial=0.0)
    if highest.max(initial=0.0) <= capacity:
        return out, 0.0
    full, lost = float(np.floor(capacity)), 0.0
    columns = np.flatnonzero(highest > full)
    for first, past, register_above in segments:
        if past > first:
            segment = out[first:past]
            lost += _bleed_segment(segment[::-1] if register_above else segment, columns, full)
    return out, lost


@jit
def _bleed_segment(segment: Any, columns: Any, full: float) -> float:
    """Let charge above the full well flow along the columns of one segment, in place, and return the electrons lost.

    A segment is the part of the columns that is read through one serial register, here below row 0. Charge that reaches
    the register is lost. Only the columns with the indices `columns` are treated. `full` is the full well in electrons.
    """
    n = segment.shape[0]
    down = np.empty(n)
    lost = 0.0
    for x in columns:
        carried = 0.0
        for y in range(n):
            charge = segment[y, x]
            # Half of a pixel's charge above full well flows up (away from the serial register), the other half down.
            # Charge that arrives from below flows on upwards.
            excess = max(charge - full, 0.0)
            upwards = np.ceil(0.5 * excess)
            down[y] = excess - upwards
            charge = charge - excess + carried
            over = max(charge - full, 0.0)
            segment[y, x] = charge - over
            carried = over + upwards
        # At the end opposite to the register, charge that still flows upwards is turned back.
        for y in range(n - 1, -1, -1):
            charge = segment[y, x] + carried
            over = max(charge - full, 0.0)
            segment[y, x] = charge - over
            carried = over + down[y]
        lost += carried
    return lost


def saturated_pixels(frame: Frame, capacity: float) -> Bool:
    """Return a mask of the pixels at or above the full well.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Electrons.
    capacity : float
        Full well in electrons.

    Returns
    -------
    bool array, shape (ny, nx)
        True for pixels with at least `capacity` electrons, rounded down to a whole number.
    """
    return np.asarray(frame >= np.floor(capacity))


def full_well(scene: Scene) -> float:
    """Return the full well (largest charge of a pixel) of the scene's detector in electrons."""
    return scene.value("full_well", "electron")


def _contribution(scene: Scene) -> float:
    """Return the electrons above the full well in the brightest pixel; 0 if it is not full."""
    return max(scene.brightest_electrons - full_well(scene), 0.0)


EFFECT = Effect(
    "bleeding", apply, lambda scene: (full_well(scene), scene.column_segments), _contribution, cost=5e-3, in_place=True
)
