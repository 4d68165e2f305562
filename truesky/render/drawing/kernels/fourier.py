"""Compiled inner loops of drawing in Fourier space: transforms of sources at the frequencies of their stamps.

A stamp is a square image around one source. The data type of the PSF's transform (planes) determines the precision:
single, or double for sources that are bright enough to show rounding errors.
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
    """Return the factor from electrons to the integers in which the light of all sources is summed.

    It is FIXED_POINT (2^20), or a smaller power of two if the sum of `electrons` [n] would be too large for int64.

    Notes
    -----
    With 5e13 electrons (the brightest star of the sky in 560 s) the sum is exact to 1e-5 electrons; with 1e17
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
    """Fill the Fourier half planes that irfft2 transforms to the stamps of m sources.

    Parameters
    ----------
    zones : complex array, shape (m, N, N / 2 + 1)
        Result: transforms of the sources, convolved with PSF and pixel and shifted to their positions. Frequencies
        above the Nyquist frequency of the pixels are aliased.
    planes : float array, shape (b, 2, s)
        Real and imaginary parts of the PSF's transforms, from `transfer.Transfer`.
    kx, ky : float32 array, shape (s,)
        Frequencies of `transfer.Grid`, radian / pixel.
    runs, pieces, inner : array
        Attributes of `transfer.Grid`: order of the frequencies, their division into groups of similar |k| (pieces), and
        the lower limit of |k| in each piece, radian / pixel.
    weights : array, shape (m, b)
        Weights with which the b transforms in `planes` are summed to the transform of each source's PSF.
    x, y : float array, shape (m,)
        Positions in the stamp, pixels; 0 is the centre of the first pixel.
    electrons : float array, shape (m,)
        Expected electrons.
    cut : float array, shape (m,)
        Pieces with |k| of at least this value are omitted for a source, radian / pixel.
    sersic : float32 array, shape (indices, nodes)
        Transforms of Sersic profiles, from `sersic.table`.
    body : bool array, shape (m,)
        False for point sources.
    fraction : float array, shape (m,)
        Fraction of the light in the bulge.
    bulge, disk : float array, shape (m, 2, 2)
        Matrices of `galaxy_shapes.Forms`, whose columns are the vectors of the major and minor axis of bulge or disc,
        pixels. The profile is round in k @ matrix, for a frequency k in radian / pixel.
    thick : float array, shape (m, 2)
        Vectors of `galaxy_shapes.Forms` that describe the thickness of inclined discs, pixels: with q = k @ thick, the
        transform of the disc is multiplied by q / sinh q.
    row : int array, shape (m,)
        First of the four rows of `sersic` from which the transform for the source's Sersic index is interpolated.
    row_weights : float array, shape (m, 4)
        Interpolation weights of these four rows.
    trail : float array, shape (m, 2)
        Displacement along columns and rows during the exposure, centred on the position, pixels; 0 for sources at rest.
    """
    m, n, columns = zones.shape
    longest_piece, low, high, max_iy = 0, 0, 0, 0
    for p in range(len(inner)):
        longest_piece = max(longest_piece, runs[pieces[p + 1], 0] - runs[pieces[p], 0])
    for j in range(len(runs) - 1):
        low, high = min(low, runs[j, 1]), max(high, runs[j, 1] + runs[j + 1, 0] - runs[j, 0])
        max_iy = max(max_iy, abs(runs[j, 2]))
    # Cosine and minus sine of the phase shift to the source's position, separately for kx (`of_column`) and for ky
    # (`of_row`). The factors for ky are multiplied by the electrons of the source.
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
            # A piece (group of frequencies with similar |k|) is used as a whole or not at all. The largest |k| that is
            # used is therefore the lower limit of the first unused piece.
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
        # The slices contain only the samples of this piece (group of frequencies), so loops over them start at 0. The
        # compiler does not vectorise loops that start elsewhere.
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
    """Fill `re` and `im` with a weighted sum of Fourier transforms, for the samples `first` to `last` - 1.

    `planes` [b, 2, s] contain real and imaginary parts of b transforms (of the PSF's basis images) at s samples.
    `weights` [b] are their weights.
    """
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
    """Fill `out` with the Fourier transform of a galaxy of flux 1, bulge plus disc, at the frequencies (kx, ky).

    Parameters
    ----------
    fraction : float
        Fraction of the light in the bulge, 0 to 1.
    bulge, disk : float array, shape (2, 2)
        Matrices of `galaxy_shapes.Forms`, whose columns are the vectors of the major and minor axis of bulge or disc,
        pixels. The profile is round in k @ matrix, for a frequency k = (kx, ky).
    thick : float array, shape (2,)
        Vector of `galaxy_shapes.Forms` that describes the thickness of the inclined disc, pixels: with q = k @ thick,
        the transform of the disc is multiplied by q / sinh q.
    table : float32 array, shape (nodes,)
        Transform of the bulge for its Sersic index, from `interpolate_sersic`.
    kx, ky : float32 array, shape (s,)
        Frequencies, radian / pixel.
    square : float32 array
        Scratch memory of at least s elements; its content is overwritten.
    bits : int32 array
        View of the memory of `square` as integers, by which `table` is indexed.
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
    """Multiply `re` and `im` in place by the transform of a straight trail, to draw a source that moves uniformly.

    The transform is sin(q) / q with q = (kx across + ky along) / 2, at the frequencies (kx, ky) in radian / pixel.
    `across` and `along` are the displacements in column and row during the exposure, pixels.
    """
    for c in range(len(re)):
        q = 0.5 * (across * kx[c] + along * ky[c])
        smeared = np.sin(q) / q if abs(q) > 1e-4 else 1.0
        re[c] *= smeared
        im[c] *= smeared


@jit
def _sinh_over(square: Any) -> Any:
    """Return sinh q / q from q^2 (`square`) by the Taylor series, with a relative error of 1e-7 for q < 4.

    It is used for the thickness of a galaxy's disc, whose transform is divided by the result. For q above 4 the result
    is too small, but the transform of the disc is negligible there.
    """
    # The series is written out with constant factors. A loop over coefficients would make a division in each term.
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
    """Return the |k| beyond which the transform of each of m sources, convolved with the PSF, is negligible.

    Parameters
    ----------
    max_transfer : float array, shape (i,)
        Largest modulus of the PSF's transform in each ring of |k|, from `transfer.max_transfer`. Rings have equal
        widths and begin at 0.
    step : float
        Width of the rings, radian / pixel.
    body : bool array, shape (m,)
        False for point sources.
    fraction : float array, shape (m,)
        Fraction of the light in the bulge.
    bulge, disk : float array, shape (m, 2, 2)
        Matrices of `galaxy_shapes.Forms`: vectors of the major and minor axis of bulge or disc (columns), pixels.
    sersic : float32 array, shape (indices, nodes)
        Transforms of Sersic profiles, from `sersic.table`.
    row : int array, shape (m,)
        First of the four rows of `sersic` between which the transform of the bulge is interpolated.
    floor : float array, shape (m,)
        Fraction of the flux below which the transform of the source is negligible.

    Returns
    -------
    float array, shape (m,)
        Outer edge of the last ring that is not negligible in some direction, radian / pixel; at least one ring is
        always included.
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
    """Interpolate the Fourier transform of a Sersic profile between tabulated indices.

    Parameters
    ----------
    sersic : float32 array, shape (indices, nodes)
        Transforms for all tabulated Sersic indices, from `sersic.table`. The nodes are values of (k r)^2, with the
        half-light radius r.
    row : int
        First of the four rows from which the transform is interpolated.
    row_weights : float array, shape (4,)
        Weights of these rows.
    min_square, max_square : float
        Range of (k r)^2 in which the result is needed.
    table : float32 array, shape (nodes,)
        Result. Nodes outside the range are not changed, except for the first two, which are set to 1.
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
    # At k = 0 the transform of a Sersic profile is 1. The second node of the table is set to 1 too, if it was not
    # computed above, because values at small k are interpolated between the first two nodes.
    table[0] = np.float32(1.0)
    table[1] = table[1] if low <= 1 else np.float32(1.0)


@jit
def take_samples(spectrum: Array, runs: Int, pixel: Float, out: Array) -> None:
    """Fill `out` with the values of a Fourier transform at the frequencies of a stamp, times that of the pixel.

    Parameters
    ----------
    spectrum : complex array, shape (rows, columns)
        Transform [iy, ix] of a real image for ix >= 0, and for all iy in the order of the FFT.
    runs : int array, shape (r + 1, 3)
        Sequences of frequencies of `transfer.Grid`: index of the first sample, and ix and iy of this sample.
    pixel : float array, shape (rows, columns)
        Fourier transform [|iy|, |ix|] of the response of a detector pixel, which is real.
    out : float array, shape (2, s)
        Result: real and imaginary parts.
    """
    for j in range(len(runs) - 1):
        start, first_ix, iy = runs[j]
        for c in range(runs[j + 1, 0] - start):
            ix = first_ix + c
            pixel_transfer = pixel[abs(iy), abs(ix)]
            # `spectrum` has no values for ix < 0. The transform of a real image at -k is the conjugate of that at k.
            sample = spectrum[iy, ix] if ix >= 0 else spectrum[-iy, -ix]
            out[0, start + c] = pixel_transfer * sample.real
            out[1, start + c] = pixel_transfer * (sample.imag if ix >= 0 else -sample.imag)


@jit
def runs(size: int, reach: float, shells: int, out: Int) -> tuple[int, int]:
    """Find the frequencies at which the transform of a stamp is computed, as runs (see `transfer.Grid`).

    A run is a sequence of samples with one iy and consecutive ix, where (ix, iy) times 2 pi / size is the frequency.

    Parameters
    ----------
    size : int
        Side of the stamp, pixels.
    reach : float
        Largest |(ix, iy)|.
    shells : int
        Number of rings of equal width into which the disc of frequencies is divided. Runs are sorted by ring, then by
        iy.
    out : int array, shape (r, 4)
        Result: index of the first sample, ix and iy of this sample, and ring of each run. Runs that do not fit into
        `out` are only counted, so a first call with r = 0 finds the necessary length.

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
            # A row of frequencies crosses a ring twice, left and right of its inner circle. Above or below the inner
            # circle it crosses the ring once.
            for arc in range(2 if gap >= 0 else 1):
                low = gap + 1 if arc == 1 else -last
                high = last if arc == 1 or gap < 0 else -gap - 1
                # The transform of a real image is determined by the half plane with ix modulo size from 0 to size / 2.
                # Only frequencies that lie in this half plane, or are aliased to it, are used.
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
    """Return the largest integer x with (x, y) in a circle of radius `radius` about (0, 0), or -1 if |y| > radius."""
    square = radius * radius - y * y
    return int(np.sqrt(square)) if square >= 0.0 else -1


