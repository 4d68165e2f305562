"""Compiled inner loops for slitless spectra: images of sources in Fourier space, and electrons along a trace."""

from __future__ import annotations

from typing import Any

import numpy as np

from lake_schema.arrays import Bool, Float, Float32, Int
from truesky.numerics.compiling import jit
from truesky.render.drawing.kernels import fourier
from truesky.render.drawing.kernels.frame import min_singular_squared

# Number of bins of a spectrum that `add_to_trace` processes together, in vector operations.
_WAVES = 64


@jit
def zones(
    planes: Any, weights: Float32, ku: Float32, kv: Float32, body: Bool, fraction: Float, bulge: Float, disk: Float,
    thick: Float, sersic: Float32, row: Int, row_weights: Float, out: Any,
) -> None:  # fmt: skip
    """Fill `out` with the Fourier transforms of the images of m sources, each blurred by the PSF at b wavelengths.

    The PSF of a source is a weighted sum of p basis images (planes).

    Parameters
    ----------
    planes : complex array, shape (p, rows, columns)
        Fourier transforms of the basis images.
    weights : float32 array, shape (m, b, p)
        Weights of the basis images for each source and wavelength.
    ku, kv : float32 array, shape (rows,) and (columns,)
        Frequencies of the rows and columns of a transform, radian / pixel. The wave vector is k = (ku, kv).
    body : bool array, shape (m,)
        False for point sources, whose other profile arguments are ignored.
    fraction : float array, shape (m,)
        Fraction of a galaxy's light in the bulge; the rest is in the disc.
    bulge, disk : float array, shape (m, 2, 2)
        Matrices of bulge and disc, pixels. Their columns are vectors along the major and minor axis, with the lengths
        of the radii. The transform of the bulge (disc) depends only on the length of k @ matrix.
    thick : float array, shape (m, 2)
        Vectors, pixels, for the thickness of inclined discs: the transform of a disc has the factor q / sinh(q) with
        q = k @ vector.
    sersic : float32 array, shape (indices, nodes)
        Fourier transforms of Sersic profiles, one row per Sersic index, from `sersic.table`.
    row : int array, shape (m,)
        First of the four rows of `sersic` from which the transform of each bulge is interpolated.
    row_weights : float array, shape (m, 4)
        Interpolation weights of these four rows.
    out : complex array, shape (m, b, rows, columns)
        Result: transform of the light profile (1 for point sources) times the weighted sum of `planes`.
    """
    rows, columns = len(ku), len(kv)
    square, high = np.empty(columns, np.float32), np.empty(columns, np.float32)
    bits, table = square.view(np.int32), np.empty(sersic.shape[1], np.float32)
    profile = np.empty(columns, np.float32)
    step, reach = kv[1], 1.01 * (np.max(np.abs(ku)) ** 2 + kv[columns - 1] ** 2 + kv[1] ** 2) * 4.0
    for m in range(len(weights)):
        profile[:] = np.float32(1.0)
        if body[m] and fraction[m] > 0.0:
            fourier.interpolate_sersic(
                sersic,
                row[m],
                row_weights[m],
                0.99 * step**2 * min_singular_squared(bulge[m]),
                reach * np.sum(bulge[m] ** 2),
                table,
            )
        for r in range(rows):
            if body[m]:
                high[:] = ku[r]
                fourier.profile_at(fraction[m], bulge[m], disk[m], thick[m], table, high, kv, square, bits, profile)
            for b in range(weights.shape[1]):
                line = out[m, b, r]
                line[:] = np.complex64(0.0)
                for p in range(len(planes)):
                    w = weights[m, b, p]
                    if w != 0.0:
                        plane = planes[p, r]
                        for c in range(columns):
                            line[c] += w * plane[c]
                for c in range(columns):
                    line[c] *= profile[c]


