"""Full well and bleeding: charge above the full well flows along its column, half in each direction.

A column consists of one segment, or of one segment per amplifier. At one end of a segment is its serial register, where
charge is lost. At the other end charge is turned back: by the charge-injection rows in VIS, and by the middle of the
column in cameras that are read at both ends.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lake_schema.arrays import Bool
from lake_schema.errors import OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.effects.effect import Effect
from truesky.render.effects.scene import Frame, Scene

# Segments of every column: first row, last row + 1, and True if the serial register is above the segment.
Segments = Sequence[tuple[int, int, bool]]


def apply(frame: Frame, capacity: float, segments: Segments, rng: np.random.Generator | None = None) -> Frame:
    """Limit every pixel to the full well and move the excess along its column.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Whole electrons, 0 or more.
    capacity : float
        Full well in electrons, 1 or more.
    segments : sequence of (int, int, bool)
        Same as in `bleed`.
    rng : numpy.random.Generator, optional
        Not used.

    Returns
    -------
    float array, shape (ny, nx)
        Whole electrons.
    """
    return bleed(frame, capacity, segments)[0]


def bleed(frame: Frame, capacity: float, segments: Segments) -> tuple[Frame, float]:
    """Let charge above the full well bleed, and count the charge that leaves the detector.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Electrons, 0 or more.
    capacity : float
        Full well in electrons, 1 or more.
    segments : sequence of (int, int, bool)
        Segments of every column: first row, last row + 1, and True if the serial register is above the segment.
        Rows outside all segments are unchanged.

    Returns
    -------
    frame : float array, shape (ny, nx)
        Electrons after bleeding. Whole electrons stay whole.
    lost : float
        Electrons that left through the serial registers. Frame and lost charge add up to the input exactly.

    Raises
    ------
    OutOfRange
        If `capacity` is less than 1 or a segment is outside the frame.
    """
    if not 1.0 <= capacity < np.inf:
        raise OutOfRange("full well", capacity, 1.0, np.inf)
    for first, past, _ in segments:
        if not 0 <= first <= past <= len(frame):
            raise OutOfRange("rows of a column", first if first < 0 else past, 0, len(frame))
    out = np.array(frame, dtype=np.float64, order="C")
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
    """Bleed one segment in place, with its serial register below row 0. Return the electrons lost."""
    n = segment.shape[0]
    down = np.empty(n)
    lost = 0.0
    for x in columns:
        carried = 0.0
        for y in range(n):
            charge = segment[y, x]
            # A pixel's excess splits evenly. Charge arriving from below continues upwards.
            excess = max(charge - full, 0.0)
            upwards = np.ceil(0.5 * excess)
            down[y] = excess - upwards
            charge = charge - excess + carried
            over = max(charge - full, 0.0)
            segment[y, x] = charge - over
            carried = over + upwards
        # The far end turns the remaining upward flow back.
        for y in range(n - 1, -1, -1):
            charge = segment[y, x] + carried
            over = max(charge - full, 0.0)
            segment[y, x] = charge - over
            carried = over + down[y]
        lost += carried
    return lost


def saturated_pixels(frame: Frame, capacity: float) -> Bool:
    """Return a mask of the pixels at full well.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Electrons.
    capacity : float
        Full well in electrons.

    Returns
    -------
    bool array, shape (ny, nx)
    """
    return np.asarray(frame >= np.floor(capacity))


def full_well(scene: Scene) -> float:
    """Return the full well of the scene's detector in electrons."""
    return scene.value("full_well", "electron")


def _contribution(scene: Scene) -> float:
    """Return the electrons above full well in the brightest pixel."""
    return max(scene.brightest_electrons - full_well(scene), 0.0)


EFFECT = Effect("bleeding", apply, lambda scene: (full_well(scene), scene.column_segments), _contribution, cost=5e-3)
