"""Compiled loops that add stamps to a frame in fixed point, and move aliased light to its correct position.

A stamp is periodic, so that light beyond its edges appears at the opposite edges. In all functions `profile` [m, 11]
contains rows of `galaxy_shapes.real_space_profile`, in electrons.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lake_schema.arrays import Array, Float, Int
from truesky.numerics.compiling import jit

# Units per electron in the frame's integers, a precision of 1e-6; and the binary logarithm of their largest sum, which
# leaves room for ringing.
FIXED_POINT, FULL = float(1 << 20), 61
# Number of a float's bits below a sixteenth of an octave; square of the radius at which a disc ends, in scale lengths.
_COARSE, _DARK = 19, 900.0
# Columns of `galaxy_shapes.real_space_profile`: light in the middle of the bulge and of the disc, first of four columns
# of the bulge's matrix, exponent of the bulge, first of four columns of the disc's matrix.
BULGE, DISK, BULGE_FORM, POWER, DISK_FORM = 0, 1, 2, 6, 7
# Aliased light is removed if its relative variation about the middle is below `_EVEN`, not at all above `_STEEP`, and
# gradually in between. The error of the response to shear was measured on stamps that are far too small (64 pixels,
# n = 3, half-light radius 10) for axis ratio 0.1. Relative to no removal, it is 2 without an upper limit, 1.6 with a
# sharp limit and 0.5 with the gradual one.
_EVEN, _STEEP = 1.0, 3.0
# The removal also fades if the terms cancel: if their light is less than this fraction of that of the middle's level.
_CANCELLED = 0.25


@jit
def min_singular_squared(form: Float) -> Any:
    """Square of the smaller singular value of a 2 x 2 matrix."""
    half = 0.5 * np.sum(form**2)
    determinant = form[0, 0] * form[1, 1] - form[0, 1] * form[1, 0]
    return determinant**2 / max(half + np.sqrt(max(half**2 - determinant**2, 0.0)), 1e-300)


@jit
def accumulate(
    frame: Int, stamps: Array, x0: Int, y0: Int, unread_rows: tuple[int, int], unit: float
) -> Int:  # fmt: skip
    """Add stamps to the frame, in integers, so that the sum does not depend on the order.

    Parameters
    ----------
    frame : int array, shape (ny, nx)
        Frame, changed in place.
    stamps : float array, shape (m, N, N)
        Stamps, electrons.
    x0, y0 : int array, shape (m,)
        Columns and rows of their lower left pixels.
    unread_rows : (int, int)
        First row that is not counted in the result, and the row after the last.
    unit : float
        Units per electron.

    Returns
    -------
    int array, shape (m,)
        Light of each stamp on the counted rows, in units.
    """
    ny, nx = frame.shape
    added = np.zeros(len(stamps), np.int64)
    for i in range(len(stamps)):
        first, stop = max(0, -x0[i]), min(stamps.shape[2], nx - x0[i])
        for r in range(max(0, -y0[i]), min(stamps.shape[1], ny - y0[i])):
            if first < stop:
                stamp_row, out = stamps[i, r, first:stop], frame[y0[i] + r, x0[i] + first : x0[i] + stop]
                total = np.int64(0)
                for c in range(len(stamp_row)):
                    units = np.int64(np.rint(np.float64(stamp_row[c]) * unit))
                    out[c] += units
                    total += units
                if not unread_rows[0] <= y0[i] + r < unread_rows[1]:
                    added[i] += total
    return added


@jit
def subtract_aliased(stamps: Array, x: Float, y: Float, curve: Float, removed: Float) -> None:
    """Subtract aliased light from stamps; no pixel becomes negative.

    Parameters
    ----------
    stamps : float array, shape (m, N, N)
        Stamps, changed in place.
    x, y : float array, shape (m,)
        Positions of the sources in their stamps, pixels.
    curve : float array, shape (m, 5)
        Result of `aliased_light`.
    removed : float array, shape (m,)
        Result: subtracted electrons.
    """
    for i in range(len(stamps)):
        removed[i] = 0.0
        if curve[i, 0] == 0.0:
            continue
        for r in range(stamps.shape[1]):
            up = r - y[i]
            level, slope = curve[i, 0] + curve[i, 3] * up * up, curve[i, 2] * up
            stamp_row = stamps[i, r]
            total = 0.0
            for c in range(len(stamp_row)):
                across = c - x[i]
                original = stamp_row[c]
                aliased = max(level + across * (slope + across * curve[i, 1]), 0.0)
                stamp_row[c] = original - min(aliased, max(np.float64(original), 0.0))
                total += np.float64(original) - np.float64(stamp_row[c])
            removed[i] += total


@jit
def aliased_light(size: Int, x: Float, y: Float, profile: Float, max_electrons: Float) -> Float:
    """Light that is aliased into stamps, as a polynomial of second order about the source.

    Parameters
    ----------
    size : int array, shape (m,)
        Sides of the stamps, pixels.
    x, y : float array, shape (m,)
        Positions of the sources in their stamps, pixels.
    profile : float array, shape (m, 11)
        Profiles of the galaxies.
    max_electrons : float array, shape (m,)
        Upper limit of the aliased light, electrons.

    Returns
    -------
    float array, shape (m, 5)
        Level in the middle, coefficients of x^2, x y and y^2, and sum over the stamp, electrons. All are 0 if the light
        varies too much for such a polynomial, as for steep, thin galaxies.

    Notes
    -----
    Within an eighth of the stamp from the middle, the error is 2 % for a round galaxy and a third for axis ratio 0.3.
    Farther out the result is too small.
    """
    out = np.zeros((len(profile), 5))
    for i in range(len(profile)):
        n, h = size[i], size[i] / 8.0
        if profile[i, BULGE] == 0.0 and profile[i, DISK] == 0.0:
            continue
        # The lattice of a stamp's images is symmetric, so there are no odd terms.
        middle, rising = _image_light(profile[i], n, 0.0, 0.0), _image_light(profile[i], n, h, h)
        right, up = _image_light(profile[i], n, h, 0.0), _image_light(profile[i], n, 0.0, h)
        falling = _image_light(profile[i], n, h, -h)
        highest, lowest = max(max(right, up), max(rising, falling)), min(min(right, up), min(rising, falling))
        uneven = max(highest - middle, middle - lowest) / middle if middle > 0.0 else _STEEP
        across2, up2 = (right - middle) / h**2, (up - middle) / h**2
        cross_term = 0.5 * (rising - falling) / h**2
        across, along = 0.5 * (n - 1) - x[i], 0.5 * (n - 1) - y[i]
        spread = (n * n - 1) / 12.0
        second = across2 * (across**2 + spread) + cross_term * across * along + up2 * (along**2 + spread)
        light = n * n * (middle + second)
        if light > 0.0:
            # With a sharp limit, a galaxy and its sheared version could be treated differently.
            z = min((_STEEP - uneven) / (_STEEP - _EVEN), light / (_CANCELLED * n * n * middle))
            z = min(max(z, 0.0), 1.0)
            part = z * z * (3.0 - 2.0 * z)
            part = min(part, max_electrons[i] / light)
            out[i] = part * middle, part * across2, part * cross_term, part * up2, part * light
    return out


@jit
def _image_light(profile: Float, size: int, x: float, y: float) -> Any:
    """Light of a source's periodic images in the three rings of stamps around its stamp."""
    total = 0.0
    for r in range(-3, 4):
        for c in range(-3, 4):
            if r != 0 or c != 0:
                total += _light(profile, x - c * size, y - r * size)
    return total


