"""The inner loops of drawing, compiled: a source's Fourier transform on its stamp's grid, and the sum of stamps.

units_of      what an electron is in a frame's integers
nyquist_zones profile x PSF x pixel x phase on the half plane, wrapped onto the pixels' Nyquist zone
runs          which samples of a stamp's grid are taken, in what order
take          the samples of a stamp's grid from a transform
add_planes    planes of a PSF, weighted, summed
between       a transform between its samples
reaches       how far in Fourier space a source must be followed

Precision is that of the planes: single, but double for sources so bright that it would show.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from lake_schema.arrays import Array, Bool, Float, Float32, Int
from truesky.numerics.compiling import jit
from truesky.render.drawing.kernels.frame import FIXED_POINT, FULL, min_singular_squared
from truesky.render.sources.sersic import FIRST_BITS

_TWO_PI = 2.0 * np.pi
_FIRST = int(FIRST_BITS)


def units_of(electrons: Float) -> float:
    """Units of an electron in a frame of sources [n], a power of two: FIXED_POINT, or what they all fit in, in a pixel.

    Error : of 5e13 electrons, the brightest star of the sky in 560 s, the frame is to 1e-5 of one; of 1e17 to 0.06
    """
    _, octave = math.frexp(math.fsum(electrons.tolist()))
    return min(FIXED_POINT, 2.0 ** (FULL - octave))


@jit
def nyquist_zones(
    zones: Array, planes: Array, kx: Float32, ky: Float32, runs: Int, pieces: Int, inner: Float,
    weights: Array, x: Float, y: Float, electrons: Float, cut: Float, sersic: Float32, body: Bool,
    fraction: Float, bulge: Float, disk: Float, thick: Float, row: Int, row_weights: Float, trail: Float,
) -> None:  # fmt: skip
    """Fills zones, complex[m, N, N / 2 + 1]: what irfft2 turns into the stamps of m sources.

    planes, kx .. inner : of transfer.Transfer and transfer.Grid; weights [m, b] sum the planes
    body        : [m] False for a point
    fraction    : [m] of the light in the bulge
    bulge, disk, thick : [m, 2, 2], [m, 2, 2], [m, 2] of galaxy_shapes.Forms
    sersic      : table of sersic.py; row, row_weights : [m], [m, 4] from sersic.row_of
    cut         : [m] pieces from this |k| on, radian / pixel, are left out
    x, y        : [m] position in the stamp, pixels, 0 = centre of the first;  electrons : [m]
    trail       : [m, 2] pixels that it moves by, along columns and rows, about this position
    ky, runs    : of transfer.Grid
    """
    m, n, columns = zones.shape
    longest_piece, low, high, max_iy = 0, 0, 0, 0
    for p in range(len(inner)):
        longest_piece = max(longest_piece, runs[pieces[p + 1], 0] - runs[pieces[p], 0])
    for j in range(len(runs) - 1):
        low, high = min(low, runs[j, 1]), max(high, runs[j, 1] + runs[j + 1, 0] - runs[j, 0])
        max_iy = max(max_iy, abs(runs[j, 2]))
    # Phase by column and by row; the electrons enter with the rows.
    of_column, of_row = np.empty((m, 2, high - low), planes.dtype), np.empty((m, 2, 2 * max_iy + 1), planes.dtype)
    tables = np.empty((m, sersic.shape[1]), np.float32)
    sums = np.zeros((m, 2, n, columns), planes.dtype)
    step = _TWO_PI / n
    for i in range(m):
        for c in range(low, high):
            of_column[i, 0, c - low], of_column[i, 1, c - low] = np.cos(step * c * x[i]), -np.sin(step * c * x[i])
        for r in range(-max_iy, max_iy + 1):
            of_row[i, 0, r + max_iy] = electrons[i] * np.cos(step * r * y[i])
            of_row[i, 1, r + max_iy] = -electrons[i] * np.sin(step * r * y[i])
        if body[i] and fraction[i] > 0.0:
            # Pieces are taken whole: to the inner edge of the first that is not.
            outer = step * np.hypot(max_iy, max(-low, high))
            for p in range(len(inner) - 1, -1, -1):
                outer = inner[p] if inner[p] >= cut[i] else outer
            max_square = 1.01 * (outer + 2.0 * step) ** 2 * np.sum(bulge[i] ** 2)
            interpolate_sersic(
                sersic, row[i], row_weights[i], 0.99 * step**2 * min_singular_squared(bulge[i]), max_square, tables[i]
            )
    re, im = np.empty(longest_piece, planes.dtype), np.empty(longest_piece, planes.dtype)
    profile, square = np.empty(longest_piece, np.float32), np.empty(longest_piece, np.float32)
    bits = square.view(np.int32)
    for p in range(len(inner)):
        first, last = runs[pieces[p], 0], runs[pieces[p + 1], 0]
        # From 0 over a slice: only so does the compiler use whole vectors.
        piece_re, piece_im, piece_profile = re[: last - first], im[: last - first], profile[: last - first]
        for i in range(m):
            if inner[p] >= cut[i]:
                continue
            _collapse(planes, weights[i], first, last, piece_re, piece_im)
            if body[i]:
                profile_at(
                    fraction[i], bulge[i], disk[i], thick[i], tables[i], kx[first:last], ky[first:last], square, bits,
                    piece_profile,
                )  # fmt: skip
                for c in range(len(piece_profile)):
                    piece_re[c] *= piece_profile[c]
                    piece_im[c] *= piece_profile[c]
            if trail[i, 0] != 0.0 or trail[i, 1] != 0.0:
                _smear(trail[i, 0], trail[i, 1], kx[first:last], ky[first:last], piece_re, piece_im)
            for j in range(pieces[p], pieces[p + 1]):
                start, ix, iy = runs[j]
                length, first_column, zone_row = runs[j + 1, 0] - start, ix % n, iy % n
                _add_shifted(
                    of_column[i, :, ix - low : ix - low + length],
                    of_row[i, 0, iy + max_iy],
                    of_row[i, 1, iy + max_iy],
                    re[start - first : start - first + length],
                    im[start - first : start - first + length],
                    sums[i, 0, zone_row, first_column : first_column + length],
                    sums[i, 1, zone_row, first_column : first_column + length],
                )
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
def _add_shifted(column: Any, cosine: Any, sine: Any, re: Any, im: Any, sum_re: Any, sum_im: Any) -> None:
    cosines, sines = column[0], column[1]
    for c in range(len(re)):
        turn_re = cosines[c] * cosine - sines[c] * sine
        turn_im = cosines[c] * sine + sines[c] * cosine
        sum_re[c] += turn_re * re[c] - turn_im * im[c]
        sum_im[c] += turn_re * im[c] + turn_im * re[c]


@jit
def profile_at(
    fraction: float, bulge: Float, disk: Float, thick: Float, table: Float32, kx: Float32, ky: Float32,
    square: Float32, bits: Any, out: Float32,
) -> None:  # fmt: skip
    """Fills `out` with the profile's transform at (kx, ky); square and its bits are scratch.

    fraction, bulge, disk, thick : of one galaxy, as of `nyquist_zones`;  table : of its Sersic index (`interpolate`)
    """
    unit, share = np.float32(1.0), np.float32(1.0 - fraction)
    if fraction < 1.0:
        u0, u1 = np.float32(disk[0, 0]), np.float32(disk[1, 0])
        v0, v1 = np.float32(disk[0, 1]), np.float32(disk[1, 1])
        t0, t1 = np.float32(thick[0]), np.float32(thick[1])
        for c in range(len(out)):
            u, v, q = u0 * kx[c] + u1 * ky[c], v0 * kx[c] + v1 * ky[c], t0 * kx[c] + t1 * ky[c]
            s = unit + (u * u + v * v)
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
    unit = np.float32(1.0)
    out = unit + square * np.float32(1.0 / 342.0)
    out = unit + square * np.float32(1.0 / 272.0) * out
    out = unit + square * np.float32(1.0 / 210.0) * out
    out = unit + square * np.float32(1.0 / 156.0) * out
    out = unit + square * np.float32(1.0 / 110.0) * out
    out = unit + square * np.float32(1.0 / 72.0) * out
    out = unit + square * np.float32(1.0 / 42.0) * out
    out = unit + square * np.float32(1.0 / 20.0) * out
    return unit + square * np.float32(1.0 / 6.0) * out


@jit
def fourier_reach(
    max_transfer: Float, step: float, body: Bool, fraction: Float, bulge: Float, disk: Float, sersic: Float32, row: Int,
    floor: Float,
) -> Float:  # fmt: skip
    """[m] the |k|, radian / pixel, beyond which profile times PSF is below `floor` [m] in every direction.

    passing : [i] the most that the PSF passes at |k| = i step
    step    : radian / pixel;  floor : [m] part of the flux
    body, fraction, bulge, disk, sersic, row : as of `nyquist_zones`
    """
    out = np.full(len(body), step * len(max_transfer))
    square = np.empty(1, np.float32)
    bits = square.view(np.int32)
    for j in range(len(body)):
        slim_disk, slim_bulge = min_singular_squared(disk[j]), min_singular_squared(bulge[j])
        for i in range(len(max_transfer) - 1, -1, -1):
            out[j] = step * (i + 1)
            k2 = (step * i) ** 2
            upper_bound = 0.0 if body[j] else 1.0
            if body[j] and fraction[j] < 1.0:
                upper_bound += (1.0 - fraction[j]) * (1.0 + slim_disk * k2) ** -1.5
            if body[j] and fraction[j] > 0.0:
                square[0] = slim_bulge * k2
                column = min(max((bits[0] >> 16) - np.int32(_FIRST), np.int32(0)), np.int32(sersic.shape[1] - 1))
                upper_bound += fraction[j] * max(abs(sersic[row[j] + 1, column]), abs(sersic[row[j] + 2, column]))
            if upper_bound * max_transfer[i] > floor[j]:
                break
    return out


@jit
def interpolate_sersic(
    sersic: Float32, row: int, row_weights: Float, min_square: float, max_square: float, table: Float32
) -> None:
    """One index's transform, where the source needs it, into `table`.

    sersic      : of all indices;  row, row_weights : of the four about the one that is wanted
    least, most : squared frequencies, times the square of the radius
    """
    ends = np.array([min_square, max_square], np.float32)
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
def take_samples(spectrum: Array, runs: Int, pixel: Float, out: Array) -> None:
    """Fills out [2, s] with the samples of transfer.Grid.runs: real and imaginary part of spectrum times pixel.

    spectrum : complex[iy, ix], ix >= 0 of a real image;  pixel : [|iy|, |ix|] the pixel's own transform
    """
    for j in range(len(runs) - 1):
        start, first_ix, iy = runs[j]
        for c in range(runs[j + 1, 0] - start):
            ix = first_ix + c
            pixel_transfer = pixel[abs(iy), abs(ix)]
            # What lies to the left of kx = 0 is the mirror image's conjugate.
            sample = spectrum[iy, ix] if ix >= 0 else spectrum[-iy, -ix]
            out[0, start + c] = pixel_transfer * sample.real
            out[1, start + c] = pixel_transfer * (sample.imag if ix >= 0 else -sample.imag)


@jit
def runs(size: int, reach: float, shells: int, out: Int) -> tuple[int, int]:
    """Runs of samples of a stamp's Fourier grid: see transfer.Grid.

    reach   : largest |(ix, iy)|;  shells : rings of equal width that the runs are sorted by, then by iy
    out     : filled with first sample, ix, iy, shell, as far as it has rows
    size    : side of the stamp, pixels
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
    """Adds the weighted sum of planes [b, s, s] to the image inside a margin.

    weights : [b] of the planes;  margin : pixels of the image before the first of the planes
    """
    for r in range(planes.shape[1]):
        out = image[margin + r, margin : margin + planes.shape[2]]
        for b in range(len(planes)):
            weight, line = np.float32(weights[b]), planes[b, r]
            for c in range(len(out)):
                out[c] += weight * line[c]


