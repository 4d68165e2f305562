"""Compiled inner loops of drawing in Fourier space: transforms of sources on the grids of their stamps.

The planes determine the precision: single, or double for sources that are bright enough to show rounding errors.
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
    """Units per electron in a frame: FIXED_POINT, or a smaller power of two if the sum of `electrons` [n] requires it.

    Notes
    -----
    With 5e13 electrons (the brightest star of the sky in 560 s) the frame is exact to 1e-5 electrons; with 1e17
    electrons, to 0.06.
    """
    _, octave = math.frexp(math.fsum(electrons.tolist()))
    return min(FIXED_POINT, 2.0 ** (FULL - octave))


@jit
def nyquist_zones(
    zones: Array, planes: Array, kx: Float32, ky: Float32, runs: Int, pieces: Int, inner: Float,
    weights: Array, x: Float, y: Float, electrons: Float, cut: Float, sersic: Float32, body: Bool,
    fraction: Float, bulge: Float, disk: Float, thick: Float, row: Int, row_weights: Float, trail: Float,
) -> None:  # fmt: skip
    """Fill the half planes that irfft2 transforms to the stamps of m sources.

    Parameters
    ----------
    zones : complex array, shape (m, N, N / 2 + 1)
        Result: profile x PSF x pixel x phase, aliased to the Nyquist zone of the pixels.
    planes : float array, shape (b, 2, s)
        Planes of `transfer.Transfer`.
    kx, ky : float32 array, shape (s,)
        Frequencies of `transfer.Grid`, radian / pixel.
    runs, pieces, inner : array
        Runs and pieces of `transfer.Grid`.
    weights : array, shape (m, b)
        Weights of the planes for each source.
    x, y : float array, shape (m,)
        Positions in the stamp, pixels; 0 is the centre of the first pixel.
    electrons : float array, shape (m,)
        Expected electrons.
    cut : float array, shape (m,)
        |k| from which pieces are omitted, radian / pixel.
    sersic : float32 array
        Table of `sersic.table`.
    body : bool array, shape (m,)
        False for point sources.
    fraction : float array, shape (m,)
        Fraction of the light in the bulge.
    bulge, disk : float array, shape (m, 2, 2)
        Matrices of `galaxy_shapes.Forms`.
    thick : float array, shape (m, 2)
        Vectors of `galaxy_shapes.Forms`.
    row : int array, shape (m,)
        First row of the table for the source's Sersic index.
    row_weights : float array, shape (m, 4)
        Interpolation weights of four rows of the table.
    trail : float array, shape (m, 2)
        Displacement along columns and rows during the exposure, centred on the position, pixels.
    """
    m, n, columns = zones.shape
    longest_piece, low, high, max_iy = 0, 0, 0, 0
    for p in range(len(inner)):
        longest_piece = max(longest_piece, runs[pieces[p + 1], 0] - runs[pieces[p], 0])
    for j in range(len(runs) - 1):
        low, high = min(low, runs[j, 1]), max(high, runs[j, 1] + runs[j + 1, 0] - runs[j, 0])
        max_iy = max(max_iy, abs(runs[j, 2]))
    # Phase factors by column and by row; the row factors include the electrons.
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
            # Pieces are used as a whole, so the outer limit is the inner edge of the first unused piece.
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
        # The compiler vectorises the loops only if they start at 0 on a slice.
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
    """Fill `re` and `im` with the weighted sum of the samples first to last of the planes [b, 2, s]."""
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
    """Fill `out` with the transform of a galaxy's profile at the frequencies (kx, ky).

    Parameters
    ----------
    fraction : float
        Fraction of the light in the bulge.
    bulge, disk : float array, shape (2, 2)
        Matrices of `galaxy_shapes.Forms`.
    thick : float array, shape (2,)
        Vector of `galaxy_shapes.Forms`.
    table : float32 array
        Transform for the Sersic index, from `interpolate_sersic`.
    kx, ky : float32 array, shape (s,)
        Frequencies, radian / pixel.
    square : float32 array
        Scratch memory of at least s elements.
    bits : int32 array
        View of the bits of `square`.
    out : float32 array, shape (s,)
        Result.
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
    """Multiply by the transform of a uniform straight line: sin(q) / q with q = k . line / 2."""
    for c in range(len(re)):
        q = 0.5 * (across * kx[c] + along * ky[c])
        smeared = np.sin(q) / q if abs(q) > 1e-4 else 1.0
        re[c] *= smeared
        im[c] *= smeared


