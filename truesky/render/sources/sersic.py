"""Fourier transforms of Sersic profiles, in a cached table by index and k^2.

The transforms are for flux 1 and half-light radius 1. The nodes in k^2 are the numbers whose single-precision form ends
with 16 zero bits: 128 per octave. The segment of a sample therefore follows from its bits.
"""

from __future__ import annotations

import numpy as np
import scipy.fft
from scipy.interpolate import CubicSpline
from scipy.special import gammainccinv, gammaln

from lake_schema.arrays import Float, Float32, Int
from truesky.numerics import cache
from truesky.numerics.code_fingerprints import code_key

# Range of the index that galsim.Sersic, the reference, accepts.
INDEX_LO, INDEX_HI = 0.3, 6.2
# Number of rows, uniform in ln n: 4-point interpolation has an error of 1e-7
# (tests/truesky/render/sources/test_sersic.py).
ROWS = 96
# k^2 ranges from 2^-30, where 1 - S is below 1e-7 for every n, to 2^26.
OCTAVE_LO, OCTAVE_HI = -30, 26
# Top bits of float32(2^OCTAVE_LO). Kernels contain this constant, and naming truesky.numerics.compiling here makes
# this file part of the key of the machine code.
FIRST_BITS = (127 + OCTAVE_LO) << 7
_SEGMENTS = 128 * (OCTAVE_HI - OCTAVE_LO)
# Grid of the Hankel transform: number of points, and ratio of the largest radius to 1 and of 1 to the smallest.
_POINTS, _REACH = 1 << 15, 1e12
_LOG_LO, _LOG_STEP = float(np.log(INDEX_LO)), float(np.log(INDEX_HI / INDEX_LO) / (ROWS - 1))


def table() -> Float32:
    """Transforms S(k) at the nodes, float32[ROWS, segments + 1]; the first column is 1, the flux.

    Notes
    -----
    The error is 1e-7 at the nodes and 6e-6 between them (tests/truesky/render/sources/test_sersic.py).

    References
    ----------
    Hamilton 2000 (logarithmic Hankel transform).
    """
    key = cache.content_key(code_key(__name__))
    return cache.cached_arrays("sersic", key, lambda: {"transform": _make_table()})["transform"]


def interpolation_weights(index: Float) -> tuple[Int, Float]:
    """First of four rows [n], and their weights [n, 4], for cubic interpolation in ln n at given indices."""
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
    """Values of k^2 for the columns of `table`."""
    bits = (np.arange(_SEGMENTS + 1, dtype=np.int32) + FIRST_BITS) << 16
    return bits.astype(np.int32).view(np.float32).astype(float)


def _make_table() -> Float32:
    log_k = 0.5 * np.log(nodes())
    rows = np.stack([transform(np.exp(_LOG_LO + i * _LOG_STEP), log_k) for i in range(ROWS)])
    rows[:, 0] = 1.0
    return rows.astype(np.float32)


def transform(index: float, log_k: Float) -> Float:
    """Transform S(k) for flux 1 and half-light radius 1 at ln k."""
    step = 2 * np.log(_REACH) / _POINTS
    offset = scipy.fft.fhtoffset(step, 0.0)
    log_r = (np.arange(_POINTS) - (_POINTS - 1) / 2) * step
    # The incomplete gamma function of order 2n is the fraction of light inside a radius.
    b = float(gammainccinv(2 * index, 0.5))
    log_flux = np.log(2 * np.pi * index) - 2 * index * np.log(b) + gammaln(2 * index)
    light = np.exp(log_r - b * np.exp(log_r / index) - log_flux)
    k = offset + log_r
    return np.asarray(CubicSpline(k, 2 * np.pi * np.exp(-k) * scipy.fft.fht(light, step, 0.0, offset))(log_k))
