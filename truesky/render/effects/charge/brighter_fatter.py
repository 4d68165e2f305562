"""Brighter-fatter effect: charge in a pixel repels charge that arrives later, so that pixel borders move.

The displacement of a border is proportional to the charge around it. Charge in the strip between the old and the new
border changes pixels; the total is conserved. Displacements grow during the exposure, so on average they are half the
final ones.

In VIS, the charge-injection rows between the two halves are drained and hold no charge. The halves therefore do not
affect each other, and the last row of each half loses a strip whose width grows with its charge: 1 % of a flat with
1e5 electrons per pixel. Outside the detector the charge of its outermost pixels is assumed to continue.

References
----------
Antilogus et al. 2014, JINST 9, C03048; Guyonnet et al. 2015, A&A 575, A41
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lake_schema.errors import OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.effects import pixel_random
from truesky.render.effects.effect import Effect
from truesky.render.effects.scene import Frame, Scene

# Pixels on each side of a border whose charge displaces it.
REACH = 2
# Pixels per block of a row. Blocks without enough charge are skipped.
_BLOCK = 64
# Relative growth of a VIS star's size R^2, per unit of `shift` and per electron in its peak pixel. A Gaussian with an
# rms of 0.7 pixels and a peak of 2e5 electrons gives 1.0 (mean of 50 realisations); the rest is a safety margin.
_R2_GROWTH = 1.25
# Largest fraction of a pixel's charge that can cross one border. The model holds for narrow strips only.
MAX_CROSSING = 0.2


def apply(
    frame: Frame, shift: float, softening: float, capacity: float, threshold: float, gap: int, rng: np.random.Generator
) -> Frame:
    """Move charge between neighbouring pixels in proportion to the charge around their common border.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Whole electrons, 0 or more.
    shift : float
        Displacement, in pixels, of each border of a pixel by one electron in that pixel, 0 to 1e-4.
    softening : float
        Depth of the stored charge below the borders in pixels, 0 to 100. See `kernel`.
    capacity : float
        Full well in electrons, 1 to 1e9. Charge above it does not repel.
    threshold : float
        A border is not moved if all pixels around it hold fewer electrons than this.
    gap : int
        Number of drained rows between the two halves of the detector.
    rng : numpy.random.Generator
        Random numbers for rounding to whole electrons.

    Returns
    -------
    float array, shape (ny, nx)
        Whole electrons with the same sum.

    Raises
    ------
    OutOfRange
        If a parameter is outside its limits.
    """
    for name, value, low, high in (
        ("brighter-fatter shift", shift, 0.0, 1e-4), ("full well", capacity, 1.0, 1e9),
        ("brighter-fatter threshold", threshold, 0.0, np.inf),
    ):  # fmt: skip
        if not low <= value <= high:
            raise OutOfRange(name, value, low, high)
    out = np.array(frame, dtype=float, order="C")
    if shift == 0.0 or out.size == 0 or out.max() <= 0.0:
        return out
    # Single precision is exact for whole electrons below 2^24, and its error of the moved charge is 1e-7.
    charge = np.empty((out.shape[0] + 2 * REACH, out.shape[1] + 2 * REACH), np.float32)
    np.minimum(out, capacity, out=charge[REACH:-REACH, REACH:-REACH], casting="same_kind")
    for padded in (charge, charge.T):
        padded[:REACH], padded[-REACH:] = padded[REACH], padded[-REACH - 1]
    gap_start = (len(out) - gap) // 2
    charge[REACH + gap_start : REACH + gap_start + gap] = 0.0
    weights = kernel(shift, softening).astype(np.float32)
    # Highest charge in each block. The extra last column stays 0: it is read as the neighbour of the last block.
    block_max = np.zeros((len(charge), -(-charge.shape[1] // _BLOCK) + 1), np.float32)
    _find_block_max(charge.view(np.int32), block_max.view(np.int32))
    for vertical in (False, True):
        _move_charge(charge, block_max, out, weights, pixel_random.draw_key(rng), vertical, threshold, gap_start, gap)
    return out


def kernel(shift: float, softening: float) -> Frame:
    """Displacement of a border by one electron in each pixel around it.

    Parameters
    ----------
    shift : float
        Displacement, in pixels, by one electron in the adjacent pixel.
    softening : float
        Depth of the charge below the border in pixels, 0 to 100.

    Returns
    -------
    float array, shape (2 REACH + 1, REACH)
        Displacement in pixels by distance along the border (rows, -REACH to REACH) and across it (columns).

    Raises
    ------
    OutOfRange
        If `softening` is outside its limits.

    Notes
    -----
    The displacement follows the field of a point charge below the surface::

        a(d, l) = shift * f(d, l) / f(1/2, 0),    f(d, l) = d / (d^2 + l^2 + softening^2)^(3/2)

    with the distance d = 1/2, 3/2, ... across the border and l = 0, 1, ... along it, in pixels.
    """
    if not 0.0 <= softening <= 100.0:
        raise OutOfRange("brighter-fatter softening", softening, 0.0, 100.0)
    along, across = np.arange(-REACH, REACH + 1)[:, None], np.arange(REACH) + 0.5
    field = across / (across**2 + along**2 + softening**2) ** 1.5
    return np.asarray(shift * field / field[REACH, 0])


def variance_slope(shift: float, softening: float) -> float:
    """Relative loss of variance in a flat field, per electron of its mean.

    Parameters
    ----------
    shift, softening : float
        Same as in `kernel`.

    Returns
    -------
    float
        The value c (1/electron) in variance = mean (1 - c mean), to first order in the mean. Only the charge of the
        pixel itself and its four borders contribute.
    """
    return 4.0 * float(kernel(shift, softening)[REACH, 0])


@jit
def _move_charge(
    charge: Any, block_max: Any, out: Any, weights: Any, key: Any, vertical: bool, threshold: float, gap_start: int,
    gap: int,
) -> None:  # fmt: skip
    """Move charge across the borders between neighbours in a row (or in a column, if `vertical`) in place.

    `charge` is the repelling charge with a margin of REACH pixels on each side. The rows from `gap_start` to
    `gap_start + gap` are drained.
    """
    ny, nx = out.shape
    n_rows, n_columns = (ny - 1, nx) if vertical else (ny, nx - 1)
    displacements = np.empty(_BLOCK, np.float32)
    for r in range(n_rows):
        for block in range((n_columns + _BLOCK - 1) // _BLOCK):
            # Borders near the end of a block also depend on pixels of the next one.
            if block_max[r : r + 2 * REACH + 1 + vertical, block : block + 2].max() < threshold:
                continue
            first = block * _BLOCK
            displacement = displacements[: min(_BLOCK, n_columns - first)]
            _compute_displacement(charge, weights, vertical, r, first, displacement)
            side_1, side_2 = (
                charge[r + REACH, first + REACH :],
                charge[r + REACH + vertical, first + REACH + 1 - vertical :],
            )
            # Next to the drained rows, the strip lies in the row that holds charge.
            if vertical and gap and r + 1 == gap_start:
                side_2 = side_1
            if vertical and gap and r + 1 == gap_start + gap:
                side_1 = side_2
            giver, taker = out[r, first:], out[r + vertical, first + 1 - vertical :]
            for c in range(len(displacement)):
                # Mean charge of both pixels (1/2) times the mean displacement during the exposure (1/2).
                strip = np.float32(0.25) * displacement[c] * (side_1[c] + side_2[c])
                # Stochastic rounding: whole electrons, correct on average.
                moved = np.floor(strip + pixel_random.uniform(pixel_random.pixel_bits(key, r * nx + first + c)))
                limit = np.floor(MAX_CROSSING * (giver[c] if moved > 0.0 else taker[c]))
                moved = min(max(moved, -limit), limit)
                giver[c] -= moved
                taker[c] += moved


@jit
def _find_block_max(bits: Any, block_max: Any) -> None:
    """Find the maximum of each block of pixels in each row.

    Floats are compared by their bits as integers, which preserves the order of non-negative numbers and is faster.
    """
    for r in range(len(bits)):
        for block in range(block_max.shape[1] - 1):
            pixels, highest = bits[r, block * _BLOCK : (block + 1) * _BLOCK], np.int32(0)
            for c in range(len(pixels)):
                highest = max(highest, pixels[c])
            block_max[r, block] = highest


@jit
def _compute_displacement(charge: Any, weights: Any, vertical: bool, r: int, first: int, displacement: Any) -> None:
    """Fill `displacement` with the final displacements of the borders in row `r` from column `first`."""
    displacement[:] = np.float32(0.0)
    for i in range(2 * REACH + 1):
        for j in range(REACH):
            # Pixels at distance j + 1/2 on the near and the far side of the border.
            if vertical:
                side_1, side_2 = charge[r + REACH - j, first + i :], charge[r + REACH + 1 + j, first + i :]
            else:
                side_1, side_2 = charge[r + i, first + REACH - j :], charge[r + i, first + REACH + 1 + j :]
            weight = weights[i, j]
            for c in range(len(displacement)):
                displacement[c] += weight * (side_1[c] - side_2[c])


def _parameters(scene: Scene) -> tuple[float, float, float, float, int]:
    shift, softening = scene.value("bfe.shift", "pix / electron"), scene.value("bfe.softening", "pix")
    # Among pixels with n electrons each, at most sum(kernel) n x 2 n / 4 electrons cross a border; a pixel has four.
    # The threshold keeps this below the accepted background noise, and the growth of a star below the accepted error.
    max_noise = scene.accuracy.background * scene.pixel_noise / 4.0
    threshold = min(
        np.sqrt(2.0 * max_noise / max(float(kernel(shift, softening).sum()), 1e-30)),
        scene.accuracy.shape / (_R2_GROWTH * max(shift, 1e-30)),
    )
    return shift, softening, scene.value("full_well", "electron"), float(threshold), scene.injection_rows


def _contribution(scene: Scene) -> float:
    shift, _, capacity, *_ = _parameters(scene)
    peak = min(scene.peak_electrons, capacity) + scene.sky_electrons
    # Four borders, half the final displacement and two thirds of the peak at a border give 1.2 for a VIS star.
    return 1.5 * shift * peak**2


EFFECT = Effect("brighter_fatter", apply, _parameters, _contribution, cost=1e-2)