@jit
def _light(profile: Float, x: float, y: float) -> Any:
    """Light of a galaxy per pixel at (x, y) pixels from its middle, electrons."""
    out = 0.0
    if profile[BULGE] > 0.0:
        out += profile[BULGE] * np.exp(-np.exp(profile[POWER] * np.log(_square(profile, BULGE_FORM, x, y) + 1e-300)))
    return out + _disk_light(profile, x, y)


@jit
def _disk_light(profile: Float, x: float, y: float) -> Any:
    lengths = _square(profile, DISK_FORM, x, y)
    return profile[DISK] * np.exp(-np.sqrt(lengths)) if lengths < _DARK else 0.0


@jit
def _square(profile: Float, form: int, x: float, y: float) -> Any:
    """Compute u^2 + v^2 for the matrix that begins at column `form`."""
    u, v = profile[form] * x + profile[form + 1] * y, profile[form + 2] * x + profile[form + 3] * y
    return u * u + v * v


@jit
def add_smoothed(blocks: Int, image: Float, x: Float, y: Float, electrons: Float, unit: float) -> None:
    """Add an image, in blocks, about each of several points, interpolated between the four nearest blocks.

    Parameters
    ----------
    blocks : int array
        Blocks, changed in place.
    image : float array
        Electrons per pixel for one electron, on blocks, centred on the point and with a border of zeros.
    x, y : float array, shape (m,)
        Positions of the points, blocks.
    electrons : float array, shape (m,)
        Electrons of the points.
    unit : float
        Units per electron.
    """
    ny, nx = blocks.shape
    side = len(image) - 1
    for i in range(len(x)):
        x_first, y_first = int(np.floor(x[i])), int(np.floor(y[i]))
        x_fraction, y_fraction = x[i] - x_first, y[i] - y_first
        light = electrons[i] * unit
        w0, w1 = light * (1.0 - x_fraction) * (1.0 - y_fraction), light * x_fraction * (1.0 - y_fraction)
        w2, w3 = light * (1.0 - x_fraction) * y_fraction, light * x_fraction * y_fraction
        x_first, y_first = x_first - (side - 1) // 2, y_first - (side - 1) // 2
        first, last = max(0, -x_first), min(side, nx - x_first)
        if first >= last:
            continue
        for r in range(max(0, -y_first), min(side, ny - y_first)):
            out = blocks[y_first + r, x_first + first : x_first + last]
            a, b = image[r + 1, first + 1 : last + 1], image[r + 1, first:last]
            c, d = image[r, first + 1 : last + 1], image[r, first:last]
            for j in range(len(out)):
                out[j] += np.int64(np.rint(w0 * a[j] + w1 * b[j] + w2 * c[j] + w3 * d[j]))