@jit
def interpolate_spectrum(spectrum: Array, across: Float, up: Float, width: int, slope: float, out: Array) -> None:
    """Fills out [s] with the sums of a periodic spectrum [ny, nx] under a window about frequencies, radian / pixel.

    window : exp(slope (sqrt(1 - z^2) - 1)), z = -1 .. 1 over `width` samples a direction
    across, up : [s] frequencies along columns and rows, radian / pixel
    """
    ny, nx = spectrum.shape
    x_weights, y_weights = np.empty(width), np.empty(width)
    for i in range(len(out)):
        x, y = across[i] * nx / _TWO_PI, up[i] * ny / _TWO_PI
        first_x, first_y = int(np.ceil(x - 0.5 * width)), int(np.ceil(y - 0.5 * width))
        for j in range(width):
            zx, zy = 2.0 * (first_x + j - x) / width, 2.0 * (first_y + j - y) / width
            x_weights[j] = np.exp(slope * (np.sqrt(max(1.0 - zx * zx, 0.0)) - 1.0))
            y_weights[j] = np.exp(slope * (np.sqrt(max(1.0 - zy * zy, 0.0)) - 1.0))
        total = complex(0.0)
        for r in range(width):
            line = complex(0.0)
            for c in range(width):
                line += x_weights[c] * spectrum[(first_y + r) % ny, (first_x + c) % nx]
            total += y_weights[r] * line
        out[i] = total
