"""Compiled loops that draw a slitless spectrum: the image of a source is added along its trace on the detector.

A trace is divided into samples of a fraction of a pixel. First the electrons of the spectrum are distributed among the
samples by wavelength. Along a curved trace, the image of the source is then added at each sample, with the PSF and the
row of this sample. Along a nearly straight trace, a faster method is used: the image is convolved with the electrons of
many samples at a time, in coordinates in which the trace is a row. Then each column of the result is moved to the row
at which the trace crosses it.
"""

from __future__ import annotations

import numpy as np

from lake_schema.arrays import Float, Float32, Int
from truesky.numerics.compiling import jit
from truesky.render.dispersing.kernels import add_to_trace
from truesky.render.dispersing.wavelength_bins import BINS_BEFORE

# Number of positions along a trace (nodes) at which its column, row and wavelength are computed. They are interpolated
# linearly between the nodes.
_NODES = 129
# Number of pixels along a straight trace whose electrons are multiplied with the image in one loop, which is faster
# than a loop for each pixel.
STEP = 4
# Number of float32 values of a source's image that fit into the cache of the processor. Larger images are convolved
# with the trace in strips.
_CLOSE = 24_000


@jit
def _path(along: Float, across: Float, times: tuple[float, float], count: int, start: tuple[float, float]) -> Float:
    """Return a table [3, _NODES] of columns (ascending), rows and fractional wavelength indices along a trace.

    `start` is the column and row of the undispersed image in pixels. `along` and `across` are the coefficients of t^i
    (i from 0) of the displacement from it, in columns and in rows. The parameter t is linear in wavelength: `times` are
    the t of the first of `count` wavelengths, and the step of t from one wavelength to the next.
    """
    out = np.empty((3, _NODES))
    for i in range(_NODES):
        number = (count - 1.0) * i / (_NODES - 1.0)
        t = times[0] + times[1] * number
        x, y = along[len(along) - 1], across[len(across) - 1]
        for j in range(len(along) - 2, -1, -1):
            x = x * t + along[j]
        for j in range(len(across) - 2, -1, -1):
            y = y * t + across[j]
        out[0, i], out[1, i], out[2, i] = start[0] + x, start[1] + y, number
    if out[0, _NODES - 1] < out[0, 0]:
        return np.ascontiguousarray(out[:, ::-1])
    return out


@jit
def _interpolate_path(path: Float, x: float, ends: tuple[float, float]) -> tuple[float, float, float]:
    """Return the row, the fractional wavelength index and the slope (rows per column) of a trace at the column x.

    `path` [3, nodes] are the columns, rows and wavelength indices along the trace. Before the first and after the last
    column of `path`, the trace continues straight with the two slopes `ends`, and the wavelength index stays constant.
    """
    columns = path[0]
    last = len(columns) - 1
    if x <= columns[0]:
        return path[1, 0] + ends[0] * (x - columns[0]), path[2, 0], ends[0]
    if x >= columns[last]:
        return path[1, last] + ends[1] * (x - columns[last]), path[2, last], ends[1]
    low, high = 0, last
    while high - low > 1:
        middle = (low + high) // 2
        if columns[middle] <= x:
            low = middle
        else:
            high = middle
    width = columns[high] - columns[low]
    part = (x - columns[low]) / width
    rise = path[1, high] - path[1, low]
    return path[1, low] + part * rise, path[2, low] + part * (path[2, high] - path[2, low]), rise / width


@jit
def _slope(path: Float, i: int) -> float:
    """Return the slope of a trace between the nodes i and i + 1, in rows per column.

    `path` [3, nodes] are the columns, rows and wavelength indices of the trace at its nodes.
    """
    return float((path[1, i + 1] - path[1, i]) / max(path[0, i + 1] - path[0, i], 1e-12))


