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
_BLOCK = 64
# Of R^2 of a VIS star: it grows by so many times the shift for each electron of its brightest pixel. A Gaussian of 0.7
# pixels rms, 2e5 electrons high, grows by 1.0 (mean of 50); the rest is safety.
_R2_GROWTH = 1.25
# Of a pixel's charge, the part that can leave it over one border: strips are thin.
MAX_CROSSING = 0.2


def apply(
    frame: Frame, shift: float, softening: float, capacity: float, threshold: float, gap: int, rng: np.random.Generator
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
        ("brighter-fatter dim", threshold, 0.0, np.inf),
    ):  # fmt: skip
        if not low <= value <= high:
            raise OutOfRange(name, value, low, high)
    out = np.array(frame, dtype=float, order="C")
    if shift == 0.0 or out.size == 0 or out.max() <= 0.0:
        return out
    # In single precision: whole electrons below 2^24 are exact, and what crosses to 1e-7 of it.
    charge = np.empty((out.shape[0] + 2 * REACH, out.shape[1] + 2 * REACH), np.float32)
    np.minimum(out, capacity, out=charge[REACH:-REACH, REACH:-REACH], casting="same_kind")
    for padded in (charge, charge.T):
        padded[:REACH], padded[-REACH:] = padded[REACH], padded[-REACH - 1]
    gap_start = (len(out) - gap) // 2
    charge[REACH + gap_start : REACH + gap_start + gap] = 0.0
    weights = kernel(shift, softening).astype(np.float32)
    # Of each run of pixels, and none after the last.
    block_max = np.zeros((len(charge), -(-charge.shape[1] // _BLOCK) + 1), np.float32)
    _find_block_max(charge.view(np.int32), block_max.view(np.int32))
    for vertical in (False, True):
        _move_charge(charge, block_max, out, weights, pixel_random.draw_key(rng), vertical, threshold, gap_start, gap)
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


def variance_slope(shift: float, softening: float) -> float:
    """Variance of a flat field: mean (1 - curvature mean), to first order.  Own charge, four borders."""
    return 4.0 * float(kernel(shift, softening)[REACH, 0])


@jit
def _move_charge(
    charge: Any,
    block_max: Any,
    out: Any,
    weights: Any,
    key: Any,
    vertical: bool,
    threshold: float,
    gap_start: int,
    gap: int,
) -> None:
    """Moves charge over the borders between neighbours in a row (or, `down`, in a column), in place.

    held : the charge that repels, with a margin of REACH pixels, and most [row, run] of it
    dim  : nothing crosses where all of it is less
    drained, between : first of the rows that hold nothing, and how many they are
    """
    ny, nx = out.shape
    n_rows, n_columns = (ny - 1, nx) if vertical else (ny, nx - 1)
    displacements = np.empty(_BLOCK, np.float32)
    for r in range(n_rows):
        for block in range((n_columns + _BLOCK - 1) // _BLOCK):
            # A border feels the margin, too: it lies in the next run.
            if block_max[r : r + 2 * REACH + 1 + vertical, block : block + 2].max() < threshold:
                continue
            first = block * _BLOCK
            displacement = displacements[: min(_BLOCK, n_columns - first)]
            _compute_displacement(charge, weights, vertical, r, first, displacement)
            side_1, side_2 = (
                charge[r + REACH, first + REACH :],
                charge[r + REACH + vertical, first + REACH + 1 - vertical :],
            )
            # The strip lies in the row that holds charge.
            if vertical and gap and r + 1 == gap_start:
                side_2 = side_1
            if vertical and gap and r + 1 == gap_start + gap:
                side_1 = side_2
            giver, taker = out[r, first:], out[r + vertical, first + 1 - vertical :]
            for c in range(len(displacement)):
                # The border moves towards the fuller side, on average by half: what falls into the strip changes sides.
                strip = np.float32(0.25) * displacement[c] * (side_1[c] + side_2[c])
                # What crosses is a whole number of electrons, right in the mean.
                moved = np.floor(strip + pixel_random.uniform(pixel_random.pixel_bits(key, r * nx + first + c)))
                limit = np.floor(MAX_CROSSING * (giver[c] if moved > 0.0 else taker[c]))
                moved = min(max(moved, -limit), limit)
                giver[c] -= moved
                taker[c] += moved


@jit
def _find_block_max(bits: Any, block_max: Any) -> None:
    """Of each run of pixels of each row; by their bits, which are in the order of the numbers >= 0 they stand for."""
    for r in range(len(bits)):
        for block in range(block_max.shape[1] - 1):
            pixels, highest = bits[r, block * _BLOCK : (block + 1) * _BLOCK], np.int32(0)
            for c in range(len(pixels)):
                highest = max(highest, pixels[c])
            block_max[r, block] = highest


@jit
def _compute_displacement(charge: Any, weights: Any, vertical: bool, r: int, first: int, displacement: Any) -> None:
    """Of the borders of a row from a pixel on."""
    displacement[:] = np.float32(0.0)
    for i in range(2 * REACH + 1):
        for j in range(REACH):
            # Pixels j from the border on this side, and on the other.
            if vertical:
                side_1, side_2 = charge[r + REACH - j, first + i :], charge[r + REACH + 1 + j, first + i :]
            else:
                side_1, side_2 = charge[r + i, first + REACH - j :], charge[r + i, first + REACH + 1 + j :]
            weight = weights[i, j]
            for c in range(len(displacement)):
                displacement[c] += weight * (side_1[c] - side_2[c])


def _parameters(scene: Scene) -> tuple[float, float, float, float, int]:
    shift, softening = scene.value("bfe.shift", "pix / electron"), scene.value("bfe.softening", "pix")
    # Over a border between pixels of n e- at most sum(kernel) n x 2 n / 4 cross; a pixel has four.
    max_noise = scene.accuracy.background * scene.pixel_noise / 4.0
    threshold = min(
        np.sqrt(2.0 * max_noise / max(float(kernel(shift, softening).sum()), 1e-30)),
        scene.accuracy.shape / (_R2_GROWTH * max(shift, 1e-30)),
    )
    return shift, softening, scene.value("full_well", "electron"), float(threshold), scene.injection_rows


def _contribution(scene: Scene) -> float:
    shift, _, capacity, *_ = _parameters(scene)
    peak = min(scene.peak_electrons, capacity) + scene.sky_electrons
    # Four borders, half the final displacement, two thirds of the light at a border: 1.2 of this for a VIS star.
    return 1.5 * shift * peak**2


EFFECT = Effect("brighter_fatter", apply, _parameters, _contribution, cost=1e-2)
