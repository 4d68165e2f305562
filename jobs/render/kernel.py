"""The inner loops of drawing, compiled: a source's Fourier transform on its stamp's grid, and the sum of stamps.

nyquist_zones profile x PSF x pixel x phase on the half plane, wrapped onto the pixels' Nyquist zone
accumulate    stamps onto the frame, in fixed point
add_blocks    a smooth layer onto the frame

The half plane is held as its aliases: sample (row, column) of the zone and the same place in the neighbouring zones,
which all fall on it. Precision is that of the planes: single, but double for sources so bright that it would show.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from jobs.compiling import jit
from jobs.render.sersic import FIRST_BITS

Float = npt.NDArray[np.float64]
Float32 = npt.NDArray[np.float32]
Int = npt.NDArray[np.int64]
Bool = npt.NDArray[np.bool_]

# What an electron is in the frame's integers: 2^20. The frame then holds 8e12 electrons a pixel, to 1e-6.
FIXED_POINT = float(1 << 20)
_TWO_PI = 2.0 * np.pi
_FIRST = int(FIRST_BITS)


@jit
def nyquist_zones(
    zones: npt.NDArray[Any], planes: npt.NDArray[Any], low: Int, high: Int, envelope: Float, envelope_step: float,
    weights: npt.NDArray[Any], x: Float, y: Float, electrons: Float, sersic: Float32, body: Bool, fraction: Float,
    bulge: Float, disk: Float, thick: Float, row: Int, row_weights: Float, floor: Float,
) -> None:  # fmt: skip
    """Fills zones, complex[m, N, N / 2 + 1]: what irfft2 turns into the stamps of m sources.

    planes      : [aliases, N, b, 2, N / 2 + 1] real and imaginary part of PSF x pixel; weights [m, b] sum them
    low, high   : [aliases, N] columns beyond which the planes hold nothing
    envelope    : largest modulus of the planes at k = i * envelope_step, radian / pixel
    body        : [m] False for a point
    fraction    : [m] of the light in the bulge
    bulge, disk, thick : [m, 2, 2], [m, 2, 2], [m, 2] of profiles.Forms
    sersic      : table of sersic.py; row, row_weights : [m], [m, 4] from sersic.row_of
    floor       : [m] samples of less than this (1 at k = 0) are left out
    x, y        : [m] position in the stamp, pixels, 0 = centre of the first;  electrons : [m]
    """
    for i in range(len(zones)):
        _zone(
            zones[i], planes, low, high, envelope, envelope_step, weights[i], x[i], y[i], electrons[i], sersic, body[i],
            fraction[i], bulge[i], disk[i], thick[i], row[i], row_weights[i], floor[i],
        )  # fmt: skip


@jit
def _zone(
    zone: npt.NDArray[Any], planes: npt.NDArray[Any], low: Int, high: Int, envelope: Float, envelope_step: float,
    weights: npt.NDArray[Any], x: float, y: float, electrons: float, sersic: Float32, body: bool, fraction: float,
    bulge: Float, disk: Float, thick: Float, row: int, row_weights: Float, floor: float,
) -> None:  # fmt: skip
    aliases, n, columns = planes.shape[0], planes.shape[1], planes.shape[4]
    step = _TWO_PI / n
    table = np.empty(sersic.shape[1] if body and fraction > 0.0 else 1, np.float32)
    cut = len(envelope) * envelope_step
    if body:
        cut = _reach(envelope, envelope_step, fraction, bulge, disk, sersic, row, floor)
        if fraction > 0.0:
            # Rows of samples end up to a step beyond the cut.
            most = 1.01 * (cut + 2.0 * step) ** 2 * np.sum(bulge**2)
            least = 0.99 * step**2 * _smaller(bulge)
            _interpolate(sersic, row, row_weights, least, most, table)
    re, im = np.empty(columns, planes.dtype), np.empty(columns, planes.dtype)
    sum_re, sum_im = np.empty(columns, planes.dtype), np.empty(columns, planes.dtype)
    profile, square = np.empty(columns, np.float32), np.empty(columns, np.float32)
    bits = square.view(np.int32)
    turned, cos_x, sin_x = np.empty(2, planes.dtype), np.empty(columns), np.empty(columns)
    ramp = np.empty(columns, np.float32)
    for c in range(columns):
        ramp[c] = step * c
        cos_x[c], sin_x[c] = np.cos(step * c * x), np.sin(step * c * x)
    for r in range(n):
        sum_re[:] = 0
        sum_im[:] = 0
        upper = r < (n + 1) // 2
        ky_zone = step * (r if upper else r - n)
        for a in range(aliases):
            right, up = a % 2, a // 2
            ky = ky_zone - up * (_TWO_PI if upper else -_TWO_PI)
            if abs(ky) >= cut:
                continue
            widest = int(np.sqrt((cut - ky) * (cut + ky)) / step) + 1
            first = max(low[a, r], n - widest) if right else low[a, r]
            last = high[a, r] if right else min(high[a, r], widest)
            if first >= last:
                continue
            # From 0 over a slice: only so does the compiler use whole vectors.
            some_re, some_im = re[first:last], im[first:last]
            _collapse(planes[a, r], weights, first, last, some_re, some_im)
            if body:
                some = profile[first:last]
                start = step * first - (_TWO_PI if right else 0.0)
                _profile(fraction, bulge, disk, thick, table, start, ramp, ky, square, bits, some)
                for c in range(len(some)):
                    some_re[c] *= some[c]
                    some_im[c] *= some[c]
            turn = _TWO_PI * ((x if right else 0.0) + (0.0 if not up else (y if upper else -y)))
            turned[0], turned[1] = np.cos(turn), np.sin(turn)
            _add_turned(turned[0], turned[1], some_re, some_im, sum_re[first:last], sum_im[first:last])
        cos_y, sin_y = electrons * np.cos(ky_zone * y), electrons * np.sin(ky_zone * y)
        for c in range(columns):
            turn_re = cos_x[c] * cos_y - sin_x[c] * sin_y
            turn_im = -(sin_x[c] * cos_y + cos_x[c] * sin_y)
            zone[r, c] = complex(sum_re[c] * turn_re - sum_im[c] * turn_im, sum_re[c] * turn_im + sum_im[c] * turn_re)


@jit
def _collapse(planes: Any, weights: Any, first: int, last: int, re: Any, im: Any) -> None:
    """Fills re, im with the sum of the columns first .. last of the planes [b, 2, columns]."""
    for part, out in ((0, re), (1, im)):
        triples = len(weights) // 3 * 3
        for c in range(len(out)):
            out[c] = 0
        for b in range(0, triples, 3):
            w0, w1, w2 = weights[b], weights[b + 1], weights[b + 2]
            p0, p1, p2 = planes[b, part][first:last], planes[b + 1, part][first:last], planes[b + 2, part][first:last]
            for c in range(len(out)):
                out[c] += w0 * p0[c] + w1 * p1[c] + w2 * p2[c]
        for b in range(triples, len(weights)):
            w, p = weights[b], planes[b, part][first:last]
            for c in range(len(out)):
                out[c] += w * p[c]


@jit
def _add_turned(cosine: Any, sine: Any, re: Any, im: Any, sum_re: Any, sum_im: Any) -> None:
    for c in range(len(re)):
        sum_re[c] += cosine * re[c] - sine * im[c]
        sum_im[c] += cosine * im[c] + sine * re[c]


@jit
def _profile(
    fraction: float, bulge: Float, disk: Float, thick: Float, table: Float32, start: float, ramp: Float32, ky: float,
    square: Float32, bits: Any, out: Float32,
) -> None:  # fmt: skip
    """Fills `out` with the profile's transform at kx = start + ramp; square and its bits are scratch."""
    first = np.float32(start)
    one, share = np.float32(1.0), np.float32(1.0 - fraction)
    if fraction < 1.0:
        u0, u1 = np.float32(disk[0, 0]), np.float32(disk[1, 0] * ky)
        v0, v1 = np.float32(disk[0, 1]), np.float32(disk[1, 1] * ky)
        t0, t1 = np.float32(thick[0]), np.float32(thick[1] * ky)
        for c in range(len(out)):
            kx = first + ramp[c]
            u, v, q = u1 + u0 * kx, v1 + v0 * kx, t1 + t0 * kx
            s = one + (u * u + v * v)
            out[c] = share / (s * np.sqrt(s) * _sinh_over(q * q))
    else:
        for c in range(len(out)):
            out[c] = np.float32(0.0)
    if fraction > 0.0:
        share = np.float32(fraction)
        u0, u1 = np.float32(bulge[0, 0]), np.float32(bulge[1, 0] * ky)
        v0, v1 = np.float32(bulge[0, 1]), np.float32(bulge[1, 1] * ky)
        for c in range(len(out)):
            kx = first + ramp[c]
            u, v = u1 + u0 * kx, v1 + v0 * kx
            square[c] = u * u + v * v
        end = np.int32(len(table) - 2)
        for c in range(len(out)):
            i = np.uint32(min(max((bits[c] >> np.int32(16)) - np.int32(_FIRST), np.int32(0)), end))
            part = np.float32(bits[c] & np.int32(0xFFFF)) * np.float32(1.0 / 65536.0)
            below = table[i]
            out[c] += share * (below + part * (table[i + np.uint32(1)] - below))


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
def _reach(
    envelope: Float, envelope_step: float, fraction: float, bulge: Float, disk: Float, sersic: Float32, row: int,
    floor: float,
) -> float:  # fmt: skip
    """The k beyond which profile times PSF is below `floor` in every direction."""
    slim_disk, slim_bulge = _smaller(disk), _smaller(bulge)
    square = np.empty(1, np.float32)
    bits = square.view(np.int32)
    for i in range(len(envelope) - 1, 0, -1):
        k2 = (envelope_step * (i - 1)) ** 2
        most = 0.0
        if fraction < 1.0:
            most += (1.0 - fraction) * (1.0 + slim_disk * k2) ** -1.5
        if fraction > 0.0:
            square[0] = slim_bulge * k2
            column = min(max((bits[0] >> 16) - np.int32(_FIRST), np.int32(0)), np.int32(sersic.shape[1] - 1))
            most += fraction * max(abs(sersic[row + 1, column]), abs(sersic[row + 2, column]))
        if most * envelope[i] > floor:
            return envelope_step * (i + 1)
    return envelope_step


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
def accumulate(frame: Int, stamps: npt.NDArray[Any], x0: Int, y0: Int) -> None:
    """Adds stamps [m, N, N] with their lower left pixels at (x0, y0) to the frame, in units of 1 / FIXED_POINT.

    Whole numbers: the sum is the same, bit by bit, in any order.
    """
    ny, nx = frame.shape
    for i in range(len(stamps)):
        for r in range(max(0, -y0[i]), min(stamps.shape[1], ny - y0[i])):
            for c in range(max(0, -x0[i]), min(stamps.shape[2], nx - x0[i])):
                frame[y0[i] + r, x0[i] + c] += np.int64(np.rint(np.float64(stamps[i, r, c]) * FIXED_POINT))


@jit
def add_blocks(frame: Float, blocks: Float, side: int, margin: int) -> None:
    """Adds blocks of `side` pixels, `margin` of them before the frame's first, interpolated linearly."""
    ny, nx = frame.shape
    middle = 0.5 * (side - 1)
    for r in range(ny):
        y = (r - middle) / side + margin
        low = int(np.floor(y))
        part = y - low
        line = (1.0 - part) * blocks[low] + part * blocks[low + 1]
        for c in range(nx):
            x = (c - middle) / side + margin
            left = int(np.floor(x))
            frame[r, c] += line[left] + (x - left) * (line[left + 1] - line[left])
