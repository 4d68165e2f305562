"""Full well and bleeding: charge above the full well of a pixel flows along its column, half in each direction.

A column of pixels is one segment, or one segment per amplifier. At one end of a segment is the serial register, through
which the segment is read: charge that arrives there is lost. At the other end charge is turned back. This other end is
at the charge-injection rows in VIS, and in the middle of the column in cameras that are read at both ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lake_schema.arrays import Bool, Float
from lake_schema.errors import OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.effects.effect import Effect, copy_frame
from truesky.render.effects.scene import Frame, Scene

# Parts of every column that are read through one serial register: each (first row, last row + 1, True if the register
# is above the part and False if it is below).
Segments = Sequence[tuple[int, int, bool]]


def apply(
    frame: Frame,
    capacity: float | Float,
    segments: Segments,
    rng: np.random.Generator | None = None,
    out: Frame | None = None,
) -> Frame:
    """Limit every pixel to its full well and move the excess charge along its column.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Electrons, whole numbers of 0 or more.
    capacity : float or float array, shape (n_segments, nx)
        Full well in electrons, 1 or more: one for all pixels, or one for each segment and column.
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


def bleed(frame: Frame, capacity: float | Float, segments: Segments, out: Frame | None = None) -> tuple[Frame, float]:
    """Move charge above the full well along its column, and count the charge that leaves the detector.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Electrons, 0 or more.
    capacity : float or float array, shape (n_segments, nx)
        Full well in electrons, 1 or more: one for all pixels, or one for each segment and column.
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
    lowest = float(np.min(capacity))
    if not (lowest >= 1.0 and np.max(capacity) < np.inf):
        raise OutOfRange("full well", lowest, 1.0, np.inf)
    for first, past, _ in segments:
        if not 0 <= first <= past <= len(frame):
            raise OutOfRange("rows of a column", first if first < 0 else past, 0, len(frame))
    out = copy_frame(frame, out)
    highest = out.max(axis=0, initial=0.0)
    if highest.max(initial=0.0) <= lowest:
        return out, 0.0
    full_wells, lost = np.floor(_of_segments(capacity, segments, out.shape[1])), 0.0
    for (first, past, register_above), full in zip(segments, full_wells, strict=True):
        if past > first:
            segment, columns = out[first:past], np.flatnonzero(highest > full)
            lost += _bleed_segment(segment[::-1] if register_above else segment, columns, full)
    return out, lost


def _of_segments(capacity: float | Float, segments: Segments, nx: int) -> Float:
    """Return the full well of each segment and column in electrons, shape (n_segments, nx)."""
    return np.array(np.broadcast_to(capacity, (len(segments), nx)), float)


@jit
def _bleed_segment(segment: Any, columns: Any, full_wells: Any) -> float:
    """Let charge above the full well flow along the columns of one segment, in place, and return the electrons lost.

    A segment is the part of the columns that is read through one serial register, here below row 0. Charge that reaches
    the register is lost. Only the columns with the indices `columns` are treated. `full_wells` is the full well of each
    column in electrons.
    """
    n = segment.shape[0]
    down = np.empty(n)
    lost = 0.0
    for x in columns:
        carried, full = 0.0, full_wells[x]
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


def saturated_pixels(frame: Frame, capacity: float | Float, segments: Segments) -> Bool:
    """Return a mask of the pixels at or above the full well.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Electrons.
    capacity : float or float array, shape (n_segments, nx)
        Full well in electrons: one for all pixels, or one for each segment and column.
    segments : sequence of (int, int, bool)
        Parts of every column that are read through one serial register, as for `apply`.

    Returns
    -------
    bool array, shape (ny, nx)
        True for pixels with at least their full well, rounded down to a whole number. Rows outside all segments are
        False.
    """
    out, full_wells = np.zeros(frame.shape, bool), np.floor(_of_segments(capacity, segments, frame.shape[1]))
    for (first, past, _), full in zip(segments, full_wells, strict=True):
        out[first:past] = frame[first:past] >= full
    return out


def parameters(scene: Scene) -> tuple[float | Float, Segments]:
    """Return the full well of a scene's detector in electrons, and the parts of its columns, as `apply` takes them.

    The full well is one number if it is equal for all amplifiers, and else has the shape (n_segments, nx).
    """
    full_wells = scene.amplifier_values("full_well", "electron")
    if not isinstance(full_wells, np.ndarray):
        return full_wells, scene.column_segments
    # Only detectors that are read in quadrants have several. The order is upper left (H), upper right (G), lower right
    # (F), lower left (E).
    upper_left, upper_right, lower_right, lower_left = full_wells
    is_right = np.arange(scene.nx) >= scene.nx // 2
    lower, upper = np.where(is_right, lower_right, lower_left), np.where(is_right, upper_right, upper_left)
    return np.stack([lower, upper]), scene.column_segments


def _contribution(scene: Scene) -> float:
    """Return the electrons above the full well in the brightest pixel; 0 if it is not full."""
    return max(scene.brightest_electrons - float(np.min(scene.amplifier_values("full_well", "electron"))), 0.0)


EFFECT = Effect("bleeding", apply, parameters, _contribution, cost=5e-3, in_place=True)
