"""Fourier transforms of round Sersic profiles, tabulated by Sersic index and squared wavenumber k^2.

The transforms are for flux 1 and half-light radius 1. The tabulated values of k^2 are all numbers whose
single-precision form ends with 16 zero bits, 128 per factor of 2. The table column of any k^2 therefore follows from
its upper bits.
"""

from __future__ import annotations

import numpy as np
import scipy

from lake_schema.arrays import Float, Float32, Int
from truesky.numerics import cache, cache_labels
from truesky.numerics.code_fingerprints import code_key

# Smallest and largest Sersic index, the range that galsim.Sersic accepts.
INDEX_LO, INDEX_HI = 0.3, 6.2
# Number of Sersic indices for which the Fourier transform is tabulated, uniform in the logarithm. Interpolation between
# four of them has an error of 1e-7 (tests/truesky/render/sources/test_sersic.py).
ROWS = 96
# Base-2 logarithms of the smallest and largest squared wavenumber k^2 for which the Fourier transform is tabulated. At
# smaller k^2 it differs from 1 by less than 1e-7.
OCTAVE_LO, OCTAVE_HI = -30, 26
# Upper 16 bits of 2^OCTAVE_LO as a float32. Compiled functions contain this number. Naming truesky.numerics.compiling
# in this comment makes the cache of machine code depend on this file.
FIRST_BITS = (127 + OCTAVE_LO) << 7
# Number of intervals of the squared wavenumber k^2 in the table, 128 per factor of 2.
_SEGMENTS = 128 * (OCTAVE_HI - OCTAVE_LO)
# Number of radii, uniform in the logarithm, at which a Sersic profile is sampled for its Hankel transform.
_POINTS = 1 << 15
# Largest radius at which a Sersic profile is sampled for its Hankel transform, in half-light radii. The smallest one is
# 1 / _REACH.
_REACH = 1e12
# Natural logarithm of the Sersic index in the first row of the table.
_LOG_LO = float(np.log(INDEX_LO))
# Step of the natural logarithm of the Sersic index from row to row.
_LOG_STEP = float(np.log(INDEX_HI / INDEX_LO) / (ROWS - 1))


def table() -> Float32:
    """Return the Fourier transforms S(k) of Sersic profiles with flux 1 and half-light radius 1, from the disc cache.

    The array has one row per Sersic index (`ROWS`, uniform in its logarithm) and one column per value of k^2 in
    `nodes`. The first column is exactly 1 (the flux), although its k^2 is 2^-30, not 0.

    Notes
    -----
    The error is 1e-7 at the tabulated k^2 and 6e-6 after interpolation between them
    (tests/truesky/render/sources/test_sersic.py).

    References
    ----------
    Hamilton 2000 (logarithmic Hankel transform).
    """
    key = cache.content_key(code_key(__name__))
    label = cache_labels.label_profiles()
    return cache.cached_arrays("sersic", key, lambda: {"transform": _make_table()}, label)["transform"]


def interpolation_weights(index: Float) -> tuple[Int, Float]:
    """Return how to interpolate the table of Fourier transforms (`table`) at Sersic indices, shape (n,).

    The result is the first of four successive rows, shape (n,), and the weights of the four rows, shape (n, 4). Indices
    outside the table are moved to its ends.
    """
    position = (np.log(np.clip(index, INDEX_LO, INDEX_HI)) - _LOG_LO) / _LOG_STEP
    first = np.clip(np.floor(position).astype(np.int64) - 1, 0, ROWS - 4)
    t = position - first - 1.0
    weights = [
        -t * (t - 1) * (t - 2) / 6,
        (t + 1) * (t - 1) * (t - 2) / 2,
        -(t + 1) * t * (t - 2) / 2,
        (t + 1) * t * (t - 1) / 6,
    ]
    return first, np.stack(weights, axis=-1)


def nodes() -> Float:
    """Return the values of k^2 for the columns of `table`, with k in radian per half-light radius."""
    bits = (np.arange(_SEGMENTS + 1, dtype=np.int32) + FIRST_BITS) << 16
    return bits.astype(np.int32).view(np.float32).astype(float)


def _make_table() -> Float32:
    log_k = 0.5 * np.log(nodes())
    rows = np.stack([transform(np.exp(_LOG_LO + i * _LOG_STEP), log_k) for i in range(ROWS)])
    rows[:, 0] = 1.0
    return rows.astype(np.float32)


def transform(index: float, log_k: Float) -> Float:
    """Compute the Fourier transform S(k) of a Sersic profile with flux 1 and half-light radius 1.

    `index` is the Sersic index, `log_k` an array with the natural logarithms of wavenumbers k in radian per half-light
    radius.
    """
    step = 2 * np.log(_REACH) / _POINTS
    offset = scipy.fft.fhtoffset(step, 0.0)
    log_r = (np.arange(_POINTS) - (_POINTS - 1) / 2) * step
    # Constant b_n of the Sersic profile: the incomplete gamma function of order 2n is the light inside a radius, which
    # must be half at radius 1.
    b = float(scipy.special.gammainccinv(2 * index, 0.5))
    log_flux = np.log(2 * np.pi * index) - 2 * index * np.log(b) + scipy.special.gammaln(2 * index)
    light = np.exp(log_r - b * np.exp(log_r / index) - log_flux)
    k = offset + log_r
    return np.asarray(
        scipy.interpolate.CubicSpline(k, 2 * np.pi * np.exp(-k) * scipy.fft.fht(light, step, 0.0, offset))(log_k)
    )
