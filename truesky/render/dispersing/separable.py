"""Draw faint slitless spectra as products of a profile along and a profile across the trace.

The image I(u, v) of a source, with u along and v across the trace, is replaced by the product of its sums over v and
over u. The light of a continuum that changes slowly along the trace is then the same, and so is the light of a line in
every column and in every row. Only the shape of a line within a few pixels differs. This is not noticeable in a
spectrum whose brightest column is well below the noise of a pixel. The sums are one-dimensional Fourier transforms, and
therefore fast.
"""

from __future__ import annotations

import numpy as np
import scipy

from lake_schema.arrays import Array, Float, Float32, Int
from truesky.numerics.compiling import jit
from truesky.render.dispersing import images, kernels
from truesky.render.dispersing.images import Planes, Profiles
from truesky.render.dispersing.kernels import add_to_trace
from truesky.render.dispersing.spreading import add_piece
from truesky.render.dispersing.wavelength_bins import BINS_BEFORE

# Number of samples along the trace that are drawn with the same PSF, and so are the columns that they span.
_SAMPLES = 16


def profiles_of_images(stamp_planes: Planes, weights: Float, profiles: Profiles) -> tuple[Float32, Float32]:
    """Return the sums of the images of m sources, across and along the trace.

    Parameters
    ----------
    stamp_planes : Planes
        Fourier transforms of the PSF's p basis images, for stamps (square images of sources) of one size.
    weights : float array, shape (m, b, p)
        Weights of the p basis images in the PSF of each source, at each of b wavelengths.
    profiles : Profiles
        Bulge and disc profiles of the sources.

    Returns
    -------
    along : float32 array, shape (m, b, s_a, n)
        Sums across the trace as coefficients of the spline along it: for each of the s_a places of a sample in a pixel,
        one coefficient for each of the n pixels.
    across : float32 array, shape (m, b, n s_c)
        Sums along the trace as coefficients of the spline across it, divided by the light inside the stamp.
    """
    n, s_along, s_across = stamp_planes.sampling.shape
    half = n * s_along // 2 + 1
    planes = stamp_planes.planes
    swapped = profiles.bulge[:, ::-1], profiles.disk[:, ::-1], profiles.thick[:, ::-1]
    along_transform = _line_transforms(planes[:, :half, 0], np.abs(stamp_planes.ku[:half]), weights, profiles, swapped)
    matrices = profiles.bulge, profiles.disk, profiles.thick
    across_transform = _line_transforms(planes[:, 0, :], stamp_planes.kv, weights, profiles, matrices)
    along = scipy.fft.irfft(along_transform, n * s_along) * np.float32(1.0 / s_across)
    # Both sums have the light inside the stamp, which is less than 1. The product must have it once, so the sum of
    # `across` is normalised. The first element of a transform is the sum of all coefficients.
    across = scipy.fft.irfft(across_transform, n * s_across) * (s_across / across_transform[..., :1].real)
    by_phase = along.reshape(*along.shape[:2], n, s_along).swapaxes(2, 3)
    return np.ascontiguousarray(by_phase), np.asarray(across)


def _line_transforms(
    planes: Array, k: Float32, weights: Float, profiles: Profiles, matrices: tuple[Float, Float, Float]
) -> Array:
    """Return the Fourier transforms [m, b, columns] of the images of m sources at frequencies on one axis.

    `planes` [p, columns] are the transforms of the PSF's basis images at the frequencies `k`, radian per pixel. The
    `matrices` are the attributes `bulge`, `disk` and `thick` of the profiles, whose second axis is that of `k`.
    """
    bulge, disk, thick = (np.ascontiguousarray(matrix) for matrix in matrices)
    out = np.empty((*weights.shape[:2], 1, len(k)), np.complex64)
    kernels.zones(
        np.ascontiguousarray(planes[:, None]), weights.astype(np.float32), np.zeros(1, np.float32),
        np.ascontiguousarray(k), profiles.body, profiles.fraction, bulge, disk, thick,
        images.sersic_table(), profiles.row, profiles.row_weights, out,
    )  # fmt: skip
    return out[:, :, 0]


