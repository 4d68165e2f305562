"""The loops of halos.draw and satellites.draw: every number is keyed by the block, the halo and the member it is of."""

from __future__ import annotations

from typing import Any

import numpy as np

from truesky.numerics.compiling import exact_jit
from truesky.randomness.compiled_draws import following, normal, poisson, uniform

# What a halo's and a satellite's numbers are for: the number of the key that follows theirs.
VOXEL, DISTANCE, MASS, PLACE, SCATTER = range(5)
STEP, RADIUS, UP, AROUND, KICK, SUB_SCATTER = range(6)


@exact_jit
def cut_normal(key: Any, number: Any, cut: Any) -> Any:
    """A standard normal number of at most `cut` standard deviations: the first that is."""
    while True:
        found = normal(following(key, number))
        if abs(found) <= cut:
            return found
        number += 64


@exact_jit
def counts(key: Any, first: Any, steps: Any, used: Any, ln_number: Any, amplitude: Any, field: Any, g: Any) -> Any:
    """int64[s, bins] halos of each block.

    key : of the cell;  first : int64[s + 1] first voxel of each step;  steps : int64[s] numbers of the steps
    used : bool[s, bins], whether a block is drawn;  ln_number : [s, bins] ln of the mean in a voxel without structure
    amplitude, field : [s, bins];  g : float32[v, fields]
    """
    found = np.zeros(used.shape, np.int64)
    bins = used.shape[1]
    for s in range(steps.size):
        for b in range(bins):
            if used[s, b]:
                mean = 0.0
                for v in range(first[s], first[s + 1]):
                    mean += np.exp(ln_number[s, b] + amplitude[s, b] * np.float64(g[v, field[s, b]]))
                found[s, b] = poisson(following(following(key, steps[s] * bins + b), 0), mean)
    return found


@exact_jit
def halos(
    key: Any,
    first: Any,
    steps: Any,
    number: Any,
    ln_number: Any,
    amplitude: Any,
    field: Any,
    g: Any,
    wanted: Any,
    out: Any,
) -> int:
    """Fills out with the halos of each block, number[s, bins] of them but for those that are not wanted; how many.

    key, first, steps, ln_number, amplitude, field, g : as of `counts`
    wanted : upper edges [bins] of mass; host, central [s], log10 of mass and proxy: either is enough; the scatter
             of proxies, dex, and where it is cut, standard deviations
    out : voxel, step (row), bin, number in the block; place (uint64 random bits)
          float64[n, 3] uniform in volume, uniform in mass, scatter
    """
    voxel, row, column, which, place, drawn = out
    most, host, central, scatter, cut = wanted
    bins, at = number.shape[1], 0
    for s in range(steps.size):
        for b in range(bins):
            block = following(key, steps[s] * bins + b)
            total = 0.0
            if number[s, b]:
                for v in range(first[s], first[s + 1]):
                    total += np.exp(ln_number[s, b] + amplitude[s, b] * np.float64(g[v, field[s, b]]))
            for j in range(number[s, b]):
                own = following(block, j + 1)
                off = cut_normal(own, SCATTER, cut)
                if most[b] < host[s] and most[b] + scatter * off < central[s]:
                    continue
                left = uniform(following(own, VOXEL)) * total
                v = first[s]
                while v < first[s + 1] - 1:
                    left -= np.exp(ln_number[s, b] + amplitude[s, b] * np.float64(g[v, field[s, b]]))
                    if left < 0.0:
                        break
                    v += 1
                voxel[at], row[at], column[at], which[at] = v, s, b, j
                place[at] = following(own, PLACE)
                drawn[at, 0] = uniform(following(own, DISTANCE))
                drawn[at, 1] = uniform(following(own, MASS))
                drawn[at, 2] = off
                at += 1
    return at


@exact_jit
def numbered(block: Any, cell: Any, out: Any) -> None:
    """Fills out, int64[n], with how many halos of the same block and cell come before each.

    block, cell : int64[n], blocks one after another
    """
    begin = 0
    for i in range(block.size):
        if block[i] != block[begin]:
            begin = i
        before = 0
        for j in range(begin, i):
            before += cell[j] == cell[i]
        out[i] = before


@exact_jit
def satellites(keys: Any, log_mass: Any, limit: Any, least: Any, ratio: Any, scatter: Any, depth: Any, out: Any) -> int:
    """Number of satellites that reach the limit of their host; where out is long enough they are filled in.

    Sub-masses m fall: M / m is a Poisson process of rate 1 / ratio that begins at `least`.
    keys : uint64[h];  log_mass, limit, ratio : float64[h] of hosts, of the scattered sub-mass, and the host's
    least, scatter, depth : as in halos.toml
    out  : host, member int64[n];  proxy float64[n];  float64[n, 4] uniform in enclosed mass, height, angle; normal
    """
    host, member, proxy, drawn = out
    at = 0
    for h in range(keys.size):
        most = 10.0 ** (log_mass[h] - limit[h] + depth)
        over, number = least, 0
        while True:
            own = following(keys[h], number)
            over -= ratio[h] * np.log(uniform(following(own, STEP)))
            if over > most:
                break
            number += 1
            found = log_mass[h] - np.log10(over) + scatter * cut_normal(own, SUB_SCATTER, depth / scatter)
            if found >= limit[h]:
                if at < host.size:
                    host[at], member[at], proxy[at] = h, number, found
                    drawn[at, 0] = uniform(following(own, RADIUS))
                    drawn[at, 1] = uniform(following(own, UP))
                    drawn[at, 2] = uniform(following(own, AROUND))
                    drawn[at, 3] = normal(following(own, KICK))
                at += 1
    return at
