"""Full well and bleeding: what a pixel cannot hold flows along its column, half each way, until it finds room.

A column is one piece, or one of each amplifier that it passes. A piece ends at its serial register, where charge is
lost, and at the other end, where a stop turns it back: in VIS the rows of charge injection, in cameras that are read at
both ends the middle.

apply, EFFECT    the effect
bleed            the same, with the charge that was lost
saturated        the pixels that are full
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

Segments = Sequence[tuple[int, int, bool]]


def apply(frame: Frame, capacity: float, segments: Segments, rng: np.random.Generator | None = None) -> Frame:
    """frame [ny, nx] whole e- -> no pixel above `capacity`.

    capacity : of a pixel, e-;  rng : not used
    runs     : as of `bleed`
    """
    return bleed(frame, capacity, segments)[0]


def bleed(frame: Frame, capacity: float, segments: Segments) -> tuple[Frame, float]:
    """The frame after bleeding, and the electrons that left through the serial registers.

    frame    : float64[ny, nx] e- >= 0
    runs     : pieces of a column: first row, the one past the last, whether the register lies above; rows in none of
               them stay as they are
    capacity : of a pixel, e-
    Error    : 0: what was in is in the frame or lost; whole electrons stay whole
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
    """One piece of columns, its serial register below row 0, in place; returns what left it."""
    n = segment.shape[0]
    down = np.empty(n)
    lost = 0.0
    for x in columns:
        carried = 0.0
        for y in range(n):
            charge = segment[y, x]
            # Of its own excess half goes each way; what comes from below goes on upwards.
            excess = max(charge - full, 0.0)
            upwards = np.ceil(0.5 * excess)
            down[y] = excess - upwards
            charge = charge - excess + carried
            over = max(charge - full, 0.0)
            segment[y, x] = charge - over
            carried = over + upwards
        # The stop at the far end turns it back.
        for y in range(n - 1, -1, -1):
            charge = segment[y, x] + carried
            over = max(charge - full, 0.0)
            segment[y, x] = charge - over
            carried = over + down[y]
        lost += carried
    return lost


def saturated_pixels(frame: Frame, capacity: float) -> Bool:
    """Pixels [ny, nx] that hold all they can."""
    return np.asarray(frame >= np.floor(capacity))


def full_well(scene: Scene) -> float:
    """Electrons."""
    return scene.value("full_well", "electron")


def _contribution(scene: Scene) -> float:
    """What the brightest pixel has too many."""
    return max(scene.brightest_electrons - full_well(scene), 0.0)


EFFECT = Effect("bleeding", apply, lambda scene: (full_well(scene), scene.column_segments), _contribution, cost=5e-3)
