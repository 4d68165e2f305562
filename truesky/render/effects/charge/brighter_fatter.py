"""Brighter-fatter effect: charge in a pixel repels charge that arrives later, so that pixel borders move.

The displacement of a border is proportional to the charge in the pixels around it. The charge in the strip between the
old and the new border moves to the neighbouring pixel, so that the total charge is conserved. Displacements grow during
the exposure, and their mean is half of the final displacement. Borders between columns are fixed by implants (channel
stops), and those between rows by voltages only: charge displaces borders between rows more, so that neighbours in a
column have a larger covariance than neighbours in a row.

In VIS, the charge-injection rows between the two halves of the detector are drained and hold no charge. The halves
therefore do not affect each other. The row of each half next to the drained rows loses a strip of its charge to them:
1 % in a flat with 1e5 electrons per pixel. Pixels outside the detector are assumed to hold the same charge as the
nearest pixel of it.

References
----------
Antilogus et al. 2014, JINST 9, C03048; Guyonnet et al. 2015, A&A 575, A41; Astier et al. 2019, A&A 629, A36
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lake_schema.errors import OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.effects import pixel_random
from truesky.render.effects.effect import Effect, copy_frame
from truesky.render.effects.scene import Frame, Scene

# A border between two pixels is displaced by the charge of this number of pixels on each side of it, and of pixels up
# to this number of pixels farther along the border.
REACH = 2
# Number of neighbouring pixels of a row (a block) that are treated together. Blocks are skipped if their charge is too
# small to move a border noticeably.
_BLOCK = 64
# Relative growth of the squared size R^2 of a star in VIS, divided by the displacement of a border per electron (pixels
# per electron) and by the electrons of the star's brightest pixel. A Gaussian with an rms of 0.7 pixels and a peak of
# 2e5 electrons gives 1.0 (mean of 50 realisations). The rest is a safety margin.
_R2_GROWTH = 1.25
# Largest fraction of a pixel's charge that can cross one border. More is limited to this, because the model holds only
# if a border moves by a small part of a pixel.
MAX_CROSSING = 0.2


def apply(
    frame: Frame,
    shifts: tuple[float, float],
    softening: float,
    capacity: float,
    threshold: float,
    gap: int,
    rng: np.random.Generator,
    out: Frame | None = None,
) -> Frame:
    """Move charge between neighbouring pixels in proportion to the charge around their common border.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Whole electrons, 0 or more.
    shifts : (float, float)
        Displacement of a border between columns and of a border between rows, towards the centre of the pixel, by one
        electron in this pixel, in pixels per electron, 0 to 1e-4.
    softening : float
        Depth of the stored charge below the surface at which borders are measured, in pixels, 0 to 100. See `kernel`.
    capacity : float
        Full well in electrons, 1 to 1e9. Charge above the full well does not repel.
    threshold : float
        Electrons below which charge does not matter, 0 or more. The borders of a block of 64 neighbouring pixels of a
        row do not move if all pixels in this block, in the next one and in the rows around are below it.
    gap : int
        Number of drained rows between the two halves of the detector, 0 or more.
    rng : numpy.random.Generator
        Random generator, used to round the moved charge to whole electrons without bias.
    out : float64 array, shape of `frame`, optional
        Array for the result, which may be `frame` itself. By default a new array.

    Returns
    -------
    float array, shape (ny, nx)
        Electrons, whole numbers with the same sum as the input.

    Raises
    ------
    OutOfRange
        If a shift, `softening`, `capacity` or `threshold` is outside its limits or NaN.
    """
    for name, value, low, high in (
        *(("brighter-fatter shift", shift, 0.0, 1e-4) for shift in shifts), ("full well", capacity, 1.0, 1e9),
        ("brighter-fatter threshold", threshold, 0.0, np.inf),
    ):  # fmt: skip
        if not low <= value <= high:
            raise OutOfRange(name, value, low, high)
    out = copy_frame(frame, out)
    if max(shifts) == 0.0 or out.size == 0 or out.max() <= 0.0:
        return out
    # Use single precision: it is exact for whole electrons below 2^24, and the moved charge has a relative error of
    # 1e-7.
    charge = np.empty((out.shape[0] + 2 * REACH, out.shape[1] + 2 * REACH), np.float32)
    np.minimum(out, capacity, out=charge[REACH:-REACH, REACH:-REACH], casting="same_kind")
    for padded in (charge, charge.T):
        padded[:REACH], padded[-REACH:] = padded[REACH], padded[-REACH - 1]
    gap_start = (len(out) - gap) // 2
    charge[REACH + gap_start : REACH + gap_start + gap] = 0.0
    # Highest charge in each block of `_BLOCK` pixels of a row. A last column of zeros is the neighbour of the last
    # block.
    block_max = np.zeros((len(charge), -(-charge.shape[1] // _BLOCK) + 1), np.float32)
    _find_block_max(charge.view(np.int32), block_max.view(np.int32))
    for vertical, shift in zip((False, True), shifts, strict=True):
        weights = kernel(shift, softening).astype(np.float32)
        _move_charge(charge, block_max, out, weights, pixel_random.draw_key(rng), vertical, threshold, gap_start, gap)
    return out


def kernel(shift: float, softening: float) -> Frame:
    """Return the displacement of a pixel border by one electron in each of the pixels around it.

    Parameters
    ----------
    shift : float
        Displacement of a border by one electron in an adjacent pixel, in pixels.
    softening : float
        Depth of the charge below the surface at which borders are measured, in pixels, 0 to 100.

    Returns
    -------
    float array, shape (2 REACH + 1, REACH)
        Displacement in pixels towards the side of the electron, for the pixels on one side of the border. The rows are
        the distances along the border, -REACH to REACH; the columns are the distances from it, 0.5, 1.5, ... pixels.

    Raises
    ------
    OutOfRange
        If `softening` is outside its limits or NaN.

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