@jit
def add_samples(
    images: Float32,
    trace_electrons: Float,
    first: int,
    path: Float,
    slope: float,
    shear: float,
    shape: tuple[int, int, int],
    corner: tuple[int, int],
    out: Float32,
) -> None:
    """Add the image of a source at every sample of its trace, with the PSF and the row of this sample.

    Parameters
    ----------
    images : float32 array, shape (b, n along, n across)
        Spline coefficients of the source's image (for one electron), blurred by the PSF at b wavelengths. The source is
        in the middle of the image.
    trace_electrons : float array, shape (b, m)
        Electrons that are drawn with each of the b images, at each of the m samples of the trace.
    first : int
        Position of the first sample of the trace: its column times the samples per pixel.
    path : float array, shape (3, nodes)
        Columns, rows and wavelength indices along the trace, from `_path`.
    slope : float
        Slope with which the trace continues before the first and after the last column of `path`, rows per column.
    shear : float
        Slope of the image's rows relative to the detector's rows, in rows per column.
    shape : (int, int, int)
        Side n of the stamp in pixels, and samples of the image per pixel, along and across the trace.
    corner : (int, int)
        Column and row of the detector at which `out` begins.
    out : float32 array, shape (h, w)
        Part of the detector, electrons, changed in place. Light outside is ignored.
    """
    n, ox, oy = shape
    line = np.empty(n * oy, np.float32)
    wrapped, fine = np.empty(n * oy + oy + 4, np.float32), np.empty(n * oy, np.float32)
    for m in range(trace_electrons.shape[1]):
        electrons = 0.0
        for b in range(len(trace_electrons)):
            electrons += abs(trace_electrons[b, m])
        place = first + m - (n // 2) * ox
        phase = (-place) % ox
        first_column = (place + phase) // ox - corner[0]
        if electrons == 0.0 or first_column >= out.shape[1] or first_column + n <= 0:
            continue
        row, _, _ = _interpolate_path(path, (first + m) / ox, (slope, slope))
        for i in range(max(0, -first_column), min(n, out.shape[1] - first_column)):
            line[:] = np.float32(0.0)
            for b in range(len(trace_electrons)):
                weight, image_line = np.float32(trace_electrons[b, m]), images[b, i * ox + phase]
                for v in range(len(line)):
                    line[v] += weight * image_line[v]
            aside = shear * (corner[0] + first_column + i - (first + m) / ox)
            add_line(line, row + aside, n, oy, corner[1], wrapped, fine, out[:, first_column + i])


@jit
def add_line(
    line: Float32, row: float, n: int, oy: int, low: int, wrapped: Float32, fine: Float32, out: Float32
) -> None:
    """Add one column of a source's image to a column of the detector.

    Parameters
    ----------
    line : float32 array, shape (n oy,)
        Spline coefficients of the column of the image. Its middle is placed at the row `row` of the detector.
    row : float
        Fractional row of the detector.
    n, oy : int
        Rows of the image, and coefficients per row.
    low : int
        Row of the detector at which `out` begins.
    wrapped, fine : float32 array, shape (n oy + oy + 4,) and (n oy,)
        Scratch memory.
    out : float32 array, shape (h,)
        Pixels of the detector's column, changed in place.
    """
    tall, begin = len(line), int(np.ceil(row - n // 2))
    v = oy * (begin - row + n // 2)
    floor_v = int(np.floor(v))
    t = v - floor_v
    s = 1.0 - t
    w0, w3 = np.float32(s * s * s / 6.0), np.float32(t * t * t / 6.0)
    w1 = np.float32((4.0 + t * t * (3.0 * t - 6.0)) / 6.0)
    w2 = np.float32((4.0 + s * s * (3.0 * s - 6.0)) / 6.0)
    # The image is periodic. Its column is continued at each end by samples from the other end, which the spline needs.
    wrapped[0] = line[tall - 1]
    wrapped[1 : tall + 1] = line
    wrapped[tall + 1 :] = line[: len(wrapped) - tall - 1]
    a0, a1, a2, a3 = wrapped[floor_v:], wrapped[floor_v + 1 :], wrapped[floor_v + 2 :], wrapped[floor_v + 3 :]
    # Only every `oy`-th sample, one per row of the detector, is needed. But computing all samples is faster, because
    # the compiler vectorises this loop.
    for i in range(len(fine) - oy + 1):
        fine[i] = w0 * a0[i] + w1 * a1[i] + w2 * a2[i] + w3 * a3[i]
    for r in range(max(0, low - begin), min(n, low + len(out) - begin)):
        out[begin + r - low] += fine[r * oy]


@jit
def convolve_trace(
    images: Float32,
    trace_electrons: Float,
    first: int,
    path: Float,
    slope: float,
    share: Float,
    shape: tuple[int, int, int],
    tile: int,
    low: int,
    out: Float32,
) -> None:
    """Convolve the image of a source with a straight trace, in coordinates in which the trace is a row.

    Parameters
    ----------
    images : float32 array, shape (b, n along, n across)
        Spline coefficients of the source's image (for one electron), blurred by the PSF at b wavelengths, in sheared
        coordinates. The source is in the middle of the image.
    trace_electrons : float array, shape (m,)
        Electrons at each of the m samples of the trace.
    first : int
        Position of the first sample of the trace: its column times the samples per pixel.
    path : float array, shape (3, nodes)
        Columns, rows and wavelength indices along the trace, from `_path`.
    slope : float
        Slope of the rows of the sheared coordinates relative to the detector's rows, in rows per column.
    share : float array, shape (wavelengths, b)
        Weights that interpolate the PSF at each wavelength of the spectrum from the PSFs at b wavelengths.
    shape : (int, int, int)
        Side n of the stamp in pixels, and samples of the image per pixel, along and across the trace.
    tile : int
        Number of pixels along the trace that are drawn with the same PSF, a multiple of STEP.
    low : int
        Column of the detector to which the first element of `out` belongs.
    out : float32 array, shape (w, n across)
        Result: the light across the trace in each of w columns, as spline coefficients, to which this call adds.
    """
    n, ox, oy = shape
    tall = n * oy
    steep = np.empty((n * ox, tall), np.float32)
    _steepness_image(images[len(images) // 2], ox, oy, steep)
    count = (n * ox * tall + _CLOSE - 1) // _CLOSE
    for k in range(count):
        # The image is processed in strips parallel to the trace. A strip has the full length of the image, and so many
        # samples across the trace that it fits into the cache of the processor.
        begin, end = k * tall // count, (k + 1) * tall // count
        parts = _by_phase(images, steep, ox, begin, end)
        lines = np.zeros((len(out), end - begin), np.float32)
        _convolve_strip(parts, trace_electrons, first, path, slope, share, shape, tile, low, lines)
        out[:, begin:end] += lines


@jit
def _by_phase(images: Float32, steep: Float32, ox: int, begin: int, end: int) -> Float32:
    """Copy a strip of b images of a source, and of their derivative `steep`, sorted by the place of samples in a pixel.

    The strip contains the samples `begin` to `end` - 1 across the trace. There are `ox` samples per pixel along the
    trace, and the phase of a sample, 0 to `ox` - 1, is its number within its pixel. The result has the shape [b + 1,
    ox, n * (end - begin)], where n is the side of an image in pixels: for each image and phase, the strip with one
    sample per pixel. The last of the b + 1 images is `steep`, the change of the image for a steeper trace.
    """
    n, wide = images.shape[1] // ox, end - begin
    out = np.empty((len(images) + 1, ox, n * wide), np.float32)
    for b in range(len(out)):
        image = steep if b == len(images) else images[b]
        for j in range(n * ox):
            out[b, j % ox, j // ox * wide : (j // ox + 1) * wide] = image[j, begin:end]
    return out


@jit
def _convolve_strip(
    parts: Float32,
    trace_electrons: Float,
    first: int,
    path: Float,
    slope: float,
    share: Float,
    shape: tuple[int, int, int],
    tile: int,
    low: int,
    out: Float32,
) -> None:
    """Convolve one strip of a source's images with the electrons along a straight trace, and add the result to `out`.

    A strip is a range of samples across the trace, over the full length of the images along the trace.

    Parameters
    ----------
    parts : float32 array, shape (b + 1, ox, n wide)
        Strip of the images at b wavelengths of the PSF, and of their change for a steeper trace, from `_by_phase`. ox
        is the number of samples per pixel along the trace, and `wide` the number of samples in the strip across it.
    trace_electrons : float array, shape (m,)
        Electrons at each of the m samples of the trace.
    first : int
        Position of the first sample of the trace: its column times ox.
    path : float array, shape (3, nodes)
        Columns, rows and wavelength indices along the trace, from `_path`.
    slope : float
        Slope of the images' rows relative to the detector's rows, in rows per column.
    share : float array, shape (wavelengths, b)
        Weights that interpolate the PSF at each wavelength of the spectrum from the PSFs at b wavelengths.
    shape : (int, int, int)
        Side n of the images in pixels, and their samples per pixel along (ox) and across the trace.
    tile : int
        Number of pixels along the trace that are drawn with the same PSF, a multiple of STEP.
    low : int
        Column of the detector to which the first element of `out` belongs.
    out : float32 array, shape (columns, wide)
        Result, changed in place: spline coefficients of the light across the trace, for each column of the detector.
    """
    n, ox, _ = shape
    tall, pad = out.shape[1], STEP - 1
    mixed, amounts = np.zeros((ox, (n + 2 * pad) * tall), np.float32), np.empty(len(parts), np.float32)
    flat, weights, n_samples = out.reshape(-1), np.empty(tile, np.float32), len(trace_electrons)
    ends = _slope(path, 0), _slope(path, _NODES - 2)
    for q in range(first // ox, (first + n_samples - 1) // ox + 2, tile):
        first_column = q - n // 2 - low
        if first_column < 0 or (first_column + n + tile + pad) * tall > len(flat):
            continue
        total, mean = 0.0, 0.0
        for m in range(max(ox * (q - 1) + 1 - first, 0), min(ox * (q + tile - 1) + 1 - first, n_samples)):
            total += abs(trace_electrons[m])
            mean += m * abs(trace_electrons[m])
        if total == 0.0:
            continue
        _, number, rise = _interpolate_path(path, (first + mean / total) / ox, ends)
        # Here the slope of the trace exceeds the slope of the image's rows by d = rise - slope. The image I(u, v), with
        # u along and v across the trace, must be sheared to I(u, v + d u), approximately I + d u dI / dv. The last
        # image in `parts` is u dI / dv, so its weight is d.
        amounts[:-1], amounts[-1] = share[int(number)], rise - slope
        for phase in range(ox):
            _mix(parts, phase, amounts, mixed[phase, pad * tall : (pad + n) * tall])
        for phase in range(ox):
            for k in range(tile):
                m = ox * (q + k) - phase - first
                weights[k] = np.float32(trace_electrons[m]) if 0 <= m < n_samples else np.float32(0.0)
            for k in range(0, tile, STEP):
                w0, w1, w2, w3 = weights[k], weights[k + 1], weights[k + 2], weights[k + 3]
                if abs(w0) + abs(w1) + abs(w2) + abs(w3) == 0.0:
                    continue
                length = (n + pad) * tall
                target, source = flat[(first_column + k) * tall : (first_column + k) * tall + length], mixed[phase]
                a0, a1 = source[3 * tall : 3 * tall + length], source[2 * tall : 2 * tall + length]
                a2, a3 = source[tall : tall + length], source[:length]
                for e in range(np.uint64(length)):
                    target[e] += w0 * a0[e] + w1 * a1[e] + w2 * a2[e] + w3 * a3[e]


@jit
def _steepness_image(image: Float32, ox: int, oy: int, out: Float32) -> None:
    """Fill `out` with u dI / dv for an image I(u, v): to first order, how the image changes for a steeper trace.

    u and v are distances from the middle of the image in pixels, along and across the trace. `image` and `out` are
    indexed [u, v], with `ox` and `oy` samples per pixel. The first and last two samples along v are set to 0.
    """
    tall = image.shape[1]
    out[:] = np.float32(0.0)
    for j in range(len(image)):
        column, factor = image[j], np.float32((j - len(image) // 2) / ox * oy / 12.0)
        inner, up, down = out[j, 2 : tall - 2], column[3 : tall - 1], column[1 : tall - 3]
        for v in range(len(inner)):
            inner[v] = up[v] - down[v]
        higher, lower = column[4:tall], column[: tall - 4]
        for v in range(len(inner)):
            inner[v] = factor * (np.float32(8.0) * inner[v] - (higher[v] - lower[v]))


@jit
def _mix(parts: Float32, phase: int, amounts: Float32, out: Float32) -> None:
    """Fill `out` [e] with a weighted sum of images: the sum over k of `parts[k, phase, e]` times `amounts[k]`.

    `phase` selects the samples at one place within each pixel, and e numbers these samples. Three images are added at a
    time, because this is faster.
    """
    last = len(parts) - 1
    for k in range(0, len(parts), 3):
        a0, a1, a2 = parts[k, phase], parts[min(k + 1, last), phase], parts[min(k + 2, last), phase]
        w0 = amounts[k]
        w1 = amounts[k + 1] if k + 1 <= last else np.float32(0.0)
        w2 = amounts[k + 2] if k + 2 <= last else np.float32(0.0)
        if k == 0:
            for e in range(len(out)):
                out[e] = w0 * a0[e] + w1 * a1[e] + w2 * a2[e]
        else:
            for e in range(len(out)):
                out[e] += w0 * a0[e] + w1 * a1[e] + w2 * a2[e]


@jit
def add_lines(
    lines: Float32, low: int, path: Float, shape: tuple[int, int, int], corner: tuple[int, int], out: Float32
) -> None:
    """Add the result of `convolve_trace` to a part of the detector, each column at the row where the trace crosses it.

    Parameters
    ----------
    lines : float32 array, shape (columns, n across)
        Light across the trace in each column as spline coefficients, from `convolve_trace`. It must include all columns
        of `out`.
    low : int
        Column of the detector to which the first element of `lines` belongs.
    path : float array, shape (3, nodes)
        Columns, rows and wavelength indices along the trace, from `_path`.
    shape : (int, int, int)
        Side n of the stamp in pixels, and samples of the image per pixel, along and across the trace.
    corner : (int, int)
        Column and row of the detector at which `out` begins.
    out : float32 array, shape (h, w)
        Part of the detector, electrons, changed in place.
    """
    n, _, oy = shape
    wrapped, fine = np.empty(n * oy + oy + 4, np.float32), np.empty(n * oy, np.float32)
    ends = _slope(path, 0), _slope(path, _NODES - 2)
    for c in range(out.shape[1]):
        row, _, _ = _interpolate_path(path, float(corner[0] + c), ends)
        add_line(lines[corner[0] + c - low], row, n, oy, corner[1], wrapped, fine, out[:, c])


@jit
def add_piece(piece: Float32, corner: tuple[int, int], unit: float, frame: Int) -> float:
    """Add a small image in electrons to the image of a detector (frame), whose pixels are integers.

    Parameters
    ----------
    piece : float32 array, shape (h, w)
        The small image, electrons.
    corner : (int, int)
        Column and row of the frame at which the first pixel of `piece` lies. Pixels outside the frame are ignored.
    unit : float
        Integers of the frame per electron. Each pixel is rounded to an integer.
    frame : int array, shape (ny, nx)
        Frame, changed in place.

    Returns
    -------
    float
        Electrons that were added to the frame, after rounding.
    """
    ny, nx = frame.shape
    first, stop = max(0, -corner[0]), min(piece.shape[1], nx - corner[0])
    total = np.int64(0)
    for r in range(max(0, -corner[1]), min(piece.shape[0], ny - corner[1])):
        if first < stop:
            piece_row, out = piece[r, first:stop], frame[corner[1] + r, corner[0] + first : corner[0] + stop]
            for c in range(len(piece_row)):
                units = np.int64(np.rint(np.float64(piece_row[c]) * unit))
                out[c] += units
                total += units
    return total / unit


@jit
def add_refined(coarse: Int, step: int, frame: Int) -> int:
    """Add an image that is given as a cubic spline on coarse pixels to the image of a detector (frame).

    A coarse pixel is a square of `step` x `step` pixels of the frame. It is a node of the spline.

    Parameters
    ----------
    coarse : int array, shape (h, w)
        Coefficients of the spline: light per coarse pixel, in the integer unit of the frame. The nodes must extend to
        one node before the first and to two nodes after the last pixel of the frame, along each axis.
    step : int
        Width of a coarse pixel in pixels of the frame.
    frame : int array, shape (ny, nx)
        Frame in integers, changed in place. Its first pixel is at the node in row 1 and column 1, counted from 0.

    Returns
    -------
    int
        Light that was added to the frame, in its integer unit.
    """
    ny, nx = frame.shape
    weights, wide, total = np.empty((step, 4)), np.empty(coarse.shape[1]), np.int64(0)
    for k in range(step):
        t = k / step
        s = 1.0 - t
        weights[k, 0], weights[k, 3] = s * s * s / 6.0, t * t * t / 6.0
        weights[k, 1], weights[k, 2] = (4.0 + t * t * (3.0 * t - 6.0)) / 6.0, (4.0 + s * s * (3.0 * s - 6.0)) / 6.0
    for y in range(ny):
        row_weights, coarse_rows = weights[y % step] / step**2, coarse[y // step : y // step + 4]
        for c in range(len(wide)):
            wide[c] = (
                row_weights[0] * coarse_rows[0, c]
                + row_weights[1] * coarse_rows[1, c]
                + row_weights[2] * coarse_rows[2, c]
                + row_weights[3] * coarse_rows[3, c]
            )
        if np.max(np.abs(wide)) == 0.0:
            continue
        for k in range(step):
            w0, w1, w2, w3 = weights[k]
            for q in range((nx - k + step - 1) // step):
                light = w0 * wide[q] + w1 * wide[q + 1] + w2 * wide[q + 2] + w3 * wide[q + 3]
                units = np.int64(np.rint(light))
                frame[y, q * step + k] += units
                total += units
    return int(total)


@jit
def spread(
    images: Float32, electrons: Float, bin_share: Float, share: Float, along: Float, across: Float,
    times: tuple[float, float], width: int, start: tuple[float, float], slope: float, shear: float,
    shape: tuple[int, int, int], tile: int, unit: float, frame: Int,
) -> float:  # fmt: skip
    """Draw one spectral order of a source on the image of a detector (frame).

    Parameters
    ----------
    images : float32 array, shape (b, n along, n across)
        Spline coefficients of the source's image (for one electron), blurred by the PSF at b wavelengths, from
        `images.coefficients`. If `tile` is positive, they must be in sheared coordinates, in which the trace is nearly
        a row.
    electrons : float array, shape (bins,)
        Electrons of the source's spectrum in bins of wavelength, from `wavelength_bins.bin_electrons`.
    bin_share : float array, shape (b, bins)
        Weights that interpolate the PSF in each bin from the PSFs at b wavelengths.
    share : float array, shape (w, b)
        Weights that interpolate the PSF at each of the spectrum's w wavelengths from the PSFs at b wavelengths.
    along, across : float array, shape (i,)
        Coefficients of t^i (i from 0) of the displacement from the undispersed image in columns (`along`) and in rows
        (`across`), pixels. The parameter t is linear in wavelength.
    times : (float, float)
        Value of t at the first wavelength, and step of t from one wavelength to the next.
    width : int
        Number of wavelengths in a bin.
    start : (float, float)
        Column and row of the undispersed image, 0-based pixels.
    slope : float
        Slope with which a curved trace continues beyond its first and last wavelength, rows per column. It is not used
        if `tile` is positive.
    shear : float
        Slope of the images' rows relative to the detector's rows, in rows per column; 0 for images that are not
        sheared.
    shape : (int, int, int)
        Side n of the stamp in pixels, and samples of the images per pixel, along and across the trace.
    tile : int
        Number of pixels along a straight trace that are drawn with the same PSF, a multiple of STEP. 0 for a curved
        trace, in which the PSF is computed for each sample.
    unit : float
        Integers of the frame per electron.
    frame : int array, shape (ny, nx)
        Frame in integers, changed in place.

    Returns
    -------
    float
        Electrons that were added to the frame; 0 if the spectrum does not touch it.
    """
    n, ox, oy = shape
    ny, nx = frame.shape
    path = _path(along, across, times, len(share), start)
    x_first, x_last = path[0, 0], path[0, _NODES - 1]
    bottom, top = np.min(path[1]), np.max(path[1])
    # Bins before the first and after the last wavelength extend the trace by at most a pixel at each end.
    first = int(np.floor(ox * x_first)) - 3 - ox
    trace_electrons = np.zeros((1 if tile > 0 else share.shape[1], int(np.ceil(ox * x_last)) + 4 + ox - first))
    # For a straight trace, `convolve_trace` applies the interpolation weights of the PSFs later. So the electrons are
    # distributed along the trace as if there were only one PSF.
    trace_share = np.ones((1, len(electrons))) if tile > 0 else bin_share
    bin_times = times[0] - BINS_BEFORE * width * times[1], width * times[1]
    add_to_trace(electrons, along, bin_times, start[0], ox, trace_share, first, trace_electrons)
    steepest = max(np.abs(_slope(path, 0)), np.abs(_slope(path, _NODES - 2)))
    wing = (steepest if tile > 0 else abs(shear)) * (n // 2 + 2.0)
    begin = max(int(np.floor(x_first)) - n // 2 - 2, 0), max(int(np.floor(bottom - wing)) - n // 2 - 1, 0)
    columns = min(int(np.ceil(x_last)) + n // 2 + 3, nx) - begin[0]
    height = min(int(np.ceil(top + wing)) + n // 2 + 2, ny) - begin[1]
    if columns <= 0 or height <= 0:
        return 0.0
    piece = np.zeros((height, columns), np.float32)
    if tile == 0:
        add_samples(images, trace_electrons, first, path, slope, shear, shape, begin, piece)
    else:
        low = begin[0] - n - 2 * tile
        lines = np.zeros((columns + 2 * n + 4 * tile + 2 * STEP, n * oy), np.float32)
        convolve_trace(images, trace_electrons[0], first, path, shear, share, shape, tile, low, lines)
        add_lines(lines, low, path, shape, begin, piece)
    return add_piece(piece, begin, unit, frame)
