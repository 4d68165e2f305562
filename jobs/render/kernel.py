"""The inner loops of drawing, compiled: a source's Fourier transform on its stamp's grid, and the sum of stamps.

nyquist_zone  profile x PSF x pixel x phase on the half plane, wrapped onto the pixels' Nyquist zone
accumulate    a stamp onto the frame, in fixed point

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

# What an electron is in the frame's integers: 2^20. The frame then holds 8e12 electrons a pixel, to 1e-6.
FIXED_POINT = float(1 << 20)
_TWO_PI = 2.0 * np.pi
_FIRST = int(FIRST_BITS)


@jit
def nyquist_zone(
    planes: npt.NDArray[Any], weights: npt.NDArray[Any], low: Int, high: Int, envelope: Float, envelope_step: float,
    body: bool, fraction: float, bulge: Float, disk: Float, thick: Float, sersic: Float32, row: int, row_weights: Float,
    floor: float, x: float, y: float, electrons: float, zone: npt.NDArray[Any],
) -> None:  # fmt: skip
    """Fills zone, complex[N, N / 2 + 1]: what irfft2 turns into the stamp.

    planes      : [b, aliases, N, 2, N / 2 + 1] real and imaginary part of PSF x pixel; weights [b] sum them
    low, high   : [aliases, N] columns beyond which the planes hold nothing
    envelope    : largest modulus of the planes at k = i * envelope_step, radian / pixel
    body        : False for a point
    fraction    : of the light in the bulge
    bulge, disk, thick : [2, 2], [2, 2], [2] of profiles.Forms
    sersic      : table of sersic.py; row, row_weights : from sersic.row_of
    floor       : samples of less than this (1 at k = 0) are left out
    x, y        : position in the stamp, pixels, 0 = centre of the first
    """
    aliases, n, columns = planes.shape[1], planes.shape[2], planes.shape[4]
    step = _TWO_PI / n
    table = np.empty(sersic.shape[1] if body and fraction > 0.0 else 1, np.float32)
    cut = len(envelope) * envelope_step
    if body:
        cut = _reach(envelope, envelope_step, fraction, bulge, disk, sersic, row, floor)
        if fraction > 0.0:
            most = 1.01 * cut**2 * np.sum(bulge**2)
            least = 0.99 * step**2 * _smaller(bulge)
            _interpolate(sersic, row, row_weights, least, most, table)
    re, im = np.empty(columns, planes.dtype), np.empty(columns, planes.dtype)
    sum_re, sum_im = np.empty(columns, planes.dtype), np.empty(columns, planes.dtype)
    profile, square = np.empty(columns, np.float32), np.empty(columns, np.float32)
    bits = square.view(np.int32)
    turned, cos_x, sin_x = np.empty(2, planes.dtype), np.empty(columns), np.empty(columns)
    for c in range(columns):
        cos_x[c], sin_x[c] = np.cos(step * c * x), np.sin(step * c * x)
    for r in range(n):
        sum_re[:] = 0
        sum_im[:] = 0
        upper = r < (n + 1) // 2
        ky_zone = step * (r if upper else r - n)
        for a in range(aliases):
            right, up = a % 2, a // 2
            ky = ky_zone - up * (_TWO_PI if upper else -_TWO_PI)
            if abs(ky) > cut:
                continue
            widest = int(np.sqrt(cut * cut - ky * ky) / step) + 1
            first = max(low[a, r], n - widest) if right else low[a, r]
            last = high[a, r] if right else min(high[a, r], widest)
            if first >= last:
                continue
            _collapse(planes[:, a, r], weights, first, last, re, im)
            if body:
                shift = -_TWO_PI if right else 0.0
                _profile(fraction, bulge, disk, thick, table, step, shift, ky, first, last, square, bits, profile)
                for c in range(first, last):
                    re[c] *= profile[c]
                    im[c] *= profile[c]
            turn = _TWO_PI * ((x if right else 0.0) + (0.0 if not up else (y if upper else -y)))
            turned[0], turned[1] = np.cos(turn), np.sin(turn)
            cosine, sine = turned[0], turned[1]
            for c in range(first, last):
                sum_re[c] += cosine * re[c] - sine * im[c]
                sum_im[c] += cosine * im[c] + sine * re[c]
        cos_y, sin_y = electrons * np.cos(ky_zone * y), electrons * np.sin(ky_zone * y)
        for c in range(columns):
            turn_re = cos_x[c] * cos_y - sin_x[c] * sin_y
            turn_im = -(sin_x[c] * cos_y + cos_x[c] * sin_y)
            zone[r, c] = complex(sum_re[c] * turn_re - sum_im[c] * turn_im, sum_re[c] * turn_im + sum_im[c] * turn_re)


@jit
def _collapse(planes: Any, weights: Any, first: int, last: int, re: Any, im: Any) -> None:
    for c in range(first, last):
        re[c] = weights[0] * planes[0, 0, c]
        im[c] = weights[0] * planes[0, 1, c]
    for b in range(1, len(weights)):
        w = weights[b]
        for c in range(first, last):
            re[c] += w * planes[b, 0, c]
            im[c] += w * planes[b, 1, c]


@jit
def _profile(
    fraction: float, bulge: Float, disk: Float, thick: Float, table: Float32, step: Any, shift: Any, ky: float,
    first: int, last: int, square: Float32, bits: Any, out: Float32,
) -> None:  # fmt: skip
    """Fills out[first:last] with the profile's transform along a row of k."""
    one, step, shift = np.float32(1.0), np.float32(step), np.float32(shift)
    if fraction < 1.0:
        share = np.float32(1.0 - fraction)
        u0, u1 = np.float32(disk[0, 0]), np.float32(disk[1, 0] * ky)
        v0, v1 = np.float32(disk[0, 1]), np.float32(disk[1, 1] * ky)
        t0, t1 = np.float32(thick[0]), np.float32(thick[1] * ky)
        for c in range(first, last):
            kx = step * np.float32(c) + shift
            u, v, q = u1 + u0 * kx, v1 + v0 * kx, t1 + t0 * kx
            s = one + (u * u + v * v)
            out[c] = share / (s * np.sqrt(s) * _sinh_over(q * q))
    else:
        for c in range(first, last):
            out[c] = np.float32(0.0)
    if fraction > 0.0:
        share = np.float32(fraction)
        u0, u1 = np.float32(bulge[0, 0]), np.float32(bulge[1, 0] * ky)
        v0, v1 = np.float32(bulge[0, 1]), np.float32(bulge[1, 1] * ky)
        for c in range(first, last):
            kx = step * np.float32(c) + shift
            u, v = u1 + u0 * kx, v1 + v0 * kx
            square[c] = u * u + v * v
        end = np.int32(len(table) - 2)
        for c in range(first, last):
            i = (bits[c] >> 16) - np.int32(_FIRST)
            i = min(max(i, np.int32(0)), end)
            part = np.float32(bits[c] & 0xFFFF) * np.float32(1.0 / 65536.0)
            out[c] += share * (table[i] + part * (table[i + 1] - table[i]))


@jit
def _sinh_over(square: Any) -> Any:
    """sinh q / q from q^2: Taylor's series, 1e-7 for q < 4, and huge where 1e-7 matters no more."""
    one = np.float32(1.0)
    out = one + square * np.float32(1.0 / 342.0)
    for denominator in (272.0, 210.0, 156.0, 110.0, 72.0, 42.0, 20.0, 6.0):
        out = one + square * np.float32(1.0 / denominator) * out
    return out


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
def accumulate(frame: Int, stamp: npt.NDArray[Any], x0: int, y0: int) -> None:
    """Adds a stamp with its lower left pixel at (x0, y0) to the frame, in units of 1 / FIXED_POINT.

    Whole numbers: the sum is the same, bit by bit, in any order.
    """
    for r in range(max(0, -y0), min(stamp.shape[0], frame.shape[0] - y0)):
        for c in range(max(0, -x0), min(stamp.shape[1], frame.shape[1] - x0)):
            frame[y0 + r, x0 + c] += np.int64(np.rint(np.float64(stamp[r, c]) * FIXED_POINT))
