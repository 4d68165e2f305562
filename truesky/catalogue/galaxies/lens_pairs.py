"""Which galaxies lie behind which lens: the loop over pairs, each of which has numbers of its own."""

from __future__ import annotations

from typing import Any

import numpy as np

from truesky.numerics.compiling import exact_jit
from truesky.randomness.compiled_draws import child_key, normal, uniform

# Of a pair: what its numbers are for.
CHANCE, RADIUS, SHAPE, OFFSET, ANGLE = range(5)


@exact_jit
def find_pairs(lenses: Any, sources: Any, min_z_difference: Any, out: Any) -> int:
    """Number of pairs that are drawn; where out is long enough they are filled in.

    Of a lens those sources are looked at whose place on a circle is in its window, `window` of them all: so many fewer
    have so much more of a chance.
    lenses  : key uint64[l], start, window, chance, z float64[l]: place of its window, and the chance of each source
    sources : key uint64[s], place, z float64[s], by place;  apart : least difference of redshifts
    out     : lens, source int64[n];  key uint64[n];  float64[n, 4], the second normal, the others uniform
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