@jit
def add_planes(image: Float32, planes: Float32, weights: Float, margin: int) -> None:
    """Add the weighted sum of planes (images of equal size) to the middle part of a larger or equal image.

    Parameters
    ----------
    image : float32 array, shape (s + 2 margin, s + 2 margin)
        Image, changed in place.
    planes : float32 array, shape (b, s, s)
        The planes; with b = 0 the image is not changed.
    weights : float array, shape (b,)
        Weights of the planes.
    margin : int
        Number of columns and rows of the image before the first pixel of the planes. Must not be negative.
    """
    for r in range(planes.shape[1]):
        out = image[margin + r, margin : margin + planes.shape[2]]
        for b in range(len(planes)):
            weight, line = np.float32(weights[b]), planes[b, r]
            for c in range(len(out)):
                out[c] += weight * line[c]


@jit
def interpolate_spectrum(spectrum: Array, across: Float, up: Float, width: int, slope: float, out: Array) -> None:
    """Fill `out` with values of a periodic spectrum at any frequencies, interpolated between its samples by a window.

    Parameters
    ----------
    spectrum : complex array, shape (ny, nx)
        Spectrum in the order of the FFT, which continues periodically.
    across, up : float array, shape (s,)
        Frequencies along columns and rows, radian / pixel.
    width : int
        Number of samples of the spectrum that are used per direction.
    slope : float
        Parameter of the window exp(slope (sqrt(1 - z^2) - 1)), with z from -1 to 1 over `width` samples.
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
