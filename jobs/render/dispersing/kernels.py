"""The inner loops of dispersing, compiled.

zones      profile x PSF of a source on a stamp's Fourier grid
electrons_of  what is detected of a spectrum
lay        it onto the samples of its trace, by quintic splines
disperse   a source's image at every sample of its trace, by cubic splines across
add        a piece of the image onto the frame, in fixed point
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jobs.compiling import jit
from jobs.render.drawing.kernels import fourier
from jobs.render.drawing.kernels.frame import smaller
from lake_schema.arrays import Float, Float32, Int


@jit
def zones(
    planes: Any, weights: Float32, kx: Float32, ky: Float32, body: bool, fraction: float, bulge: Float, disk: Float,
    thick: Float, sersic: Float32, row: int, row_weights: Float, out: Any,
) -> None:  # fmt: skip
    """Fills out [b, rows, columns] with profile x sum of planes [p, rows, columns] by weights [b, p].

    kx, ky : [columns], [rows] radian / pixel
    body, fraction, bulge, disk, thick, sersic, row, row_weights : of fourier.nyquist_zones, of one source
    """
    rows, columns = len(ky), len(kx)
    profile, square = np.ones(columns, np.float32), np.empty(columns, np.float32)
    bits, high = square.view(np.int32), np.empty(columns, np.float32)
    table = np.empty(sersic.shape[1], np.float32)
    if body and fraction > 0.0:
        step = kx[1]
        most = 1.01 * (kx[columns - 1] ** 2 + np.max(ky) ** 2 + step**2) * 4.0 * np.sum(bulge**2)
        fourier.interpolate(sersic, row, row_weights, 0.99 * step**2 * smaller(bulge), most, table)
    for r in range(rows):
        if body:
            high[:] = ky[r]
            fourier.profile_at(fraction, bulge, disk, thick, table, kx, high, square, bits, profile)
        for b in range(len(weights)):
            line = out[b, r]
            line[:] = np.complex64(0.0)
            for p in range(len(planes)):
                w = weights[b, p]
                if w != 0.0:
                    plane = planes[p, r]
                    for c in range(columns):
                        line[c] += w * plane[c]
            for c in range(columns):
                line[c] *= profile[c]


@jit
def electrons_of(spectrum: Float32, response: Float, factor: float, wavelengths: int, out: Float) -> float:
    """Fills out [w] with factor x spectrum x response; returns the largest sum of `wavelengths` neighbours."""
    most, running = 0.0, 0.0
    for i in range(len(out)):
        out[i] = factor * np.float64(spectrum[i]) * response[i]
        running += out[i]
        if i >= wavelengths:
            running -= out[i - wavelengths]
        most = max(most, running)
    return most


@jit
def lay(
    electrons: Float, along: Float, times: tuple[float, float], start: float, samples: int, share: Float, first: int,
    out: Float,
) -> None:  # fmt: skip
    """Adds electrons [w] of each wavelength to the samples of a trace, out [b, m], by shares [w, b].

    along   : coefficients of t^i, pixels from `start`;  times : t of the first wavelength, and its step
    samples : a pixel;  first : place of out's first sample, in samples;  share : of each PSF, by wavelength
    A quintic spline keeps the total, the mean and the higher moments.
    """
    count, last = out.shape[1], len(along) - 1
    for i in range(len(electrons)):
        if electrons[i] == 0.0:
            continue
        place, power = along[last], times[0] + times[1] * i
        for j in range(last - 1, -1, -1):
            place = place * power + along[j]
        place = samples * (start + place)
        whole = int(np.floor(place))
        t = place - whole
        s = 1.0 - t
        t2, s2 = t * t, s * s
        w0, w5 = s2 * s2 * s, t2 * t2 * t
        w1 = 26.0 + t * (-50.0 + t * (20.0 + t * (20.0 + t * (-20.0 + 5.0 * t))))
        w4 = 26.0 + s * (-50.0 + s * (20.0 + s * (20.0 + s * (-20.0 + 5.0 * s))))
        w2 = 66.0 + t2 * (-60.0 + t2 * (30.0 - 10.0 * t))
        w3 = 66.0 + s2 * (-60.0 + s2 * (30.0 - 10.0 * s))
        low, scaled = whole - 2 - first, electrons[i] / 120.0
        if low < 0 or low + 6 > count:
            continue
        for b in range(out.shape[0]):
            e = scaled * share[i, b]
            line = out[b]
            line[low] += e * w0
            line[low + 1] += e * w1
            line[low + 2] += e * w2
            line[low + 3] += e * w3
            line[low + 4] += e * w4
            line[low + 5] += e * w5


@jit
def disperse(
    images: Float32, spectrum: Float, first: int, across: Float, shape: tuple[int, int, int], block: int,
    corner: tuple[int, int], out: Float32,
) -> None:  # fmt: skip
    """Adds a source's image at every sample of its trace to out [h, w].

    images   : [b, phases along, samples across, N] spline coefficients of the source seen through PSF b, of a stamp of
               N pixels; the stamp's middle is sample N / 2 of each axis
    spectrum : [b, m] electrons;  first : place of its first sample, in samples along
    across   : [m] row of each sample, pixels
    shape    : N, samples a pixel along, across;  block : samples that share one PSF
    corner   : column and row of out's first pixel
    """
    n, ox, oy = shape
    tall = n * oy
    mixed = np.zeros((ox, tall, n), np.float32)
    columns = out.shape[1]
    for start in range(0, spectrum.shape[1], block):
        stop = min(start + block, spectrum.shape[1])
        total = 0.0
        for b in range(spectrum.shape[0]):
            for m in range(start, stop):
                total += spectrum[b, m]
        if total == 0.0:
            continue
        mixed[:] = np.float32(0.0)
        for b in range(spectrum.shape[0]):
            own = 0.0
            for m in range(start, stop):
                own += spectrum[b, m]
            weight = np.float32(own / total)
            flat, image = mixed.reshape(-1), images[b].reshape(-1)
            for i in range(len(flat)):
                flat[i] += weight * image[i]
        for m in range(start, stop):
            electrons = 0.0
            for b in range(spectrum.shape[0]):
                electrons += spectrum[b, m]
            if electrons == 0.0:
                continue
            place = first + m - (n // 2) * ox
            phase = (-place) % ox
            left = (place + phase) // ox - corner[0]
            if left >= columns or left + n <= 0:
                continue
            row = int(np.ceil(across[m] - n // 2))
            v = oy * (row - across[m] + n // 2)
            whole = int(np.floor(v))
            t = v - whole
            s = 1.0 - t
            e = electrons / 6.0
            w0, w3 = np.float32(e * s * s * s), np.float32(e * t * t * t)
            w1 = np.float32(e * (4.0 + t * t * (3.0 * t - 6.0)))
            w2 = np.float32(e * (4.0 + s * s * (3.0 * s - 6.0)))
            _add_rows(mixed[phase], whole, oy, (w0, w1, w2, w3), out, left, row - corner[1])


@jit
def _add_rows(image: Any, whole: int, step: int, weights: Any, out: Any, left: int, low: int) -> None:
    """Rows whole + i step of an image, between its samples, onto rows low + i of out."""
    tall, n = image.shape
    height, width = out.shape
    w0, w1, w2, w3 = weights
    begin, end = max(0, -left), min(n, width - left)
    # Flat, and counted without a sign: so the compiler uses whole vectors of as few as 16 pixels.
    flat, line = image.reshape(-1), out.reshape(-1)
    for i in range(max(0, -low), min(n, height - low)):
        j = whole + i * step
        a0, a1 = np.uint64((j - 1) % tall * n + begin), np.uint64(j % tall * n + begin)
        a2, a3 = np.uint64((j + 1) % tall * n + begin), np.uint64((j + 2) % tall * n + begin)
        to = np.uint64((low + i) * width + left + begin)
        for c in range(np.uint64(end - begin)):
            line[to + c] += w0 * flat[a0 + c] + w1 * flat[a1 + c] + w2 * flat[a2 + c] + w3 * flat[a3 + c]


@jit
def add(piece: Float32, corner: tuple[int, int], unit: float, frame: Int) -> float:
    """Adds piece [h, w] with its first pixel at corner (column, row) to the frame, `unit` to an electron.

    returns : electrons that fell there
    """
    ny, nx = frame.shape
    left, right = max(0, -corner[0]), min(piece.shape[1], nx - corner[0])
    total = np.int64(0)
    for r in range(max(0, -corner[1]), min(piece.shape[0], ny - corner[1])):
        if left < right:
            some, out = piece[r, left:right], frame[corner[1] + r, corner[0] + left : corner[0] + right]
            for c in range(len(some)):
                units = np.int64(np.rint(np.float64(some[c]) * unit))
                out[c] += units
                total += units
    return total / unit
