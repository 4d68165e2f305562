"""Brighter-fatter: electrons that lie in a pixel repel those that come, so that its borders move in.

A border is displaced by what lies around it, in proportion; the charge that would have crossed the strip goes to the
other side. Charge only changes places. Displacements grow while the exposure lasts: on average they are half the final.

Ref : Antilogus et al. 2014; Guyonnet et al. 2015
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jobs.compiling import jit
from jobs.render.effects.effect import Effect, Frame, Scene
from lake_schema.errors import OutOfRange

# Pixels to each side that a border feels.
REACH = 2
# Of a pixel's charge, the part that can leave it over one border: strips are thin.
MOST = 0.2


def apply(frame: Frame, shift: float, softening: float, capacity: float, rng: np.random.Generator) -> Frame:
    """frame [ny, nx] whole e- >= 0 -> whole e- >= 0, the same sum.

    shift     : pixels that one electron displaces each border of its own pixel
    softening : pixels, depth of the charge below the borders: how fast the displacement falls off
    capacity  : e-; what a pixel cannot hold does not repel either
    """
    if not 0.0 <= shift <= 1e-4:
        raise OutOfRange("brighter-fatter shift", shift, 0.0, 1e-4)
    if not 1.0 <= capacity <= 1e9:
        raise OutOfRange("full well", capacity, 1.0, 1e9)
    out = np.array(frame, dtype=float, order="C")
    if shift == 0.0 or out.size == 0 or out.max() <= 0.0:
        return out
    # In single precision: whole electrons below 2^24 are exact, and what crosses to 1e-7 of it.
    held = np.pad(np.minimum(out, capacity, dtype=np.float32, casting="same_kind"), REACH, mode="edge")
    weights = kernel(shift, softening).astype(np.float32)
    for down in (False, True):
        # What crosses is a whole number of electrons, right in the mean.
        dice = rng.random(out.shape, dtype=np.float32)
        _cross(held, out, weights, dice, down)
        del dice
    return out


def kernel(shift: float, softening: float) -> Frame:
    """Displacement of a border by one electron: [2 REACH + 1, REACH] by distance along the border and across it.

    The field of a charge at a depth: d / (d^2 + along^2 + softening^2)^(3/2), d = 1/2, 3/2 ..
    """
    if not 0.0 <= softening <= 100.0:
        raise OutOfRange("brighter-fatter softening", softening, 0.0, 100.0)
    along, across = np.arange(-REACH, REACH + 1)[:, None], np.arange(REACH) + 0.5
    field = across / (across**2 + along**2 + softening**2) ** 1.5
    return np.asarray(shift * field / field[REACH, 0])


def curvature(shift: float, softening: float) -> float:
    """Variance of a flat field: mean (1 - curvature mean), to first order.  Own charge, four borders."""
    return 4.0 * float(kernel(shift, softening)[REACH, 0])


@jit
def _cross(held: Any, out: Any, weights: Any, dice: Any, down: bool) -> None:
    """Moves charge over the borders between neighbours in a row (or, `down`, in a column), in place.

    held : the charge that repels, with a margin of REACH pixels
    """
    ny, nx = out.shape
    last_row, last = (ny - 1, nx) if down else (ny, nx - 1)
    displaced, quarter = np.empty(last, np.float32), np.float32(0.25)
    for r in range(last_row):
        displaced[:] = 0.0
        for i in range(2 * REACH + 1):
            for j in range(REACH):
                # Pixels j from the border on this side, and on the other.
                if down:
                    near, far = held[r + REACH - j, i : i + last], held[r + REACH + 1 + j, i : i + last]
                else:
                    near, far = (
                        held[r + i, REACH - j : REACH - j + last],
                        held[r + i, REACH + 1 + j : REACH + 1 + j + last],
                    )
                weight = weights[i, j]
                for c in range(last):
                    displaced[c] += weight * (near[c] - far[c])
        here, there = held[r + REACH, REACH:], held[r + REACH + down, REACH + 1 - down :]
        for c in range(last):
            # The border moves towards the fuller side, on average by half: what falls into the strip changes sides.
            strip = quarter * displaced[c] * (here[c] + there[c])
            moved = np.floor(strip + dice[r, c])
            giver = out[r, c] if moved > 0.0 else out[r + down, c + 1 - down]
            if abs(moved) > MOST * giver:
                moved = np.floor(MOST * giver) * (1.0 if moved > 0.0 else -1.0)
            out[r, c] -= moved
            out[r + down, c + 1 - down] += moved


def _parameters(scene: Scene) -> tuple[float, float, float]:
    return (
        scene.value("bfe.shift", "pix / electron"),
        scene.value("bfe.softening", "pix"),
        scene.value("full_well", "electron"),
    )


def _contribution(scene: Scene) -> float:
    shift, _, capacity = _parameters(scene)
    full = min(scene.peak_electrons, capacity) + scene.sky_electrons
    # Four borders, half the final displacement, two thirds of the light at a border: 1.2 of this for a VIS star.
    return 1.5 * shift * full**2


EFFECT = Effect("brighter_fatter", apply, _parameters, _contribution, cost=4e-2)
