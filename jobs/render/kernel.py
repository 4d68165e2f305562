"""The inner loops of drawing, compiled: a source's Fourier transform on its stamp's grid, and the sum of stamps.

units_of      what an electron is in a frame's integers
nyquist_zones profile x PSF x pixel x phase on the half plane, wrapped onto the pixels' Nyquist zone
accumulate    stamps onto the frame, in fixed point
returning     the light that comes in at the opposite edges of stamps;  take_off : it;  leaving : it where it belongs
runs          which samples of a stamp's grid are taken, in what order
take          the samples of a stamp's grid from a transform
add_planes    planes of a PSF, weighted, summed
spread        an image about points
electrons_of  the frame with a smooth layer on top
between       a transform between its samples
reaches       how far in Fourier space a source must be followed

Precision is that of the planes: single, but double for sources so bright that it would show.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from jobs.compiling import jit
from jobs.render.sersic import FIRST_BITS

Float = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]
Int = npt.NDArray[np.int64]
Bool = npt.NDArray[np.bool_]

# What an electron is in the frame's integers, to 1e-6; and their largest sum, which leaves room for what rings.
FIXED_POINT, _FULL = float(1 << 20), 61
_TWO_PI = 2.0 * np.pi
_FIRST = int(FIRST_BITS)
# Of a float's bits, those within a sixteenth of an octave; square of the scale lengths at which a disc ends.
_COARSE, _DARK = 19, 900.0
# Columns of profiles.on_the_sky: light in the middle of a bulge and of a disc, the first of the four of their matrices,
# and the bulge's exponent.
BULGE, DISK, BULGE_FORM, POWER, DISK_FORM = 0, 1, 2, 6, 7
# Light that enters a stamp is taken off where it varies by less than the first about the middle, of itself; from the
# second on nothing is. Measured on stamps too small by far (64 pixels, n = 3, half-light radius 10): without an end the
# response to shear at axis ratio 0.1 is twice as wrong as with nothing taken off; if it ended at once it would be wrong
# by 1.6, and fading is by 0.5.
_EVEN, _STEEP = 1.0, 3.0
# It fades, too, where the terms cancel: they hold less light than this, of what the middle's level would be.
_CANCELLED = 0.25


def units_of(electrons: Float) -> float:
    """Units of an electron in a frame of sources [n], a power of two: FIXED_POINT, or what they all fit in, in a pixel.

    Error : of 5e13 electrons, the brightest star of the sky in 560 s, the frame is to 1e-5 of one; of 1e17 to 0.06
    """
    _, octave = math.frexp(math.fsum(electrons.tolist()))
    return min(FIXED_POINT, 2.0 ** (_FULL - octave))


@jit
def nyquist_zones(
    zones: npt.NDArray[Any], planes: npt.NDArray[Any], kx: Float32, ky: Float32, runs: Int, pieces: Int, inner: Float,
    weights: npt.NDArray[Any], x: Float, y: Float, electrons: Float, cut: Float, sersic: Float32, body: Bool,
    fraction: Float, bulge: Float, disk: Float, thick: Float, row: Int, row_weights: Float, trail: Float,
) -> None:  # fmt: skip
    """Fills zones, complex[m, N, N / 2 + 1]: what irfft2 turns into the stamps of m sources.

    planes, kx .. inner : of transfer.Transfer and transfer.Grid; weights [m, b] sum the planes
    body        : [m] False for a point
    fraction    : [m] of the light in the bulge
    bulge, disk, thick : [m, 2, 2], [m, 2, 2], [m, 2] of profiles.Forms
    sersic      : table of sersic.py; row, row_weights : [m], [m, 4] from sersic.row_of
    cut         : [m] pieces from this |k| on, radian / pixel, are left out
    x, y        : [m] position in the stamp, pixels, 0 = centre of the first;  electrons : [m]
    trail       : [m, 2] pixels that it moves by, along columns and rows, about this position
    """
    m, n, columns = zones.shape
    most, low, high, far = 0, 0, 0, 0
    for p in range(len(inner)):
        most = max(most, runs[pieces[p + 1], 0] - runs[pieces[p], 0])
    for j in range(len(runs) - 1):
        low, high = min(low, runs[j, 1]), max(high, runs[j, 1] + runs[j + 1, 0] - runs[j, 0])
        far = max(far, abs(runs[j, 2]))
    # Phase by column and by row; the electrons enter with the rows.
    of_column, of_row = np.empty((m, 2, high - low), planes.dtype), np.empty((m, 2, 2 * far + 1), planes.dtype)
    tables = np.empty((m, sersic.shape[1]), np.float32)
    sums = np.zeros((m, 2, n, columns), planes.dtype)
    step = _TWO_PI / n
    for i in range(m):
        for c in range(low, high):
            of_column[i, 0, c - low], of_column[i, 1, c - low] = np.cos(step * c * x[i]), -np.sin(step * c * x[i])
        for r in range(-far, far + 1):
            of_row[i, 0, r + far] = electrons[i] * np.cos(step * r * y[i])
            of_row[i, 1, r + far] = -electrons[i] * np.sin(step * r * y[i])
        if body[i] and fraction[i] > 0.0:
            # Pieces are taken whole: to the inner edge of the first that is not.
            outer = step * np.hypot(far, max(-low, high))
            for p in range(len(inner) - 1, -1, -1):
                outer = inner[p] if inner[p] >= cut[i] else outer
            most_square = 1.01 * (outer + 2.0 * step) ** 2 * np.sum(bulge[i] ** 2)
            _interpolate(sersic, row[i], row_weights[i], 0.99 * step**2 * _smaller(bulge[i]), most_square, tables[i])
    re, im = np.empty(most, planes.dtype), np.empty(most, planes.dtype)
    profile, square = np.empty(most, np.float32), np.empty(most, np.float32)
    bits = square.view(np.int32)
    for p in range(len(inner)):
        first, last = runs[pieces[p], 0], runs[pieces[p + 1], 0]
        # From 0 over a slice: only so does the compiler use whole vectors.
        some_re, some_im, some = re[: last - first], im[: last - first], profile[: last - first]
        for i in range(m):
            if inner[p] >= cut[i]:
                continue
            _collapse(planes, weights[i], first, last, some_re, some_im)
            if body[i]:
                _profile(
                    fraction[i], bulge[i], disk[i], thick[i], tables[i], kx[first:last], ky[first:last], square, bits,
                    some,
                )  # fmt: skip
                for c in range(len(some)):
                    some_re[c] *= some[c]
                    some_im[c] *= some[c]
            if trail[i, 0] != 0.0 or trail[i, 1] != 0.0:
                _smear(trail[i, 0], trail[i, 1], kx[first:last], ky[first:last], some_re, some_im)
            for j in range(pieces[p], pieces[p + 1]):
                start, ix, iy = runs[j]
                length, left, up = runs[j + 1, 0] - start, ix % n, iy % n
                _add_turned(
                    of_column[i, :, ix - low : ix - low + length], of_row[i, 0, iy + far], of_row[i, 1, iy + far],
                    re[start - first : start - first + length], im[start - first : start - first + length],
                    sums[i, 0, up, left : left + length], sums[i, 1, up, left : left + length],
                )  # fmt: skip
    for i in range(m):
        for r in range(n):
            for c in range(columns):
                zones[i, r, c] = complex(sums[i, 0, r, c], sums[i, 1, r, c])


@jit
def _collapse(planes: Any, weights: Any, first: int, last: int, re: Any, im: Any) -> None:
    """Fills re, im with the sum of the samples first .. last of the planes [b, 2, s]."""
    for part, out in ((0, re), (1, im)):
        triples = len(weights) // 3 * 3
        for c in range(len(out)):
            out[c] = 0
        for b in range(0, triples, 3):
            w0, w1, w2 = weights[b], weights[b + 1], weights[b + 2]
            p0, p1, p2 = planes[b, part, first:last], planes[b + 1, part, first:last], planes[b + 2, part, first:last]
            for c in range(len(out)):
                out[c] += w0 * p0[c] + w1 * p1[c] + w2 * p2[c]
        for b in range(triples, len(weights)):
            w, p = weights[b], planes[b, part, first:last]
            for c in range(len(out)):
                out[c] += w * p[c]


@jit
def _add_turned(column: Any, cosine: Any, sine: Any, re: Any, im: Any, sum_re: Any, sum_im: Any) -> None:
    cosines, sines = column[0], column[1]
    for c in range(len(re)):
        turn_re = cosines[c] * cosine - sines[c] * sine
        turn_im = cosines[c] * sine + sines[c] * cosine
        sum_re[c] += turn_re * re[c] - turn_im * im[c]
        sum_im[c] += turn_re * im[c] + turn_im * re[c]


@jit
def _profile(
    fraction: float, bulge: Float, disk: Float, thick: Float, table: Float32, kx: Float32, ky: Float32,
    square: Float32, bits: Any, out: Float32,
) -> None:  # fmt: skip
    """Fills `out` with the profile's transform at (kx, ky); square and its bits are scratch."""
    one, share = np.float32(1.0), np.float32(1.0 - fraction)
    if fraction < 1.0:
        u0, u1 = np.float32(disk[0, 0]), np.float32(disk[1, 0])
        v0, v1 = np.float32(disk[0, 1]), np.float32(disk[1, 1])
        t0, t1 = np.float32(thick[0]), np.float32(thick[1])
        for c in range(len(out)):
            u, v, q = u0 * kx[c] + u1 * ky[c], v0 * kx[c] + v1 * ky[c], t0 * kx[c] + t1 * ky[c]
            s = one + (u * u + v * v)
            out[c] = share / (s * np.sqrt(s) * _sinh_over(q * q))
    else:
        for c in range(len(out)):
            out[c] = np.float32(0.0)
    if fraction > 0.0:
        share = np.float32(fraction)
        u0, u1 = np.float32(bulge[0, 0]), np.float32(bulge[1, 0])
        v0, v1 = np.float32(bulge[0, 1]), np.float32(bulge[1, 1])
        for c in range(len(out)):
            u, v = u0 * kx[c] + u1 * ky[c], v0 * kx[c] + v1 * ky[c]
            square[c] = u * u + v * v
        end = np.int32(len(table) - 2)
        for c in range(len(out)):
            i = np.uint32(min(max((bits[c] >> np.int32(16)) - np.int32(_FIRST), np.int32(0)), end))
            part = np.float32(bits[c] & np.int32(0xFFFF)) * np.float32(1.0 / 65536.0)
            below = table[i]
            out[c] += share * (below + part * (table[i + np.uint32(1)] - below))


