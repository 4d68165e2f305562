"""Compiled: stamps onto the frame, in fixed point; light that wraps around a stamp goes where it belongs.

accumulate        stamps onto the frame, in fixed point
aliased_light     the light that comes in at the opposite edges of stamps
subtract_aliased  takes it off them;  spill : and adds it where it belongs
smooth            an image about points
electrons_of      the frame with a smooth layer on top
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lake_schema.arrays import Array, Float, Int
from truesky.numerics.compiling import jit

# What an electron is in the frame's integers, to 1e-6; and their largest sum, which leaves room for what rings.
FIXED_POINT, FULL = float(1 << 20), 61
# Of a float's bits, those within a sixteenth of an octave; square of the scale lengths at which a disc ends.
_COARSE, _DARK = 19, 900.0
# Columns of galaxy_shapes.on_the_sky: light in the middle of a bulge and of a disc, the first of the four of their
# matrices, and the bulge's exponent.
BULGE, DISK, BULGE_FORM, POWER, DISK_FORM = 0, 1, 2, 6, 7
# Light that enters a stamp is taken off where it varies by less than the first about the middle, of itself; from the
# second on nothing is. Measured on stamps too small by far (64 pixels, n = 3, half-light radius 10): without an end the
# response to shear at axis ratio 0.1 is twice as wrong as with nothing taken off; if it ended at once it would be wrong
# by 1.6, and fading is by 0.5.
_EVEN, _STEEP = 1.0, 3.0
# It fades, too, where the terms cancel: they hold less light than this, of what the middle's level would be.
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
    """Adds stamps [m, N, N] with their lower left pixels at (x0, y0) to the frame, `unit` to an electron.

    Whole numbers: the sum is the same, bit by bit, in any order.
    unread  : first of the rows that count for nothing, and the one behind them
    returns : int64[m] what of each stamp fell onto the others, in the same units
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
    """Takes curve [m, 5] of `aliased_light` about (x, y) [m] off stamps [m, N, N]; no pixel becomes negative.

    taken : [m] filled with the electrons
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
    """[m, 5] light that enters stamps at their edges: its level in the middle, terms of x^2, x y and y^2; all of it.

    size, x, y : [m] side of the stamp, position in it, pixels;  profile : [m, 11] galaxy_shapes.on_the_sky, electrons
    most  : [m] electrons that may enter
    Error : of a round galaxy 2 % within an eighth of the stamp of the middle, of axis ratio 0.3 a third; too little
            farther out. All 0 where the light varies too much for such terms: of steep, slim galaxies
    """
    out = np.zeros((len(profile), 5))
    for i in range(len(profile)):
        n, h = size[i], size[i] / 8.0
        if profile[i, BULGE] == 0.0 and profile[i, DISK] == 0.0:
            continue
        # The lattice of the stamp's images has no odd terms.
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
            # By and by: if it ended at once, a galaxy and the same one sheared would differ by more than by the shear.
            z = min((_STEEP - uneven) / (_STEEP - _EVEN), light / (_CANCELLED * n * n * middle))
            z = min(max(z, 0.0), 1.0)
            part = z * z * (3.0 - 2.0 * z)
            part = min(part, max_electrons[i] / light)
            out[i] = part * middle, part * across2, part * cross_term, part * up2, part * light
    return out


@jit
def _image_light(profile: Float, size: int, x: float, y: float) -> Any:
    """Light of a source's images in the stamps about its own, three deep."""
    total = 0.0
    for r in range(-3, 4):
        for c in range(-3, 4):
            if r != 0 or c != 0:
                total += _light(profile, x - c * size, y - r * size)
    return total


@jit
def _light(profile: Float, x: float, y: float) -> Any:
    """Of a galaxy, electrons a pixel at (x, y) pixels from its middle."""
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
    """u^2 + v^2 of the matrix that begins at a column."""
    u, v = profile[form] * x + profile[form + 1] * y, profile[form + 2] * x + profile[form + 3] * y
    return u * u + v * v


@jit
def add_smoothed(blocks: Int, image: Float, x: Float, y: Float, electrons: Float, unit: float) -> None:
    """Adds an image about points (x, y) [m], blocks, each shared among the four nearest, `unit` to an electron.

    image : electrons a pixel of one electron, on blocks, its middle one the point's, with a border of nothing
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
    """Adds what is taken off galaxies' stamps to blocks of `side` pixels outside, `unit` to an electron.

    margin : blocks before the frame's first;  size, reach : [m] side of the stamp, and as far as it goes, pixels
    column, row : [m] pixels;  profile : [m, 11] galaxy_shapes.on_the_sky
    light  : [m] electrons to be shared among the blocks
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
    """Adds an image times `scale`, rounded, to blocks from (left, low) on, as far as it lies on them."""
    ny, nx = blocks.shape
    first, last = max(0, -x_first), min(image.shape[1], nx - x_first)
    for r in range(max(0, -y_first), min(len(image), ny - y_first)):
        for c in range(first, last):
            blocks[y_first + r, x_first + c] += np.int64(np.rint(scale * image[r, c]))


@jit
def _tabulate_bulge(profile: Float, min_square: float, max_square: float) -> tuple[Float, int]:
    """(light of the bulge by u^2 + v^2, 16 places an octave, linear between; the top bits of the first)."""
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
    """The electrons of a frame of `unit` to each, with those of blocks of `side` pixels, `margin` before its first.

    blocks : electrons a pixel, interpolated linearly between the blocks' centres
    returns : float64[ny, nx] in the place of the frame, which is lost
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