@jit
def measure_peak_and_total(
    spectra: Float32, factor: Float, response: Float, window: int, peak: Float, total: Float
) -> None:
    """Measure the electrons of k spectra: in total, and in the brightest window of wavelengths.

    Parameters
    ----------
    spectra : float32 array, shape (k, w)
        Spectra of k sources at w wavelengths, before the multiplication by `factor`.
    factor : float array, shape (k,)
        Factor by which each spectrum is multiplied.
    response : float array, shape (w,)
        Electrons per unit of the multiplied spectrum, by wavelength. The absolute values of negative electrons are
        counted.
    window : int
        Number of successive wavelengths in the window, such as the wavelengths in one pixel. It is rounded down to an
        even number, but is at least 2. The window moves in steps of half of its width.
    peak, total : float array, shape (k,)
        Results, changed in place: electrons in the brightest window, and at all wavelengths.
    """
    half = max(window // 2, 1)
    for k in range(len(spectra)):
        highest, sum_all, previous, start = 0.0, 0.0, 0.0, 0
        while start < len(response):
            segment, segment_response = spectra[k, start : start + half], response[start : start + half]
            segment_sum = 0.0
            for i in range(len(segment)):
                segment_sum += abs(segment[i] * segment_response[i])
            highest = max(highest, previous + segment_sum)
            sum_all += segment_sum
            previous, start = segment_sum, start + half
        peak[k], total[k] = factor[k] * highest, factor[k] * sum_all


@jit
def add_to_trace(
    electrons: Float, along: Float, times: tuple[float, float], start: float, samples: int, share: Float, first: int,
    out: Float,
) -> None:  # fmt: skip
    """Distribute the electrons of a spectrum among evenly spaced samples along its trace on the detector.

    Parameters
    ----------
    electrons : float array, shape (w,)
        Electrons in w bins of wavelength, which are evenly spaced.
    along : float array, shape (i,)
        Coefficients of t^i (i from 0) of the displacement from the undispersed image in columns, pixels. The parameter
        t is linear in wavelength.
    times : (float, float)
        Value of t at the first bin, and step of t from one bin to the next.
    start : float
        Column of the undispersed image, pixels from 0.
    samples : int
        Samples per pixel (column).
    share : float array, shape (b, w)
        Weights that interpolate the PSF in each bin from the PSFs at b wavelengths. The electrons are divided
        among the b rows of `out` in these proportions.
    first : int
        Position of the first sample in `out`: its column on the detector times `samples`.
    out : float array, shape (b, m)
        Electrons to be drawn with each of the b PSFs at each of m samples, changed in place. Light outside the samples
        is lost.

    Notes
    -----
    The light of each bin is distributed among the six nearest samples by a quintic B-spline. This conserves the
    number of electrons and their mean position.
    """
    count, places, low = out.shape[1], np.empty(_WAVES), np.empty(_WAVES, np.int64)
    weights = np.empty((6, _WAVES))
    w0, w1, w2, w3, w4, w5 = weights
    for begin in range(0, len(electrons), _WAVES):
        batch = electrons[begin : begin + _WAVES]
        if np.max(np.abs(batch)) == 0.0:
            continue
        # Compute the displacements of all bins of the batch in a separate loop, which the compiler can
        # vectorise.
        places[:] = along[len(along) - 1]
        for j in range(len(along) - 2, -1, -1):
            for i in range(_WAVES):
                places[i] = places[i] * (times[0] + times[1] * (begin + i)) + along[j]
        for i in range(len(batch)):
            place = samples * (start + places[i])
            floor_place = np.floor(place)
            low[i] = np.int64(floor_place) - 2 - first
            t = place - floor_place
            s, e = 1.0 - t, batch[i] / 120.0
            t2, s2 = t * t, s * s
            w0[i], w5[i] = e * s2 * s2 * s, e * t2 * t2 * t
            w1[i] = e * (26.0 + t * (-50.0 + t * (20.0 + t * (20.0 + t * (-20.0 + 5.0 * t)))))
            w4[i] = e * (26.0 + s * (-50.0 + s * (20.0 + s * (20.0 + s * (-20.0 + 5.0 * s)))))
            w2[i] = e * (66.0 + t2 * (-60.0 + t2 * (30.0 - 10.0 * t)))
            w3[i] = e * (66.0 + s2 * (-60.0 + s2 * (30.0 - 10.0 * s)))
        group_start, stop = 0, 0
        while group_start < len(batch):
            # Successive bins that lie between the same two samples are distributed among the same six samples.
            # Their light is summed before it is added to `out`.
            at, stop = low[group_start], group_start + 1
            while stop < len(batch) and low[stop] == at:
                stop += 1
            if 0 <= at <= count - 6:
                for b in range(out.shape[0]):
                    _add_weighted(
                        weights[:, group_start:stop], share[b, begin + group_start : begin + stop], out[b, at : at + 6]
                    )
            group_start = stop


@jit
def _add_weighted(weights: Float, share: Float, out: Float) -> None:
    """Add the electrons of k bins that are drawn with one PSF to six successive samples of a trace, `out` [6].

    `weights` [6, k] are the electrons of each bin in each sample, and `share` [k] the weight of the PSF in each bin.
    """
    w0, w1, w2, w3, w4, w5 = weights
    s0 = s1 = s2 = s3 = s4 = s5 = 0.0
    for i in range(len(share)):
        weight = share[i]
        s0 += weight * w0[i]
        s1 += weight * w1[i]
        s2 += weight * w2[i]
        s3 += weight * w3[i]
        s4 += weight * w4[i]
        s5 += weight * w5[i]
    out[0] += s0
    out[1] += s1
    out[2] += s2
    out[3] += s3
    out[4] += s4
    out[5] += s5