@jit
def _smear(across: float, along: float, kx: Float32, ky: Float32, re: Any, im: Any) -> None:
    """Multiplies by the transform of an even straight line: sin(q) / q, q = k . line / 2."""
    for c in range(len(re)):
        q = 0.5 * (across * kx[c] + along * ky[c])
        smeared = np.sin(q) / q if abs(q) > 1e-4 else 1.0
        re[c] *= smeared
        im[c] *= smeared


@jit
def _sinh_over(square: Any) -> Any:
    """sinh q / q from q^2: Taylor's series, 1e-7 for q < 4, and huge where 1e-7 matters no more."""
    # Written out: a loop over a tuple would divide each time.
    one = np.float32(1.0)
    out = one + square * np.float32(1.0 / 342.0)
    out = one + square * np.float32(1.0 / 272.0) * out
    out = one + square * np.float32(1.0 / 210.0) * out
    out = one + square * np.float32(1.0 / 156.0) * out
    out = one + square * np.float32(1.0 / 110.0) * out
    out = one + square * np.float32(1.0 / 72.0) * out
    out = one + square * np.float32(1.0 / 42.0) * out
    out = one + square * np.float32(1.0 / 20.0) * out
    return one + square * np.float32(1.0 / 6.0) * out


@jit
def _smaller(form: Float) -> Any:
    """Square of the smaller singular value of a 2 x 2 matrix."""
    half = 0.5 * np.sum(form**2)
    determinant = form[0, 0] * form[1, 1] - form[0, 1] * form[1, 0]
    return determinant**2 / max(half + np.sqrt(max(half**2 - determinant**2, 0.0)), 1e-300)


