"""Compiled loop that draws pairs of a strong lens and a source behind it; each pair has separate random numbers."""

from __future__ import annotations

from typing import Any

import numpy as np

from truesky.numerics.compiling import exact_jit
from truesky.randomness.compiled_draws import child_key, normal, uniform

# Each pair draws one random number per purpose: whether the pair exists (CHANCE), a number with which the caller
# compares the Einstein radius (RADIUS), the axis ratio of the lens (SHAPE), and the distance and direction of the
# source from the lens (OFFSET, ANGLE).
CHANCE, RADIUS, SHAPE, OFFSET, ANGLE = range(5)


@exact_jit
def find_pairs(lenses: Any, sources: Any, min_z_difference: Any, out: Any) -> int:
    """Draw which sources are lensed by which lenses.

    Parameters
    ----------
    lenses : tuple of array, shape (l,)
        Five arrays: key of the random numbers (uint64), start and length of the window, probability that the lens
        lenses a given source behind it, and redshift (float64).
    sources : tuple of array, shape (s,)
        Three arrays: key of the random numbers (uint64), place on a circle and redshift (float64). Places are random
        numbers in [0, 1), in ascending order.
    min_z_difference : float
        Smallest redshift difference between source and lens.
    out : tuple of array
        Four arrays of length n to fill: rows of lens and source (int64), key for more random numbers of the pair
        (uint64), and random numbers (float64[n, 4]; the second column is a normal deviate, the others are uniform).
        Pairs after the n-th are not stored.

    Returns
    -------
    int
        Number of drawn pairs, which may be larger than n; then call the function again with longer arrays.

    Notes
    -----
    To save time, a lens is compared only with the sources in its window: with a place from `start` to
    `start` + `window` on a circle of length 1. The probability of these sources is divided by the length of the window,
    so the mean number of pairs does not depend on the window.
    """
    key, start, window, chance, z = lenses
    source_key, place, z_source = sources
    lens, source, pair, deviates = out
    at = 0
    for i in range(key.size):
        first = np.searchsorted(place, start[i])
        for step in range(place.size):
            j = (first + step) % place.size
            offset = place[j] - start[i]
            if (offset if offset >= 0.0 else offset + 1.0) >= window[i]:
                break
            pair_key = key[i] ^ source_key[j]
            if z_source[j] > z[i] + min_z_difference and uniform(child_key(pair_key, CHANCE)) * window[i] < chance[i]:
                if at < lens.size:
                    lens[at], source[at], pair[at] = i, j, child_key(pair_key, ANGLE + 1)
                    deviates[at, 0] = uniform(child_key(pair_key, RADIUS))
                    deviates[at, 1] = normal(child_key(pair_key, SHAPE))
                    deviates[at, 2] = uniform(child_key(pair_key, OFFSET))
                    deviates[at, 3] = uniform(child_key(pair_key, ANGLE))
                at += 1
    return at