@jit
def add_spilled(
    blocks: Int, side: int, margin: int, size: Int, reach: Float, column: Float, row: Float, profile: Float,
    light: Float, unit: float,
) -> None:  # fmt: skip
    """Add the light that was removed from the stamps of galaxies to blocks outside the stamps.

    Parameters
    ----------
    blocks : int array
        Blocks, changed in place.
    side : int
        Side of a block, pixels.
    margin : int
        Number of blocks before the first pixel of the frame.
    size : int array, shape (m,)
        Sides of the stamps, pixels.
    reach : float array, shape (m,)
        Distance up to which the light is distributed, pixels.
    column, row : float array, shape (m,)
        Positions of the galaxies, pixels.
    profile : float array, shape (m, 11)
        Profiles of the galaxies.
    light : float array, shape (m,)
        Electrons to be distributed among the blocks.
    unit : float
        Units per electron.
    """
    middle = 0.5 * (side - 1)
    square = np.empty(1, np.float32)
    bits = square.view(np.int32)
    for i in range(len(size)):
        half = size[i] // 2
        form = profile[i, BULGE_FORM : BULGE_FORM + 4].copy()
        min_square = max(half - 0.5 * side - 1.0, 1.0) ** 2 * min_singular_squared(form.reshape(2, 2))
        bulge, first = _tabulate_bulge(profile[i], min_square, 3.0 * (reach[i] + side) ** 2 * np.sum(form**2))
        x0, y0 = np.rint(column[i]) - half - 0.5, np.rint(row[i]) - half - 0.5
        x_first, y_first = int(np.floor((column[i] - reach[i]) / side)), int(np.floor((row[i] - reach[i]) / side))
        x_last, y_last = int(np.ceil((column[i] + reach[i]) / side)), int(np.ceil((row[i] + reach[i]) / side))
        image = np.zeros((y_last - y_first + 1, x_last - x_first + 1))
        for r in range(len(image)):
            bottom = (y_first + r) * side - 0.5
            covered_y = max(min(bottom + side, y0 + size[i]) - max(bottom, y0), 0.0) / side
            for c in range(image.shape[1]):
                edge = (x_first + c) * side - 0.5
                covered_x = max(min(edge + side, x0 + size[i]) - max(edge, x0), 0.0) / side
                outside = 1.0 - covered_x * covered_y
                if outside > 0.0:
                    x, y = edge + 0.5 + middle - column[i], bottom + 0.5 + middle - row[i]
                    square[0] = _square(profile[i], BULGE_FORM, x, y)
                    place = min(max((bits[0] >> _COARSE) - first, 0), len(bulge) - 2)
                    part = (bits[0] & ((1 << _COARSE) - 1)) / (1 << _COARSE)
                    pixel_light = (
                        bulge[place] + part * (bulge[place + 1] - bulge[place]) + _disk_light(profile[i], x, y)
                    )
                    image[r, c] = outside * pixel_light
        total = np.sum(image) * side**2
        if total > 0.0:
            _add_image(blocks, image, x_first + margin, y_first + margin, light[i] / total * unit)