@jit
def reaches(
    passing: Float, step: float, body: Bool, fraction: Float, bulge: Float, disk: Float, sersic: Float32, row: Int,
    floor: Float,
) -> Float:  # fmt: skip
    """[m] the |k|, radian / pixel, beyond which profile times PSF is below `floor` [m] in every direction.

    passing : [i] the most that the PSF passes at |k| = i step
    """
    out = np.full(len(body), step * len(passing))
    square = np.empty(1, np.float32)
    bits = square.view(np.int32)
    for j in range(len(body)):
        slim_disk, slim_bulge = _smaller(disk[j]), _smaller(bulge[j])
        for i in range(len(passing) - 1, -1, -1):
            out[j] = step * (i + 1)
            k2 = (step * i) ** 2
            most = 0.0 if body[j] else 1.0
            if body[j] and fraction[j] < 1.0:
                most += (1.0 - fraction[j]) * (1.0 + slim_disk * k2) ** -1.5
            if body[j] and fraction[j] > 0.0:
                square[0] = slim_bulge * k2
                column = min(max((bits[0] >> 16) - np.int32(_FIRST), np.int32(0)), np.int32(sersic.shape[1] - 1))
                most += fraction[j] * max(abs(sersic[row[j] + 1, column]), abs(sersic[row[j] + 2, column]))
            if most * passing[i] > floor[j]:
                break
    return out


