"""Damped random walks (Ornstein-Uhlenbeck processes) at any dates, such as the magnitudes of active nuclei.

A walk has zero mean, unit variance and the correlation exp(-|dt| / tau) between two dates. Its values are exact at the
nodes of one fixed binary tree of dates: first the two ends of the interval of time, then the middle of each interval
by the exact conditional distribution between its ends. A node has one random deviate, from the key of the source and
the number of the node. A value is therefore the same whatever other dates and sources are computed. The same
deviates with another tau give a walk with exactly that tau, which is correlated with the first; so two passbands of
one source are related. Between the nodes, `RESOLUTION` days apart, values are interpolated linearly.

References
----------
Kelly, Bechtold & Siemiginowska 2009, ApJ 698, 895; MacLeod et al. 2010, ApJ 721, 1014 (arXiv:1004.0276)
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Float
from lake_schema.errors import BadInput, OutOfRange
from truesky.numerics.compiling import exact_jit
from truesky.randomness.compiled_draws import child_key, normal

# First date of a walk, MJD, and the length of time in which walks are defined, days: 1948 to 2128.
FIRST_MJD, LENGTH = 32768.0, 65536.0
LAST_MJD = FIRST_MJD + LENGTH
# Number of times that the interval of time is halved, and the distance of the nodes, days (84 s).
_LEVELS = 26
RESOLUTION = LENGTH / 2**_LEVELS
# Least time scale of a walk, days. Between the nodes, the error of linear interpolation is below 1e-3 of the standard
# deviation for this and longer time scales; the walk's own scatter there is neglected (4 % for this one, 0.3 % for 100
# days).
_LEAST_TAU = 0.5


def values(keys: npt.NDArray[np.uint64], tau: npt.ArrayLike, mjd: npt.ArrayLike) -> Float:
    """Return the values of damped random walks of zero mean and unit variance.

    Parameters
    ----------
    keys : uint64 array, shape (n,)
        Random key of each walk (truesky.randomness.per_source.keys).
    tau : float or float array, shape (n,)
        Time scale of each walk in the observer's frame, days, at least 0.5.
    mjd : float or float array, shape (m,) or (n, m)
        Date, dates of all walks, or dates of each walk, from 32768 to 98304.

    Returns
    -------
    float array, shape (n,) or (n, m)
        Values; the shape (n,) if `mjd` is one number.

    Raises
    ------
    BadInput
        If a time scale is shorter than 0.5 days or not finite.
    OutOfRange
        If a date is outside the range.
    """
    dates = np.asarray(mjd, float)
    if (outside := ~((dates >= FIRST_MJD) & (dates <= LAST_MJD))).any():
        raise OutOfRange("mjd", float(dates[outside][0]), FIRST_MJD, LAST_MJD, "days")
    scales = np.ascontiguousarray(np.broadcast_to(np.asarray(tau, float), keys.shape))
    if not (np.isfinite(scales) & (scales >= _LEAST_TAU)).all():
        raise BadInput(f"tau must be finite and at least {_LEAST_TAU:g} days")
    out = np.empty((keys.size, dates.shape[-1] if dates.ndim else 1))
    # Successive dates share most of their path through the tree, so unsorted dates would take three times as long.
    order = np.argsort(dates, kind="stable") if dates.ndim == 1 else np.arange(out.shape[1])
    sorted_dates = dates[..., order] if dates.ndim else dates
    _fill(keys, scales, np.ascontiguousarray(np.broadcast_to(sorted_dates, out.shape)), out)
    if dates.ndim == 1:
        out[:, order] = out.copy()
    return out if dates.ndim else out[:, 0]


@exact_jit
def _fill(keys: Any, tau: Any, mjd: Any, out: Any) -> None:
    """Fill `out`, shape (n, m), with the values at the dates `mjd`, shape (n, m), of n walks."""
    mean, scatter = np.empty(_LEVELS), np.empty(_LEVELS)
    earlier, later = np.empty(_LEVELS + 1), np.empty(_LEVELS + 1)
    for i in range(keys.size):
        # For the half length h of an interval, in units of tau, the value in the middle has the mean (earlier + later)
        # / (2 cosh h) and the variance tanh h. Begin with the shortest interval, and double h by the addition theorems,
        # which lose no digits.
        half = RESOLUTION / tau[i]
        correlation = np.exp(-half)
        variance = -np.expm1(-2.0 * half) / (1.0 + correlation * correlation)
        for level in range(_LEVELS - 1, -1, -1):
            mean[level] = correlation / (1.0 + correlation * correlation)
            scatter[level] = np.sqrt(variance)
            correlation, variance = correlation * correlation, 2.0 * variance / (1.0 + variance * variance)
        across = np.exp(-LENGTH / tau[i])
        earlier[0] = normal(child_key(keys[i], 0))
        later[0] = across * earlier[0] + np.sqrt(1.0 - across * across) * normal(child_key(keys[i], 1))
        previous, shared = -1, 0
        for j in range(mjd.shape[1]):
            place = (mjd[i, j] - FIRST_MJD) / RESOLUTION
            index = min(int(place), 2**_LEVELS - 1)
            # The intervals that contain this date and the previous one have the same ends, so start below them.
            while previous >= 0 and shared > 0 and index >> (_LEVELS - shared) != previous >> (_LEVELS - shared):
                shared -= 1
            for level in range(shared, _LEVELS):
                node = (1 << level) + (index >> (_LEVELS - level))
                middle = mean[level] * (earlier[level] + later[level])
                middle += scatter[level] * normal(child_key(keys[i], node + 1))
                in_second_half = (index >> (_LEVELS - level - 1)) & 1
                earlier[level + 1] = middle if in_second_half else earlier[level]
                later[level + 1] = later[level] if in_second_half else middle
            previous, shared = index, _LEVELS
            part = place - index
            out[i, j] = (1.0 - part) * earlier[_LEVELS] + part * later[_LEVELS]
