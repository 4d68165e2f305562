"""Compiled loop over pairs of lenses and sources; each pair has separate random numbers."""

from __future__ import annotations

from typing import Any

import numpy as np

from truesky.numerics.compiling import exact_jit
from truesky.randomness.compiled_draws import child_key, normal, uniform

# Purposes of the random numbers of a pair.
CHANCE, RADIUS, SHAPE, OFFSET, ANGLE = range(5)


@exact_jit
def find_pairs(lenses: Any, sources: Any, min_z_difference: Any, out: Any) -> int:
    """Find the pairs of lenses and sources that are drawn.

    Parameters
    ----------
    lenses : tuple of array, shape (l,)
        key (uint64), start, window, chance and z (float64): start and length of a window of places, and the probability
        of each source to be lensed.
    sources : tuple of array, shape (s,)
        key (uint64), place and z (float64), sorted by place, which is in [0, 1).
    min_z_difference : float
        Smallest redshift difference between source and lens.
    out : tuple of array
        Filled if it is long enough: lens and source (int64[n]), key of the pair (uint64[n]) and random numbers
        (float64[n, 4]; the second is a normal deviate, the others are uniform).

    Returns
    -------
    int
        Number of pairs, which may be larger than `out`.

    Notes
    -----
    A lens is paired only with the sources whose place on a circle is in its window. Their probability is divided by the
    length of the window, so that the mean number of pairs does not depend on it.
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