@jit
def _interpolate(sersic: Float32, row: int, row_weights: Float, least: float, most: float, table: Float32) -> None:
    """One index's transform, where the source needs it."""
    ends = np.array([least, most], np.float32)
    bits = ends.view(np.int32)
    last = sersic.shape[1] - 1
    low = min(max((bits[0] >> 16) - _FIRST, 0), last)
    high = min(max((bits[1] >> 16) - _FIRST, 0) + 2, last)
    w0, w1 = np.float32(row_weights[0]), np.float32(row_weights[1])
    w2, w3 = np.float32(row_weights[2]), np.float32(row_weights[3])
    for i in range(low, high + 1):
        table[i] = w0 * sersic[row, i] + w1 * sersic[row + 1, i] + w2 * sersic[row + 2, i] + w3 * sersic[row + 3, i]
    # k = 0: all of the light.
    table[0] = np.float32(1.0)
    table[1] = table[1] if low <= 1 else np.float32(1.0)


@jit
def take(spectrum: npt.NDArray[Any], runs: Int, pixel: Float, out: npt.NDArray[Any]) -> None:
    """Fills out [2, s] with the samples of transfer.Grid.runs: real and imaginary part of spectrum times pixel.

    spectrum : complex[iy, ix], ix >= 0 of a real image;  pixel : [|iy|, |ix|] the pixel's own transform
    """
    for j in range(len(runs) - 1):
        start, left, iy = runs[j]
        for c in range(runs[j + 1, 0] - start):
            ix = left + c
            through = pixel[abs(iy), abs(ix)]
            # What lies to the left of kx = 0 is the mirror image's conjugate.
            sample = spectrum[iy, ix] if ix >= 0 else spectrum[-iy, -ix]
            out[0, start + c] = through * sample.real
            out[1, start + c] = through * (sample.imag if ix >= 0 else -sample.imag)


