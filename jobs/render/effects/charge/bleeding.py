"""Full well and bleeding: what a pixel cannot hold flows along its column, half each way, until it finds room.

Columns end in the middle of the detector, where the charge-injection rows stop the flow (it turns back), and at the
serial register, where it is lost.

apply, EFFECT    the effect
bleed            the same, with the charge that was lost
saturated        the pixels that are full
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jobs.compiling import jit
from jobs.render.effects.charge import full_well
from jobs.render.effects.effect import Effect
from jobs.render.effects.scene import Frame
from lake_schema.arrays import Bool
from lake_schema.errors import OutOfRange


def apply(
    frame: Frame, capacity: float, halves: int, between: int = 0, rng: np.random.Generator | None = None
) -> Frame:
    """frame [ny, nx] whole e- -> no pixel above `capacity`.

    capacity        : of a pixel, e-;  rng : not used
    halves, between : as of `bleed`
    """
    return bleed(frame, capacity, halves, between)[0]


def bleed(frame: Frame, capacity: float, halves: int, between: int = 0) -> tuple[Frame, float]:
    """The frame after bleeding, and the electrons that left through the serial registers.

    frame    : float64[ny, nx] e- >= 0;  halves : 2 = registers at both ends of the columns, 1 = at row 0 alone
    between  : rows between the halves, which stay as they are
    capacity : of a pixel, e-
    Error    : 0: what was in is in the frame or lost; whole electrons stay whole
    """
    if not 1.0 <= capacity < np.inf:
        raise OutOfRange("full well", capacity, 1.0, np.inf)
    if halves not in (1, 2):
        raise OutOfRange("halves of a column", halves, 1, 2)
    out = np.array(frame, dtype=np.float64, order="C")
    highest = out.max(axis=0, initial=0.0)
    if highest.max(initial=0.0) <= capacity:
        return out, 0.0
    full, ny = float(np.floor(capacity)), out.shape[0]
    middle = (ny - between + 1) // 2 if halves == 2 else ny
    columns = np.flatnonzero(highest > full)
    lost = _bleed(out[:middle], columns, full)
    upper = out[middle + between :][::-1]
    return out, lost + (_bleed(upper, columns, full) if len(upper) else 0.0)


@jit
def _bleed(half: Any, columns: Any, full: float) -> float:
    """One half, its serial register below row 0, in place; returns what left it."""
    n = half.shape[0]
    down = np.empty(n)
    lost = 0.0
    for x in columns:
        carried = 0.0
        for y in range(n):
            charge = half[y, x]
            # Of its own excess half goes each way; what comes from below goes on upwards.
            excess = max(charge - full, 0.0)
            upwards = np.ceil(0.5 * excess)
            down[y] = excess - upwards
            charge = charge - excess + carried
            over = max(charge - full, 0.0)
            half[y, x] = charge - over
            carried = over + upwards
        # The stop in the middle turns it back.
        for y in range(n - 1, -1, -1):
            charge = half[y, x] + carried
            over = max(charge - full, 0.0)
            half[y, x] = charge - over
            carried = over + down[y]
        lost += carried
    return lost


def saturated(frame: Frame, capacity: float) -> Bool:
    """Pixels [ny, nx] that hold all they can."""
    return np.asarray(frame >= np.floor(capacity))


EFFECT = Effect(
    "bleeding", apply, lambda scene: (full_well.capacity(scene), 2, scene.middle), full_well.contribution, cost=5e-3
)