@jit
def _sinh_over(square: Any) -> Any:
    """Compute sinh q / q from q^2 by its Taylor series, exact to 1e-7 for q < 4; precision is irrelevant above."""
    # The series is written out because a loop over a tuple of coefficients would divide each time.
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
    """Largest |k| at which the product of profile and PSF exceeds a limit in any direction.

    Parameters
    ----------
    max_transfer : float array, shape (i,)
        Largest transfer function of the PSF at |k| = i step.
    step : float
        Spacing of `max_transfer`, radian / pixel.
    body, fraction, bulge, disk, sersic, row : array
        Profiles of m sources, see `nyquist_zones`.
    floor : float array, shape (m,)
        Limit, as a fraction of the flux.

    Returns
    -------
    float array, shape (m,)
        |k|, radian / pixel.
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
    """Interpolate the transform for one Sersic index, in the range that the source needs.

    Parameters
    ----------
    sersic : float32 array
        Transforms for all tabulated indices.
    row : int
        First of the four neighbouring rows.
    row_weights : float array, shape (4,)
        Weights of these rows.
    min_square, max_square : float
        Range of the squared frequency times the squared radius.
    table : float32 array
        Result, filled within this range.
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
    # At k = 0 the transform is 1.
    table[0] = np.float32(1.0)
    table[1] = table[1] if low <= 1 else np.float32(1.0)


@jit
def take_samples(spectrum: Array, runs: Int, pixel: Float, out: Array) -> None:
    """Fill `out` with the samples of a stamp's grid from a transform, multiplied by that of the pixel.

    Parameters
    ----------
    spectrum : complex array
        Transform [iy, ix] of a real image, for ix >= 0.
    runs : int array, shape (r + 1, 3)
        Runs of `transfer.Grid`.
    pixel : float array
        Transform [|iy|, |ix|] of the pixel.
    out : float array, shape (2, s)
        Result: real and imaginary parts.
    """
    for j in range(len(runs) - 1):
        start, first_ix, iy = runs[j]
        for c in range(runs[j + 1, 0] - start):
            ix = first_ix + c
            pixel_transfer = pixel[abs(iy), abs(ix)]
            # For kx < 0, the sample is the conjugate of the opposite one.
            sample = spectrum[iy, ix] if ix >= 0 else spectrum[-iy, -ix]
            out[0, start + c] = pixel_transfer * sample.real
            out[1, start + c] = pixel_transfer * (sample.imag if ix >= 0 else -sample.imag)


@jit
def runs(size: int, reach: float, shells: int, out: Int) -> tuple[int, int]:
    """Find the runs of samples of a stamp's Fourier grid, see `transfer.Grid`.

    Parameters
    ----------
    size : int
        Side of the stamp, pixels.
    reach : float
        Largest |(ix, iy)|.
    shells : int
        Number of rings of equal width. Runs are sorted by ring, then by iy.
    out : int array, shape (r, 4)
        Result: first sample, ix, iy and ring of each run, as far as there are rows.

    Returns
    -------
    (int, int)
        Number of runs, and number of samples.
    """
    count, samples = 0, 0
    for shell in range(shells):
        inside, outside = reach * shell / shells, reach * (shell + 1) / shells
        for iy in range(-int(reach), int(reach) + 1):
            last = _half_chord(outside, iy)
            gap = _half_chord(inside, iy) if shell > 0 else -1
            # A row crosses two arcs to the left and right of the inner shells, or one arc above or below them.
            for arc in range(2 if gap >= 0 else 1):
                low = gap + 1 if arc == 1 else -last
                high = last if arc == 1 or gap < 0 else -gap - 1
                # Half of the plane is sufficient for a real image, with all aliases that fall on that half.
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
    """Largest integer x >= 0 with (x, y) inside a circle, or -1."""
    square = radius * radius - y * y
    return int(np.sqrt(square)) if square >= 0.0 else -1


@jit
def add_planes(image: Float32, planes: Float32, weights: Float, margin: int) -> None:
    """Add the weighted sum of planes to the part of an image inside a margin.

    Parameters
    ----------
    image : float32 array
        Image, changed in place.
    planes : float32 array, shape (b, s, s)
        The planes.
    weights : float array, shape (b,)
        Weights of the planes.
    margin : int
        Pixels of the image before the first pixel of the planes.
    """
    for r in range(planes.shape[1]):
        out = image[margin + r, margin : margin + planes.shape[2]]
        for b in range(len(planes)):
            weight, line = np.float32(weights[b]), planes[b, r]
            for c in range(len(out)):
                out[c] += weight * line[c]


@jit
def interpolate_spectrum(spectrum: Array, across: Float, up: Float, width: int, slope: float, out: Array) -> None:
    """Fill `out` with a periodic spectrum, interpolated by a window at given frequencies.

    Parameters
    ----------
    spectrum : complex array, shape (ny, nx)
        The periodic spectrum.
    across, up : float array, shape (s,)
        Frequencies along columns and rows, radian / pixel.
    width : int
        Samples of the window per direction.
    slope : float
        Slope of the window exp(slope (sqrt(1 - z^2) - 1)), with z from -1 to 1 over `width` samples.
    out : complex array, shape (s,)
        Result.
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