@jit
def runs(size: int, reach: float, shells: int, out: Int) -> tuple[int, int]:
    """Runs of samples of a stamp's Fourier grid: see transfer.Grid.

    reach   : largest |(ix, iy)|;  shells : rings of equal width that the runs are sorted by, then by iy
    out     : filled with first sample, ix, iy, shell, as far as it has rows
    returns : number of runs, number of samples
    """
    count, samples = 0, 0
    for shell in range(shells):
        inside, outside = reach * shell / shells, reach * (shell + 1) / shells
        for iy in range(-int(reach), int(reach) + 1):
            last = _half_chord(outside, iy)
            gap = _half_chord(inside, iy) if shell > 0 else -1
            # Two arcs, left and right of the inner shells; or, on top of them, one.
            for arc in range(2 if gap >= 0 else 1):
                low = gap + 1 if arc == 1 else -last
                high = last if arc == 1 or gap < 0 else -gap - 1
                # Half of a real image's plane is enough, with all that falls onto that half.
                for alias in range(low // size, high // size + 1):
                    start, end = max(low, alias * size), min(high, alias * size + size // 2)
                    if start <= end:
                        if count < len(out):
                            out[count, 0], out[count, 1], out[count, 2], out[count, 3] = samples, start, iy, shell
                        count += 1
                        samples += end - start + 1
    return count, samples


@jit
def _half_chord(radius: float, y: int) -> int:
    """Largest x >= 0 with (x, y) inside a circle, else -1."""
    square = radius * radius - y * y
    return int(np.sqrt(square)) if square >= 0.0 else -1


@jit
def add_planes(image: Float32, planes: Float32, weights: Float, margin: int) -> None:
    """Adds the weighted sum of planes [b, s, s] to the image inside a margin."""
    for r in range(planes.shape[1]):
        out = image[margin + r, margin : margin + planes.shape[2]]
        for b in range(len(planes)):
            weight, line = np.float32(weights[b]), planes[b, r]
            for c in range(len(out)):
                out[c] += weight * line[c]


@jit
def accumulate(
    frame: Int, stamps: npt.NDArray[Any], x0: Int, y0: Int, unread: tuple[int, int], unit: float
) -> Int:  # fmt: skip
    """Adds stamps [m, N, N] with their lower left pixels at (x0, y0) to the frame, `unit` to an electron.

    Whole numbers: the sum is the same, bit by bit, in any order.
    unread  : first of the rows that count for nothing, and the one behind them
    returns : int64[m] what of each stamp fell onto the others, in the same units
    """
    ny, nx = frame.shape
    added = np.zeros(len(stamps), np.int64)
    for i in range(len(stamps)):
        left, right = max(0, -x0[i]), min(stamps.shape[2], nx - x0[i])
        for r in range(max(0, -y0[i]), min(stamps.shape[1], ny - y0[i])):
            if left < right:
                some, out = stamps[i, r, left:right], frame[y0[i] + r, x0[i] + left : x0[i] + right]
                total = np.int64(0)
                for c in range(len(some)):
                    units = np.int64(np.rint(np.float64(some[c]) * unit))
                    out[c] += units
                    total += units
                if not unread[0] <= y0[i] + r < unread[1]:
                    added[i] += total
    return added


@jit
def take_off(stamps: npt.NDArray[Any], x: Float, y: Float, curve: Float, taken: Float) -> None:
    """Takes curve [m, 5] of `returning`, about (x, y) [m], off stamps [m, N, N], but leaves no pixel darker than none.

    taken : [m] filled with the electrons
    """
    for i in range(len(stamps)):
        taken[i] = 0.0
        if curve[i, 0] == 0.0:
            continue
        for r in range(stamps.shape[1]):
            up = r - y[i]
            level, slope = curve[i, 0] + curve[i, 3] * up * up, curve[i, 2] * up
            some = stamps[i, r]
            total = 0.0
            for c in range(len(some)):
                across = c - x[i]
                before = some[c]
                more = max(level + across * (slope + across * curve[i, 1]), 0.0)
                some[c] = before - min(more, max(np.float64(before), 0.0))
                total += np.float64(before) - np.float64(some[c])
            taken[i] += total


@jit
def returning(size: Int, x: Float, y: Float, stray: Float, most: Float) -> Float:
    """[m, 5] light that enters stamps at their edges: its level in the middle, terms of x^2, x y and y^2; all of it.

    size, x, y : [m] side of the stamp, position in it, pixels;  stray : [m, 11] profiles.on_the_sky, electrons
    most  : [m] electrons that may enter
    Error : of a round galaxy 2 % within an eighth of the stamp of the middle, of axis ratio 0.3 a third; too little
            farther out. All 0 where the light varies too much for such terms: of steep, slim galaxies
    """
    out = np.zeros((len(stray), 5))
    for i in range(len(stray)):
        n, h = size[i], size[i] / 8.0
        if stray[i, BULGE] == 0.0 and stray[i, DISK] == 0.0:
            continue
        # The lattice of the stamp's images has no odd terms.
        middle, rising = _images(stray[i], n, 0.0, 0.0), _images(stray[i], n, h, h)
        right, up = _images(stray[i], n, h, 0.0), _images(stray[i], n, 0.0, h)
        falling = _images(stray[i], n, h, -h)
        highest, lowest = max(max(right, up), max(rising, falling)), min(min(right, up), min(rising, falling))
        uneven = max(highest - middle, middle - lowest) / middle if middle > 0.0 else _STEEP
        across2, up2 = (right - middle) / h**2, (up - middle) / h**2
        both = 0.5 * (rising - falling) / h**2
        across, along = 0.5 * (n - 1) - x[i], 0.5 * (n - 1) - y[i]
        spread = (n * n - 1) / 12.0
        second = across2 * (across**2 + spread) + both * across * along + up2 * (along**2 + spread)
        light = n * n * (middle + second)
        if light > 0.0:
            # By and by: if it ended at once, a galaxy and the same one sheared would differ by more than by the shear.
            z = min((_STEEP - uneven) / (_STEEP - _EVEN), light / (_CANCELLED * n * n * middle))
            z = min(max(z, 0.0), 1.0)
            part = z * z * (3.0 - 2.0 * z)
            part = min(part, most[i] / light)
            out[i] = part * middle, part * across2, part * both, part * up2, part * light
    return out


@jit
def _images(stray: Float, size: int, x: float, y: float) -> Any:
    """Light of a source's images in the stamps about its own, three deep."""
    total = 0.0
    for r in range(-3, 4):
        for c in range(-3, 4):
            if r != 0 or c != 0:
                total += _light(stray, x - c * size, y - r * size)
    return total


@jit
def _light(stray: Float, x: float, y: float) -> Any:
    """Of a galaxy, electrons a pixel at (x, y) pixels from its middle."""
    out = 0.0
    if stray[BULGE] > 0.0:
        out += stray[BULGE] * np.exp(-np.exp(stray[POWER] * np.log(_square(stray, BULGE_FORM, x, y) + 1e-300)))
    return out + _disk_light(stray, x, y)


@jit
def _disk_light(stray: Float, x: float, y: float) -> Any:
    lengths = _square(stray, DISK_FORM, x, y)
    return stray[DISK] * np.exp(-np.sqrt(lengths)) if lengths < _DARK else 0.0


@jit
def _square(stray: Float, form: int, x: float, y: float) -> Any:
    """u^2 + v^2 of the matrix that begins at a column."""
    u, v = stray[form] * x + stray[form + 1] * y, stray[form + 2] * x + stray[form + 3] * y
    return u * u + v * v


@jit
def spread(blocks: Int, image: Float, x: Float, y: Float, electrons: Float, unit: float) -> None:
    """Adds an image about points (x, y) [m], blocks, each shared among the four nearest, `unit` to an electron.

    image : electrons a pixel of one electron, on blocks, its middle one the point's, with a border of nothing
    """
    ny, nx = blocks.shape
    side = len(image) - 1
    for i in range(len(x)):
        left, low = int(np.floor(x[i])), int(np.floor(y[i]))
        right, up = x[i] - left, y[i] - low
        light = electrons[i] * unit
        w0, w1 = light * (1.0 - right) * (1.0 - up), light * right * (1.0 - up)
        w2, w3 = light * (1.0 - right) * up, light * right * up
        left, low = left - (side - 1) // 2, low - (side - 1) // 2
        first, last = max(0, -left), min(side, nx - left)
        if first >= last:
            continue
        for r in range(max(0, -low), min(side, ny - low)):
            out = blocks[low + r, left + first : left + last]
            a, b = image[r + 1, first + 1 : last + 1], image[r + 1, first:last]
            c, d = image[r, first + 1 : last + 1], image[r, first:last]
            for j in range(len(out)):
                out[j] += np.int64(np.rint(w0 * a[j] + w1 * b[j] + w2 * c[j] + w3 * d[j]))


@jit
def leaving(
    blocks: Int, side: int, margin: int, size: Int, reach: Float, column: Float, row: Float, stray: Float, light: Float,
    unit: float,
) -> None:  # fmt: skip
    """Adds what is taken off galaxies' stamps to blocks of `side` pixels outside, `unit` to an electron.

    margin : blocks before the frame's first;  size, reach : [m] side of the stamp, and as far as it goes, pixels
    column, row : [m] pixels;  stray : [m, 11] profiles.on_the_sky;  light : [m] electrons to be shared among the blocks
    """
    middle = 0.5 * (side - 1)
    square = np.empty(1, np.float32)
    bits = square.view(np.int32)
    for i in range(len(size)):
        half = size[i] // 2
        form = stray[i, BULGE_FORM : BULGE_FORM + 4].copy()
        least = max(half - 0.5 * side - 1.0, 1.0) ** 2 * _smaller(form.reshape(2, 2))
        bulge, first = _by_square(stray[i], least, 3.0 * (reach[i] + side) ** 2 * np.sum(form**2))
        x0, y0 = np.rint(column[i]) - half - 0.5, np.rint(row[i]) - half - 0.5
        left, low = int(np.floor((column[i] - reach[i]) / side)), int(np.floor((row[i] - reach[i]) / side))
        right, high = int(np.ceil((column[i] + reach[i]) / side)), int(np.ceil((row[i] + reach[i]) / side))
        image = np.zeros((high - low + 1, right - left + 1))
        for r in range(len(image)):
            bottom = (low + r) * side - 0.5
            covered_y = max(min(bottom + side, y0 + size[i]) - max(bottom, y0), 0.0) / side
            for c in range(image.shape[1]):
                edge = (left + c) * side - 0.5
                covered_x = max(min(edge + side, x0 + size[i]) - max(edge, x0), 0.0) / side
                outside = 1.0 - covered_x * covered_y
                if outside > 0.0:
                    x, y = edge + 0.5 + middle - column[i], bottom + 0.5 + middle - row[i]
                    square[0] = _square(stray[i], BULGE_FORM, x, y)
                    place = min(max((bits[0] >> _COARSE) - first, 0), len(bulge) - 2)
                    part = (bits[0] & ((1 << _COARSE) - 1)) / (1 << _COARSE)
                    some = bulge[place] + part * (bulge[place + 1] - bulge[place]) + _disk_light(stray[i], x, y)
                    image[r, c] = outside * some
        whole = np.sum(image) * side**2
        if whole > 0.0:
            _add(blocks, image, left + margin, low + margin, light[i] / whole * unit)


@jit
def _add(blocks: Int, image: Float, left: int, low: int, scale: float) -> None:
    """Adds an image times `scale`, rounded, to blocks from (left, low) on, as far as it lies on them."""
    ny, nx = blocks.shape
    first, last = max(0, -left), min(image.shape[1], nx - left)
    for r in range(max(0, -low), min(len(image), ny - low)):
        for c in range(first, last):
            blocks[low + r, left + c] += np.int64(np.rint(scale * image[r, c]))


@jit
def _by_square(stray: Float, least: float, most: float) -> tuple[Float, int]:
    """(light of the bulge by u^2 + v^2, 16 places an octave, linear between; the top bits of the first)."""
    ends = np.array([max(least, 1e-30), min(max(most, 1e-30), 1e30)], np.float32)
    bits = ends.view(np.int32)
    first, last = bits[0] >> _COARSE, (bits[1] >> _COARSE) + 2
    nodes = ((np.arange(last - first) + first) << _COARSE).astype(np.int32).view(np.float32)
    out = np.zeros(len(nodes))
    if stray[BULGE] > 0.0:
        for j in range(len(nodes)):
            out[j] = stray[BULGE] * np.exp(-np.exp(stray[POWER] * np.log(nodes[j])))
    return out, first


@jit
def electrons_of(frame: Int, unit: float, blocks: Float, side: int, margin: int) -> Float:
    """The electrons of a frame of `unit` to each, with those of blocks of `side` pixels, `margin` before its first.

    blocks : electrons a pixel, interpolated linearly between the blocks' centres
    returns : float64[ny, nx] in the place of the frame, which is lost
    """
    ny, nx = frame.shape
    out, one = frame.view(np.float64), 1.0 / unit
    middle = 0.5 * (side - 1)
    left, part = np.empty(nx, np.int64), np.empty(nx)
    for c in range(nx):
        x = (c - middle) / side + margin
        left[c] = int(np.floor(x))
        part[c] = x - left[c]
    for r in range(ny):
        y = (r - middle) / side + margin
        low = int(np.floor(y))
        up = y - low
        line = (1.0 - up) * blocks[low] + up * blocks[low + 1]
        for c in range(nx):
            out[r, c] = frame[r, c] * one + line[left[c]] + part[c] * (line[left[c] + 1] - line[left[c]])
    return out


@jit
def between(
    spectrum: npt.NDArray[Any], across: Float, up: Float, width: int, slope: float, out: npt.NDArray[Any]
) -> None:
    """Fills out [s] with the sums of a periodic spectrum [ny, nx] under a window about frequencies, radian / pixel.

    window : exp(slope (sqrt(1 - z^2) - 1)), z = -1 .. 1 over `width` samples a direction
    """
    ny, nx = spectrum.shape
    x_weights, y_weights = np.empty(width), np.empty(width)
    for i in range(len(out)):
        x, y = across[i] * nx / _TWO_PI, up[i] * ny / _TWO_PI
        left, low = int(np.ceil(x - 0.5 * width)), int(np.ceil(y - 0.5 * width))
        for j in range(width):
            zx, zy = 2.0 * (left + j - x) / width, 2.0 * (low + j - y) / width
            x_weights[j] = np.exp(slope * (np.sqrt(max(1.0 - zx * zx, 0.0)) - 1.0))
            y_weights[j] = np.exp(slope * (np.sqrt(max(1.0 - zy * zy, 0.0)) - 1.0))
        total = complex(0.0)
        for r in range(width):
            line = complex(0.0)
            for c in range(width):
                line += x_weights[c] * spectrum[(low + r) % ny, (left + c) % nx]
            total += y_weights[r] * line
        out[i] = total