def border_shifts(shift: float, ratio: float) -> tuple[float, float]:
    """Return the displacements of a border between columns and of one between rows from their mean.

    Parameters
    ----------
    shift : float
        Mean displacement by one electron in an adjacent pixel, in pixels.
    ratio : float
        Displacement of borders between rows, divided by that of borders between columns, more than 0.

    Returns
    -------
    (float, float)
        Displacement of borders between columns and of borders between rows by one electron, in pixels.
    """
    between_columns = 2.0 * shift / (1.0 + ratio)
    return between_columns, ratio * between_columns


def covariance_slopes(shifts: tuple[float, float], softening: float) -> tuple[float, float]:
    """Return the covariances of neighbours in a flat field, divided by the squared mean in electrons.

    Parameters
    ----------
    shifts : (float, float)
        Displacement of a border between columns and of one between rows by one electron in an adjacent pixel, in
        pixels.
    softening : float
        Depth of the charge below the surface at which borders are measured, in pixels, 0 to 100.

    Returns
    -------
    (float, float)
        Covariance of neighbours in a row (serial direction) and of neighbours in a column (parallel direction) in
        1/electron, valid to first order in the mean. It is the change of a pixel's area by one electron in the
        neighbour: the common border moves away, the opposite one and the two others move into the pixel.
    """
    (common_border, opposite_border), side_border = kernel(1.0, softening)[REACH], kernel(1.0, softening)[REACH + 1, 0]
    across, along = float(common_border - opposite_border), float(2.0 * side_border)
    between_columns, between_rows = shifts
    return across * between_columns - along * between_rows, across * between_rows - along * between_columns


def variance_slope(shifts: tuple[float, float], softening: float) -> float:
    """Return the relative loss of variance in a flat field, per electron of its mean, by the brighter-fatter effect.

    Parameters
    ----------
    shifts : (float, float)
        Displacement of a border between columns and of one between rows by one electron in an adjacent pixel, in
        pixels.
    softening : float
        Depth of the charge below the surface at which borders are measured, in pixels, 0 to 100.

    Returns
    -------
    float
        Value c (1/electron) of the formula variance = mean (1 - c mean). It is valid to first order in the mean. Only
        the charge of the pixel itself contributes, through its four borders.
    """
    return sum(2.0 * float(kernel(shift, softening)[REACH, 0]) for shift in shifts)


