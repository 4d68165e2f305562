"""Brighter-fatter: electrons that lie in a pixel repel those that come, so that its borders move in.

A border is displaced by what lies around it, in proportion; the charge that would have crossed the strip goes to the
other side. Charge only changes places. Displacements grow while the exposure lasts: on average they are half the final.

The rows of charge injection between the halves hold none: what falls there is drained. So the halves do not feel each
other, and the last row of each loses a strip to them that is the wider the fuller it is: of a flat of 1e5 e- 1 %.
Beyond its outer borders a detector is taken to go on as it is there.

Ref : Antilogus et al. 2014; Guyonnet et al. 2015
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lake_schema.errors import OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.effects import pixel_random
from truesky.render.effects.effect import Effect
from truesky.render.effects.scene import Frame, Scene

# Pixels to each side that a border feels.
REACH = 2
# Pixels of a row that are looked at together.
_RUN = 64
# Of R^2 of a VIS star: it grows by so many times the shift for each electron of its brightest pixel. A Gaussian of 0.7
# pixels rms, 2e5 electrons high, grows by 1.0 (mean of 50); the rest is safety.
_GROWTH = 1.25
# Of a pixel's charge, the part that can leave it over one border: strips are thin.
MOST = 0.2


def apply(
    frame: Frame, shift: float, softening: float, capacity: float, dim: float, between: int, rng: np.random.Generator
) -> Frame:
    """frame [ny, nx] whole e- >= 0 -> whole e- >= 0, the same sum.

    shift     : pixels that one electron displaces each border of its own pixel
    softening : pixels, depth of the charge below the borders: how fast the displacement falls off
    capacity  : e-; what a pixel cannot hold does not repel either
    dim       : e-; borders about which no pixel holds as much are left as they are
    between   : rows between the halves, whose charge is drained
    rng       : random numbers of the whole electrons that cross a border
    """
    for name, value, low, high in (
        ("brighter-fatter shift", shift, 0.0, 1e-4), ("full well", capacity, 1.0, 1e9),
        ("brighter-fatter dim", dim, 0.0, np.inf),
    ):  # fmt: skip
        if not low <= value <= high:
            raise OutOfRange(name, value, low, high)
    out = np.array(frame, dtype=float, order="C")
    if shift == 0.0 or out.size == 0 or out.max() <= 0.0:
        return out
    # In single precision: whole electrons below 2^24 are exact, and what crosses to 1e-7 of it.
    held = np.empty((out.shape[0] + 2 * REACH, out.shape[1] + 2 * REACH), np.float32)
    np.minimum(out, capacity, out=held[REACH:-REACH, REACH:-REACH], casting="same_kind")
    for sides in (held, held.T):
        sides[:REACH], sides[-REACH:] = sides[REACH], sides[-REACH - 1]
    first = (len(out) - between) // 2
    held[REACH + first : REACH + first + between] = 0.0
    weights = kernel(shift, softening).astype(np.float32)
    # Of each run of pixels, and none after the last.
    most = np.zeros((len(held), -(-held.shape[1] // _RUN) + 1), np.float32)
    _highest(held.view(np.int32), most.view(np.int32))
    for down in (False, True):
        _cross(held, most, out, weights, pixel_random.key(rng), down, dim, first, between)
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
def _cross(
    held: Any, most: Any, out: Any, weights: Any, key: Any, down: bool, dim: float, drained: int, between: int
) -> None:
    """Moves charge over the borders between neighbours in a row (or, `down`, in a column), in place.

    held : the charge that repels, with a margin of REACH pixels, and most [row, run] of it
    dim  : nothing crosses where all of it is less
    drained, between : first of the rows that hold nothing, and how many they are
    """
    ny, nx = out.shape
    last_row, last = (ny - 1, nx) if down else (ny, nx - 1)
    displaced = np.empty(_RUN, np.float32)
    for r in range(last_row):
        for run in range((last + _RUN - 1) // _RUN):
            # A border feels the margin, too: it lies in the next run.
            if most[r : r + 2 * REACH + 1 + down, run : run + 2].max() < dim:
                continue
            first = run * _RUN
            some = displaced[: min(_RUN, last - first)]
            _displace(held, weights, down, r, first, some)
            here, there = held[r + REACH, first + REACH :], held[r + REACH + down, first + REACH + 1 - down :]
            # The strip lies in the row that holds charge.
            if down and between and r + 1 == drained:
                there = here
            if down and between and r + 1 == drained + between:
                here = there
            giver, taker = out[r, first:], out[r + down, first + 1 - down :]
            for c in range(len(some)):
                # The border moves towards the fuller side, on average by half: what falls into the strip changes sides.
                strip = np.float32(0.25) * some[c] * (here[c] + there[c])
                # What crosses is a whole number of electrons, right in the mean.
                moved = np.floor(strip + pixel_random.uniform(pixel_random.word(key, r * nx + first + c)))
                most_moved = np.floor(MOST * (giver[c] if moved > 0.0 else taker[c]))
                moved = min(max(moved, -most_moved), most_moved)
                giver[c] -= moved
                taker[c] += moved


@jit
def _highest(bits: Any, most: Any) -> None:
    """Of each run of pixels of each row; by their bits, which are in the order of the numbers >= 0 they stand for."""
    for r in range(len(bits)):
        for run in range(most.shape[1] - 1):
            line, highest = bits[r, run * _RUN : (run + 1) * _RUN], np.int32(0)
            for c in range(len(line)):
                highest = max(highest, line[c])
            most[r, run] = highest


@jit
def _displace(held: Any, weights: Any, down: bool, r: int, first: int, displaced: Any) -> None:
    """Of the borders of a row from a pixel on."""
    displaced[:] = np.float32(0.0)
    for i in range(2 * REACH + 1):
        for j in range(REACH):
            # Pixels j from the border on this side, and on the other.
            if down:
                near, far = held[r + REACH - j, first + i :], held[r + REACH + 1 + j, first + i :]
            else:
                near, far = held[r + i, first + REACH - j :], held[r + i, first + REACH + 1 + j :]
            weight = weights[i, j]
            for c in range(len(displaced)):
                displaced[c] += weight * (near[c] - far[c])


def _parameters(scene: Scene) -> tuple[float, float, float, float, int]:
    shift, softening = scene.value("bfe.shift", "pix / electron"), scene.value("bfe.softening", "pix")
    # Over a border between pixels of n e- at most sum(kernel) n x 2 n / 4 cross; a pixel has four.
    noise = scene.accuracy.background * scene.pixel_noise / 4.0
    dim = min(
        np.sqrt(2.0 * noise / max(float(kernel(shift, softening).sum()), 1e-30)),
        scene.accuracy.shape / (_GROWTH * max(shift, 1e-30)),
    )
    return shift, softening, scene.value("full_well", "electron"), float(dim), scene.middle


def _contribution(scene: Scene) -> float:
    shift, _, capacity, *_ = _parameters(scene)
    full = min(scene.peak_electrons, capacity) + scene.sky_electrons
    # Four borders, half the final displacement, two thirds of the light at a border: 1.2 of this for a VIS star.
    return 1.5 * shift * full**2


EFFECT = Effect("brighter_fatter", apply, _parameters, _contribution, cost=1e-2)
