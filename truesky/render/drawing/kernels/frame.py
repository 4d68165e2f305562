"""Compiled loops that add stamps to the image of a detector (frame), and move aliased light to its correct position.

A stamp is a square image around one source. It is periodic, so light beyond its edges appears at the opposite edges
(aliased light). A frame and its blocks contain integers, so that sums do not depend on the order of the sources. In all
functions `profile` contains 11 numbers per galaxy from `galaxy_shapes.real_space_profile`: central brightness
(electrons per pixel), shape and orientation of its bulge and of its disc.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lake_schema.arrays import Array, Float, Int
from truesky.numerics.compiling import jit

# Usual factor from electrons to the integers in which light is summed; it gives a precision of 1e-6 electrons.
FIXED_POINT = float(1 << 20)
# The light of all sources, summed in 64-bit integers, is at most 2^FULL. This leaves room below 2^63 for ringing.
FULL = 61
# Number of low bits of a positive float32 that are dropped, so that the other bits count sixteenths of an octave
# (factor of two). Counted from their value at the first node, they are the index into a table with 16 nodes per octave.
_COARSE = 19
# Square of the radius beyond which the light of an exponential disc is 0: (30 scale lengths)^2.
_DARK = 900.0
# Column of `galaxy_shapes.real_space_profile` with the light per pixel in the middle of the bulge.
BULGE = 0
# Column of `galaxy_shapes.real_space_profile` with the light per pixel in the middle of the disc.
DISK = 1
# First of the four columns of `galaxy_shapes.real_space_profile` with the 2 x 2 matrix of the bulge, row by row. It
# converts offsets from the bulge's middle in pixels to (u, v), in which the bulge is round: exp(-(u^2 + v^2)^p).
BULGE_FORM = 2
# Column of `galaxy_shapes.real_space_profile` with the exponent p of the bulge's light exp(-(u^2 + v^2)^p); p is 0.5 /
# Sersic index, and (u, v) are coordinates in which the bulge is round.
POWER = 6
# First of the four columns of `galaxy_shapes.real_space_profile` with the 2 x 2 matrix of the disc, row by row. It
# converts offsets from the disc's middle in pixels to (u, v), in which the disc is round with scale length 1.
DISK_FORM = 7
# Stamps are periodic, so they contain aliased light of a galaxy's periodic copies. All aliased light is removed if its
# variation is at most this. The variation is the largest difference between the aliased light in the galaxy's middle
# and about an eighth of the stamp's side away, divided by the light in the middle.
_EVEN = 1.0
# No aliased light (of a galaxy's periodic copies) is removed from a stamp if its variation is at least this. The
# variation is the largest difference between this light in the galaxy's middle and about an eighth of the stamp's side
# away, divided by the light in the middle. Between _EVEN and this limit, the removed fraction decreases gradually.
# The error of the response of galaxy shapes to shear was measured for the axis ratio 0.1 on stamps that are far too
# small (64 pixels, Sersic index 3, half-light radius 10 pixels). In units of the error without removal, it is 2 without
# an upper limit of the variation, 1.6 with a sharp limit and 0.5 with the gradual one.
_STEEP = 3.0
# Aliased light on a stamp is approximated by a polynomial of second order. If its terms cancel, so that its sum over
# the stamp is less than this fraction of the sum of the constant term alone, only a part of the light is removed.
_CANCELLED = 0.25


@jit
def min_singular_squared(form: Float) -> Any:
    """Return the square of the smaller singular value of the 2 x 2 matrix `form`."""
    half = 0.5 * np.sum(form**2)
    determinant = form[0, 0] * form[1, 1] - form[0, 1] * form[1, 0]
    return determinant**2 / max(half + np.sqrt(max(half**2 - determinant**2, 0.0)), 1e-300)


@jit
def accumulate(
    frame: Int, stamps: Array, x0: Int, y0: Int, unread_rows: tuple[int, int], unit: float
) -> Int:  # fmt: skip
    """Add m stamps to the image of a detector (frame), in integers, so that the sum does not depend on the order.

    Parameters
    ----------
    frame : int array, shape (ny, nx)
        Frame, changed in place.
    stamps : float array, shape (m, N, N)
        Images of the sources, electrons.
    x0, y0 : int array, shape (m,)
        Column and row of the frame at which the first pixel of each stamp lies. Pixels outside the frame are ignored.
    unread_rows : (int, int)
        First row that the detector does not read, and the row after the last of these rows. They are drawn, but not
        counted in the result.
    unit : float
        Factor from electrons to the integers of the frame. Each pixel of a stamp is rounded.

    Returns
    -------
    int array, shape (m,)
        Light of each stamp that was added on read rows, in the integers of the frame.
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
    """Subtract aliased light from m stamps; no pixel becomes negative, and negative pixels are not changed.

    Parameters
    ----------
    stamps : float array, shape (m, N, N)
        Stamps, changed in place.
    x, y : float array, shape (m,)
        Positions of the sources in the stamps, pixels.
    curve : float array, shape (m, 5)
        Polynomials of the aliased light, from `aliased_light`: constant term and coefficients of x^2, x y and y^2 in
        electrons per pixel, for offsets (x, y) from the source in pixels. Column 4 is not used. Stamps with a constant
        term 0 are not changed.
    removed : float array, shape (m,)
        Result: electrons that were subtracted from each stamp.
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
    """Return the light of galaxies that is aliased onto m stamps, as polynomials of second order.

    Aliased light comes from the copies of a galaxy in the periodic repetition of its stamp.

    Parameters
    ----------
    size : int array, shape (m,)
        Sides of the stamps, pixels.
    x, y : float array, shape (m,)
        Positions of the sources in the stamps, pixels.
    profile : float array, shape (m, 11)
        Rows of `galaxy_shapes.real_space_profile` (central brightness in electrons per pixel, shape and orientation of
        bulge and disc); zeros for sources without aliased light.
    max_electrons : float array, shape (m,)
        Upper limit of the aliased light on the stamp, electrons.

    Returns
    -------
    float array, shape (m, 5)
        Constant term and coefficients of x^2, x y and y^2 in electrons per pixel, for offsets (x, y) from the source in
        pixels; and sum of the polynomial over the stamp, electrons. All are 0 if the light varies too much for such a
        polynomial, as for steep, thin galaxies.

    Notes
    -----
    Up to a distance of an eighth of the stamp's side from the middle, the relative error is 2 % for a round galaxy and
    33 % for the axis ratio 0.3. Farther out the result is too small.
    """
    out = np.zeros((len(profile), 5))
    for i in range(len(profile)):
        n, h = size[i], size[i] / 8.0
        if profile[i, BULGE] == 0.0 and profile[i, DISK] == 0.0:
            continue
        # Aliased light comes from the periodic copies of the galaxy, whose lattice is symmetric. Therefore the
        # polynomial in x and y that approximates it has no odd terms.
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
            # The fraction `part` of the aliased light that is removed decreases smoothly from 1 to 0 as the relative
            # variation of this light on the stamp increases. With a sharp limit, a galaxy and its slightly sheared
            # version could be treated differently, which would bias the measured shear.
            z = min((_STEEP - uneven) / (_STEEP - _EVEN), light / (_CANCELLED * n * n * middle))
            z = min(max(z, 0.0), 1.0)
            part = z * z * (3.0 - 2.0 * z)
            part = min(part, max_electrons[i] / light)
            out[i] = part * middle, part * across2, part * cross_term, part * up2, part * light
    return out


@jit
def _image_light(profile: Float, size: int, x: float, y: float) -> Any:
    """Return the aliased light of a galaxy in a pixel at (x, y) pixels from its middle, electrons.

    The stamp has a side of `size` pixels and is repeated periodically. The result is the light of the 48 copies of the
    galaxy in the three rings of stamps around its stamp. `profile` is a row of `galaxy_shapes.real_space_profile`.
    """
    total = 0.0
    for r in range(-3, 4):
        for c in range(-3, 4):
            if r != 0 or c != 0:
                total += _light(profile, x - c * size, y - r * size)
    return total


@jit
def _light(profile: Float, x: float, y: float) -> Any:
    """Return the light of a galaxy, bulge and disc, in a pixel at (x, y) pixels from its middle, electrons.

    `profile` [11] is a row of `galaxy_shapes.real_space_profile`: parameters of bulge and disc. The PSF is neglected.
    """
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
    """Return u^2 + v^2, where (u, v) is the product of a 2 x 2 matrix and (x, y).

    The matrix converts offsets (x, y) from a galaxy's middle, pixels, to coordinates in which its bulge or disc is
    round. Its elements are in `profile`, from the index `form` on, row by row.
    """
    u, v = profile[form] * x + profile[form + 1] * y, profile[form + 2] * x + profile[form + 3] * y
    return u * u + v * v


@jit
def add_smoothed(blocks: Int, image: Float, x: Float, y: Float, electrons: Float, unit: float) -> None:
    """Add the image of a wide PSF about each of m point sources to a grid of blocks (squares of several pixels).

    Each source is shifted to its position by linear interpolation between the four nearest blocks.

    Parameters
    ----------
    blocks : int array, shape (by, bx)
        Light per pixel in each block, in integers, changed in place. Light outside the grid is ignored.
    image : float array, shape (s, s)
        Light per pixel in each block for a source of one electron in the middle block. s is odd, and the outermost rows
        and columns must be zero.
    x, y : float array, shape (m,)
        Positions of the sources in units of blocks; 0 is the centre of the first block.
    electrons : float array, shape (m,)
        Electrons of the sources.
    unit : float
        Factor from electrons to the integers of the blocks.
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
    """Distribute the light that was removed from the stamps of m galaxies among blocks of pixels outside the stamps.

    The light is distributed in proportion to the profile of the galaxy. Blocks (squares of pixels) that the stamp
    covers in part receive light for the rest of their area.

    Parameters
    ----------
    blocks : int array, shape (by, bx)
        Light per pixel in each block, in integers, changed in place. Light outside the grid is ignored.
    side : int
        Side of a block, pixels.
    margin : int
        Number of columns and rows of blocks before the first pixel of the detector.
    size : int array, shape (m,)
        Sides of the stamps, pixels.
    reach : float array, shape (m,)
        Distance from the galaxy along columns and rows up to which the light is distributed, pixels.
    column, row : float array, shape (m,)
        Positions of the galaxies on the detector, 0-based pixels.
    profile : float array, shape (m, 11)
        Rows of `galaxy_shapes.real_space_profile`: relative brightness, shape and orientation of bulge and disc.
    light : float array, shape (m,)
        Electrons to be distributed for each galaxy.
    unit : float
        Factor from electrons to the integers of the blocks.
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
    """Add an image times `scale`, rounded to integers, to the array `blocks`.

    The first pixel of the image is added to column `x_first` and row `y_first` of `blocks`. Pixels outside `blocks` are
    ignored.
    """
    ny, nx = blocks.shape
    first, last = max(0, -x_first), min(image.shape[1], nx - x_first)
    for r in range(max(0, -y_first), min(len(image), ny - y_first)):
        for c in range(first, last):
            blocks[y_first + r, x_first + c] += np.int64(np.rint(scale * image[r, c]))


@jit
def _tabulate_bulge(profile: Float, min_square: float, max_square: float) -> tuple[Float, int]:
    """Return a table of a bulge's light per pixel as a function of u^2 + v^2, and the top bits of the first node.

    (u, v) are coordinates in which the bulge is round: its light is exp(-(u^2 + v^2)^p). The table covers u^2 + v^2
    from `min_square` to `max_square` with 16 nodes per octave (factor of two). The top 13 bits of a node, as a float32,
    increase by 1 from node to node. The index of a node is the difference between its top bits and the top bits of the
    first node.
    """
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
    """Convert the image of a detector (frame) from integers to electrons, and add smooth light given on a coarse grid.

    Parameters
    ----------
    frame : int64 array, shape (ny, nx)
        Frame; its memory is reused for the result.
    unit : float
        Factor from electrons to the integers of the frame.
    blocks : float array, shape (by, bx)
        Electrons per pixel at the centres of blocks of pixels, between which they are interpolated linearly.
    side : int
        Side of a block, pixels.
    margin : int
        Number of columns and rows of blocks before the first pixel of the frame, at least 1.

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