@jit
def _move_charge(
    charge: Any, block_max: Any, out: Any, weights: Any, key: Any, vertical: bool, threshold: float, gap_start: int,
    gap: int,
) -> None:  # fmt: skip
    """Move charge in `out` across the borders between neighbours in a row (or in a column, if `vertical`), in place.

    `charge` is the charge that repels in electrons, with a margin of REACH pixels on each side. `weights` is the
    displacement of a border in pixels by one electron, the result of `kernel`. Blocks of `_BLOCK` pixels are skipped if
    `block_max`, the highest charge in the blocks around, is below `threshold` (electrons). The `gap` rows from
    `gap_start` on are drained. Random bits for rounding come from `key`.
    """
    ny, nx = out.shape
    n_rows, n_columns = (ny - 1, nx) if vertical else (ny, nx - 1)
    displacements = np.empty(_BLOCK, np.float32)
    for r in range(n_rows):
        for block in range((n_columns + _BLOCK - 1) // _BLOCK):
            # Test this block of pixels and the next one: borders near the end of a block also depend on pixels of the
            # next.
            if block_max[r : r + 2 * REACH + 1 + vertical, block : block + 2].max() < threshold:
                continue
            first = block * _BLOCK
            displacement = displacements[: min(_BLOCK, n_columns - first)]
            _compute_displacement(charge, weights, vertical, r, first, displacement)
            side_1, side_2 = (
                charge[r + REACH, first + REACH :],
                charge[r + REACH + vertical, first + REACH + 1 - vertical :],
            )
            # Next to the drained rows, take the charge of the strip from the row that holds charge.
            if vertical and gap and r + 1 == gap_start:
                side_2 = side_1
            if vertical and gap and r + 1 == gap_start + gap:
                side_1 = side_2
            giver, taker = out[r, first:], out[r + vertical, first + 1 - vertical :]
            for c in range(len(displacement)):
                # The strip has the mean charge of both pixels (a factor 1/2), and a width of the mean displacement
                # during the exposure (half of the final displacement, another factor 1/2).
                strip = np.float32(0.25) * displacement[c] * (side_1[c] + side_2[c])
                # Round at random to a whole number of electrons, so that the mean is correct.
                moved = np.floor(strip + pixel_random.uniform(pixel_random.pixel_bits(key, r * nx + first + c)))
                limit = np.floor(MAX_CROSSING * (giver[c] if moved > 0.0 else taker[c]))
                moved = min(max(moved, -limit), limit)
                giver[c] -= moved
                taker[c] += moved


@jit
def _find_block_max(bits: Any, block_max: Any) -> None:
    """Fill `block_max` with the highest charge of each block of `_BLOCK` pixels in each row.

    `bits` is the charge of the pixels. Both arrays contain float32 numbers whose bits are read as int32, because
    comparing integers is faster and non-negative numbers have the same order. Negative numbers count as 0.
    """
    for r in range(len(bits)):
        for block in range(block_max.shape[1] - 1):
            pixels, highest = bits[r, block * _BLOCK : (block + 1) * _BLOCK], np.int32(0)
            for c in range(len(pixels)):
                highest = max(highest, pixels[c])
            block_max[r, block] = highest


@jit
def _compute_displacement(charge: Any, weights: Any, vertical: bool, r: int, first: int, displacement: Any) -> None:
    """Fill `displacement` with the displacement of pixel borders at the end of the exposure, in pixels.

    The borders are between each pixel of row `r`, from column `first` on, and its neighbour in the next column. If
    `vertical`, the neighbour is in the next row. A positive displacement makes the pixel smaller and its neighbour
    larger. `charge` is the charge that repels in electrons, with a margin of REACH pixels on each side. `weights` is
    the displacement in pixels by one electron, the result of `kernel`.
    """
    displacement[:] = np.float32(0.0)
    for i in range(2 * REACH + 1):
        for j in range(REACH):
            # Pixels at the distance j + 1/2 from the border, on the side of the pixel itself and on the side of its
            # neighbour.
            if vertical:
                side_1, side_2 = charge[r + REACH - j, first + i :], charge[r + REACH + 1 + j, first + i :]
            else:
                side_1, side_2 = charge[r + i, first + REACH - j :], charge[r + i, first + REACH + 1 + j :]
            weight = weights[i, j]
            for c in range(len(displacement)):
                displacement[c] += weight * (side_1[c] - side_2[c])


def _parameters(scene: Scene) -> tuple[tuple[float, float], float, float, float, int]:
    softening = scene.value("bfe.softening", "pix")
    shifts = border_shifts(scene.value("bfe.shift", "pix / electron"), scene.value("bfe.shift_ratio", ""))
    # Use the larger displacement of both directions for the threshold.
    shift = max(shifts)
    # If all pixels hold n electrons, at most sum(kernel) n x 2 n / 4 electrons cross a border, and a pixel has four
    # borders. The borders of a block of pixels do not move if all pixels around have less charge than `threshold`. The
    # threshold is so low that the neglected charge is below the accepted error of the background, and the neglected
    # growth of a star below the accepted error of shapes.
    max_noise = scene.accuracy.background * scene.pixel_noise / 4.0
    threshold = min(
        np.sqrt(2.0 * max_noise / max(float(kernel(shift, softening).sum()), 1e-30)),
        scene.accuracy.shape / (_R2_GROWTH * max(shift, 1e-30)),
    )
    return shifts, softening, scene.full_well, float(threshold), scene.injection_rows


def _contribution(scene: Scene) -> float:
    shifts, _, capacity, *_ = _parameters(scene)
    peak = min(scene.peak_electrons, capacity) + scene.sky_electrons
    # The brightest pixel of a star in VIS loses 1.2 shift peak^2 electrons: four borders, half of the final
    # displacement, and two thirds of the peak's charge at a border. The factor 1.5 includes a safety margin.
    return 1.5 * 0.5 * sum(shifts) * peak**2


EFFECT = Effect("brighter_fatter", apply, _parameters, _contribution, cost=1e-2, in_place=True)
