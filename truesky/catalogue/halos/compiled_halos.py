"""The loops of halos.draw and satellites.draw: every number is keyed by the block, the halo and the member it is of."""

from __future__ import annotations

from typing import Any

import numpy as np

from truesky.numerics.compiling import exact_jit
from truesky.randomness.compiled_draws import child_key, normal, poisson, uniform

# What a halo's and a satellite's numbers are for: the number of the key that follows theirs.
VOXEL, DISTANCE, MASS, PLACE, SCATTER = range(5)
STEP, RADIUS, HEIGHT, AZIMUTH, KICK, SUB_SCATTER = range(6)


@exact_jit
def cut_normal(key: Any, number: Any, cut: Any) -> Any:
    """A standard normal number of at most `cut` standard deviations: the first that is."""
    while True:
        deviate = normal(child_key(key, number))
        if abs(deviate) <= cut:
            return deviate
        number += 64


@exact_jit
def draw_counts(key: Any, first: Any, steps: Any, used: Any, ln_number: Any, amplitude: Any, field: Any, g: Any) -> Any:
    """int64[s, bins] halos of each block.

    key : of the cell;  first : int64[s + 1] first voxel of each step;  steps : int64[s] numbers of the steps
    used : bool[s, bins], whether a block is drawn;  ln_number : [s, bins] ln of the mean in a voxel without structure
    amplitude, field : [s, bins];  g : float32[v, fields]
    """
    halo_counts = np.zeros(used.shape, np.int64)
    bins = used.shape[1]
    for s in range(steps.size):
        for b in range(bins):
            if used[s, b]:
                mean = 0.0
                for v in range(first[s], first[s + 1]):
                    mean += np.exp(ln_number[s, b] + amplitude[s, b] * np.float64(g[v, field[s, b]]))
                halo_counts[s, b] = poisson(child_key(child_key(key, steps[s] * bins + b), 0), mean)
    return halo_counts


@exact_jit
def fill_halos(
    key: Any,
    first: Any,
    steps: Any,
    number: Any,
    ln_number: Any,
    amplitude: Any,
    field: Any,
    g: Any,
    limits: Any,
    out: Any,
) -> int:
    """Fills out with the halos of each block, number[s, bins] of them but for those that are not wanted; how many.

    key, first, steps, ln_number, amplitude, field, g : as of `counts`
    wanted : upper edges [bins] of mass; host, central [s], log10 of mass and proxy: either is enough; the scatter
             of proxies, dex, and where it is cut, standard deviations
    out : voxel, step (row), bin, number in the block; place (uint64 random bits)
          float64[n, 3] uniform in volume, uniform in mass, scatter
    """
    voxel, row, column, rank, place, drawn = out
    upper_edge, host_limit, central_limit, scatter, cut = limits
    bins, at = number.shape[1], 0
    for s in range(steps.size):
        for b in range(bins):
            block = child_key(key, steps[s] * bins + b)
            total = 0.0
            if number[s, b]:
                for v in range(first[s], first[s + 1]):
                    total += np.exp(ln_number[s, b] + amplitude[s, b] * np.float64(g[v, field[s, b]]))
            for j in range(number[s, b]):
                halo_key = child_key(block, j + 1)
                deviate = cut_normal(halo_key, SCATTER, cut)
                if upper_edge[b] < host_limit[s] and upper_edge[b] + scatter * deviate < central_limit[s]:
                    continue
                remaining = uniform(child_key(halo_key, VOXEL)) * total
                v = first[s]
                while v < first[s + 1] - 1:
                    remaining -= np.exp(ln_number[s, b] + amplitude[s, b] * np.float64(g[v, field[s, b]]))
                    if remaining < 0.0:
                        break
                    v += 1
                voxel[at], row[at], column[at], rank[at] = v, s, b, j
                place[at] = child_key(halo_key, PLACE)
                drawn[at, 0] = uniform(child_key(halo_key, DISTANCE))
                drawn[at, 1] = uniform(child_key(halo_key, MASS))
                drawn[at, 2] = deviate
                at += 1
    return at


@exact_jit
def count_before(block: Any, cell: Any, out: Any) -> None:
    """Fills out, int64[n], with how many halos of the same block and cell come before each.

    block, cell : int64[n], blocks one after another
    """
    begin = 0
    for i in range(block.size):
        if block[i] != block[begin]:
            begin = i
        count = 0
        for j in range(begin, i):
            count += cell[j] == cell[i]
        out[i] = count


@exact_jit
def fill_satellites(
    keys: Any, log_mass: Any, limit: Any, min_ratio: Any, ratio: Any, scatter: Any, depth: Any, out: Any
) -> int:
    """Number of satellites that reach the limit of their host; where out is long enough they are filled in.

    Sub-masses m fall: M / m is a Poisson process of rate 1 / ratio that begins at `least`.
    keys : uint64[h];  log_mass, limit, ratio : float64[h] of hosts, of the scattered sub-mass, and the host's
    least, scatter, depth : as in halos.toml
    out  : host, member int64[n];  proxy float64[n];  float64[n, 4] uniform in enclosed mass, height, angle; normal
    """
    host, member, proxy, drawn = out
    at = 0
    for h in range(keys.size):
        max_ratio = 10.0 ** (log_mass[h] - limit[h] + depth)
        mass_ratio, number = min_ratio, 0
        while True:
            member_key = child_key(keys[h], number)
            mass_ratio -= ratio[h] * np.log(uniform(child_key(member_key, STEP)))
            if mass_ratio > max_ratio:
                break
            number += 1
            sub_mass = (
                log_mass[h] - np.log10(mass_ratio) + scatter * cut_normal(member_key, SUB_SCATTER, depth / scatter)
            )
            if sub_mass >= limit[h]:
                if at < host.size:
                    host[at], member[at], proxy[at] = h, number, sub_mass
                    drawn[at, 0] = uniform(child_key(member_key, RADIUS))
                    drawn[at, 1] = uniform(child_key(member_key, HEIGHT))
                    drawn[at, 2] = uniform(child_key(member_key, AZIMUTH))
                    drawn[at, 3] = normal(child_key(member_key, KICK))
                at += 1
    return at