@jit
def draw_product(
    along_profile: Float32, across_profile: Float32, electrons: Float, share: Float, along: Float, across: Float,
    times: tuple[float, float], width: int, start: tuple[float, float], shear: float, shape: tuple[int, int, int],
    unit: float, frame: Int,
) -> float:  # fmt: skip
    """Draw one spectral order of a source on the image of a detector (frame), as a product of two profiles.

    Parameters
    ----------
    along_profile : float32 array, shape (b, s_a, n)
        Profile of the source along the trace at b wavelengths, from `profiles_of_images`.
    across_profile : float32 array, shape (b, n s_c)
        Profile of the source across the trace.
    electrons : float array, shape (bins,)
        Electrons of the source's spectrum in bins of wavelength, from `wavelength_bins.bin_electrons`.
    share : float array, shape (w, b)
        Weights that interpolate the PSF at each of the spectrum's w wavelengths from the PSFs at b wavelengths.
    along, across : float array, shape (i,)
        Coefficients of t^i of the displacement from the undispersed image in columns (`along`) and in rows, pixels.
    times : (float, float)
        Value of t at the first wavelength, and step of t from one wavelength to the next.
    width : int
        Number of wavelengths in a bin.
    start : (float, float)
        Column and row of the undispersed image, 0-based pixels.
    shear : float
        Slope of the images' rows relative to the detector's rows, in rows per column.
    shape : (int, int, int)
        Side n of the stamp in pixels, and samples per pixel, along (s_a) and across the trace (s_c).
    unit : float
        Integers of the frame per electron.
    frame : int array, shape (ny, nx)
        Frame in integers, changed in place.

    Returns
    -------
    float
        Electrons that were added to the frame; 0 if the spectrum does not touch it.

    Notes
    -----
    In each column, the profile across the trace is placed at the mean row of the light in this column. Columns that
    span 16 samples have the same PSF, for the mean wavelength of their light.
    """
    n, ox, oy = shape
    ny, nx = frame.shape
    count, bins = len(share), len(electrons)
    bin_times = times[0] - BINS_BEFORE * width * times[1], width * times[1]
    # Weights with which the light, its row relative to the sheared coordinates and its wavelength are summed.
    moments = np.ones((3, bins))
    x_min, x_max, bottom, top = np.inf, -np.inf, np.inf, -np.inf
    for k in range(bins):
        t = bin_times[0] + bin_times[1] * k
        x, y = along[len(along) - 1], across[len(across) - 1]
        for j in range(len(along) - 2, -1, -1):
            x = x * t + along[j]
        for j in range(len(across) - 2, -1, -1):
            y = y * t + across[j]
        x_min, x_max = min(x_min, start[0] + x), max(x_max, start[0] + x)
        moments[1, k], moments[2, k] = start[1] + y - shear * (start[0] + x), width * (k - BINS_BEFORE)
        bottom, top = min(bottom, moments[1, k]), max(top, moments[1, k])
    first = int(np.floor(ox * x_min)) - 3
    trace = np.zeros((3, int(np.ceil(ox * x_max)) + 4 - first))
    add_to_trace(electrons, along, bin_times, start[0], ox, moments, first, trace)
    begin = max(int(np.floor(x_min)) - n // 2 - 2, 0)
    wide = min(int(np.ceil(x_max)) + n // 2 + 3, nx) - begin
    if wide <= 0:
        return 0.0
    ends = shear * begin, shear * (begin + wide - 1)
    low_row = max(int(np.floor(bottom + min(ends[0], ends[1]))) - n // 2 - 1, 0)
    height = min(int(np.ceil(top + max(ends[0], ends[1]))) + n // 2 + 2, ny) - low_row
    if height <= 0:
        return 0.0
    columns = np.zeros((3, wide))
    _sum_columns(along_profile, trace, first, share, ox, begin, columns)
    piece = np.zeros((height, wide), np.float32)
    profiles, wrapped = np.empty((oy + 3, n), np.float32), np.empty(n * oy + oy + 4, np.float32)
    step = max(_SAMPLES // ox, 1)
    for group in range(0, wide, step):
        part = columns[:, group : group + step]
        light, number = np.sum(part[0]), np.sum(part[2])
        if light == 0.0:
            continue
        number = int(min(max(number / light, 0.0), count - 1.0))
        _mix_rows(across_profile, share[number], oy, wrapped, profiles)
        for c in range(group, min(group + step, wide)):
            if columns[0, c] != 0.0:
                row = min(max(columns[1, c] / columns[0, c], bottom), top) + shear * (begin + c)
                _add_column(profiles, columns[0, c], row, low_row, piece[:, c])
    return add_piece(piece, (begin, low_row), unit, frame)


@jit
def _mix_rows(across_profile: Float32, share: Float, oy: int, wrapped: Float32, profiles: Float32) -> None:
    """Fill `profiles` [oy + 3, n] with the profile across the trace, sorted so that `_add_column` reads it in order.

    `across_profile` [b, n oy] are the coefficients of a spline at b wavelengths, which are added with the weights
    `share` [b]. There are `oy` coefficients per row of the detector. Row k of `profiles` contains every `oy`-th of them
    from coefficient k - 1 on. The profile is periodic: coefficients before the first and after the last are those at
    the other end. `wrapped` [n oy + oy + 4] is scratch memory.
    """
    tall = across_profile.shape[1]
    line = wrapped[1 : tall + 1]
    line[:] = np.float32(0.0)
    for b in range(len(across_profile)):
        weight, profile = np.float32(share[b]), across_profile[b]
        for v in range(tall):
            line[v] += weight * profile[v]
    wrapped[0] = line[tall - 1]
    wrapped[tall + 1 :] = line[: len(wrapped) - tall - 1]
    for k in range(len(profiles)):
        for r in range(profiles.shape[1]):
            profiles[k, r] = wrapped[k + r * oy]


@jit
def _add_column(profiles: Float32, light: float, row: float, low: int, out: Float32) -> None:
    """Add the light of one column to the pixels `out` [h] of this column, which begin at the row `low`.

    `profiles` [oy + 3, n] is the profile of n rows across the trace, from `_mix_rows`. Its middle is placed at the
    fractional row `row` of the detector.
    """
    oy, n = len(profiles) - 3, profiles.shape[1]
    begin = int(np.ceil(row - n // 2))
    v = oy * (begin - row + n // 2)
    # Rounding can make v equal to oy.
    first = min(int(np.floor(v)), oy - 1)
    t = v - first
    s = 1.0 - t
    w0, w3 = np.float32(light * (s * s * s / 6.0)), np.float32(light * (t * t * t / 6.0))
    w1 = np.float32(light * ((4.0 + t * t * (3.0 * t - 6.0)) / 6.0))
    w2 = np.float32(light * ((4.0 + s * s * (3.0 * s - 6.0)) / 6.0))
    a0, a1, a2, a3 = profiles[first], profiles[first + 1], profiles[first + 2], profiles[first + 3]
    for r in range(max(0, low - begin), min(n, low + len(out) - begin)):
        out[begin + r - low] += w0 * a0[r] + w1 * a1[r] + w2 * a2[r] + w3 * a3[r]


@jit
def _sum_columns(
    along_profile: Float32, trace: Float, first: int, share: Float, ox: int, begin: int, columns: Float
) -> None:
    """Convolve the light along a trace with the profile of a source along it, and add the result to `columns` [3, w].

    `trace` [3, m] are the light, the light times its row and the light times its wavelength index, in m samples along
    the trace from the sample `first` on. There are `ox` samples per pixel. `columns` are the same sums for columns of
    the detector from the column `begin` on. The profile [b, ox, n] at b wavelengths is interpolated with the weights
    `share` [w, b].
    """
    nodes, _, n = along_profile.shape
    width, samples = columns.shape[1], trace.shape[1]
    mixed = np.empty((ox, n))
    for group in range(0, samples, _SAMPLES):
        light, number = 0.0, 0.0
        for m in range(group, min(group + _SAMPLES, samples)):
            light += trace[0, m]
            number += trace[2, m]
        if light == 0.0:
            continue
        index = int(min(max(number / light, 0.0), len(share) - 1.0))
        mixed[:] = 0.0
        for b in range(nodes):
            for phase in range(ox):
                for i in range(n):
                    mixed[phase, i] += share[index, b] * along_profile[b, phase, i]
        for m in range(group, min(group + _SAMPLES, samples)):
            phase = (-(first + m)) % ox
            first_column = (first + m + phase) // ox - n // 2 - begin
            w0, w1, w2 = trace[0, m], trace[1, m], trace[2, m]
            start, stop = max(0, -first_column), min(n, width - first_column)
            if start >= stop:
                continue
            profile = mixed[phase, start:stop]
            c0, c1, c2 = (
                columns[0, first_column + start :],
                columns[1, first_column + start :],
                columns[2, first_column + start :],
            )
            for i in range(len(profile)):
                c0[i] += w0 * profile[i]
                c1[i] += w1 * profile[i]
                c2[i] += w2 * profile[i]