@jit
def _add_image(blocks: Int, image: Float, x_first: int, y_first: int, scale: float) -> None:
    """Add an image times `scale`, rounded, to the blocks from (x_first, y_first)."""
    ny, nx = blocks.shape
    first, last = max(0, -x_first), min(image.shape[1], nx - x_first)
    for r in range(max(0, -y_first), min(len(image), ny - y_first)):
        for c in range(first, last):
            blocks[y_first + r, x_first + c] += np.int64(np.rint(scale * image[r, c]))


@jit
def _tabulate_bulge(profile: Float, min_square: float, max_square: float) -> tuple[Float, int]:
    """Light of the bulge by u^2 + v^2 with 16 nodes per octave, and the top bits of the first node."""
    ends = np.array([max(min_square, 1e-30), min(max(max_square, 1e-30), 1e30)], np.float32)
    bits = ends.view(np.int32)
    first, last = bits[0] >> _COARSE, (bits[1] >> _COARSE) + 2
    nodes = ((np.arange(last - first) + first) << _COARSE).astype(np.int32).view(np.float32)
    out = np.zeros(len(nodes))
    if profile[BULGE] > 0.0:
        for j in range(len(nodes)):
            out[j] = profile[BULGE] * np.exp(-np.exp(profile[POWER] * np.log(nodes[j])))
    return out, first


@jit
def to_electrons(frame: Int, unit: float, blocks: Float, side: int, margin: int) -> Float:
    """Convert a frame to electrons and add a smooth layer of blocks.

    Parameters
    ----------
    frame : int array, shape (ny, nx)
        Frame; its memory is reused for the result.
    unit : float
        Units of the frame per electron.
    blocks : float array
        Electrons per pixel, interpolated linearly between the centres of blocks.
    side : int
        Side of a block, pixels.
    margin : int
        Number of blocks before the first pixel of the frame.

    Returns
    -------
    float array, shape (ny, nx)
        Electrons.
    """
    ny, nx = frame.shape
    out, electrons_per_unit = frame.view(np.float64), 1.0 / unit
    middle = 0.5 * (side - 1)
    block_column, column_fraction = np.empty(nx, np.int64), np.empty(nx)
    for c in range(nx):
        x = (c - middle) / side + margin
        block_column[c] = int(np.floor(x))
        column_fraction[c] = x - block_column[c]
    for r in range(ny):
        y = (r - middle) / side + margin
        block_row = int(np.floor(y))
        row_fraction = y - block_row
        line = (1.0 - row_fraction) * blocks[block_row] + row_fraction * blocks[block_row + 1]
        for c in range(nx):
            out[r, c] = (
                frame[r, c] * electrons_per_unit
                + line[block_column[c]]
                + column_fraction[c] * (line[block_column[c] + 1] - line[block_column[c]])
            )
    return out
