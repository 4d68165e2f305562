"""Compiled loops of halos.draw and satellites.draw; the random numbers depend on the block, the halo and the member."""

from __future__ import annotations

from typing import Any

import numpy as np

from truesky.numerics.compiling import exact_jit
from truesky.randomness.compiled_draws import child_key, normal, poisson, uniform

# Numbers of the child keys for each property of a halo and of a satellite.
VOXEL, DISTANCE, MASS, PLACE, SCATTER = range(5)
STEP, RADIUS, HEIGHT, AZIMUTH, KICK, SUB_SCATTER = range(6)


@exact_jit
def cut_normal(key: Any, number: Any, cut: Any) -> Any:
    """Draw a standard normal number that is at most `cut` standard deviations from 0, by rejection.

    Parameters
    ----------
    key : uint64
        Key of the random numbers.
    number : int
        Number of the first child key; each rejection adds 64.
    cut : float
        Limit, standard deviations.

    Returns
    -------
    float
        The number.
    """
    while True:
        deviate = normal(child_key(key, number))
        if abs(deviate) <= cut:
            return deviate
        number += 64


@exact_jit
def draw_counts(key: Any, first: Any, steps: Any, used: Any, ln_number: Any, amplitude: Any, field: Any, g: Any) -> Any:
    """Draw the number of halos of each block (step and mass bin) in a cell.

    Parameters
    ----------
    key : uint64
        Key of the cell.
    first : int array, shape (s + 1,)
        First voxel of each step.
    steps : int array, shape (s,)
        Numbers of the steps.
    used : bool array, shape (s, bins)
        True for blocks that are drawn.
    ln_number : float array, shape (s, bins)
        ln of the mean number per voxel without structure.
    amplitude : float array, shape (s, bins)
        Amplitude of the field.
    field : int array, shape (s, bins)
        Column of the field in `g`.
    g : float32 array, shape (v, fields)
        Gaussian fields in the voxels.

    Returns
    -------
    int array, shape (s, bins)
        Number of halos.
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
    """Draw the halos of each block and fill `out` with those above the limits.

    Parameters
    ----------
    key : uint64
        Key of the cell.
    first, steps : int array
        First voxel of each step and numbers of the steps, as in `draw_counts`.
    number : int array, shape (s, bins)
        Number of halos of each block.
    ln_number, amplitude, field, g : array
        Same as in `draw_counts`.
    limits : tuple
        Upper edges of the mass bins (bins,); lower limits of log10 mass and of log10 proxy mass (s,), of which one must
        be reached; scatter of the proxy mass in dex, and its cut in standard deviations.
    out : tuple of array
        voxel, row of the step, bin, number in the block (int64[n]); random bits of the place (uint64[n]); random
        numbers (float64[n, 3]: uniform in volume, uniform in mass, scatter).

    Returns
    -------
    int
        Number of halos in `out`.
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
    """Fill `out` with the number of earlier halos of the same block and cell.

    Parameters
    ----------
    block : int array, shape (n,)
        Block of each halo; equal values are consecutive.
    cell : int array, shape (n,)
        Cell of each halo.
    out : int array, shape (n,)
        Result.
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
    """Draw the satellites of hosts and fill `out` if it is long enough.

    Parameters
    ----------
    keys : uint64 array, shape (h,)
        Keys of the hosts.
    log_mass : float array, shape (h,)
        log10 of the mass of the hosts.
    limit : float array, shape (h,)
        Lower limit of log10 of the scattered sub-mass.
    min_ratio : float
        Smallest ratio of host mass and sub-mass (min_mass_ratio in halos.toml).
    ratio : float array, shape (h,)
        Mean step of the mass ratio from one satellite to the next.
    scatter, depth : float
        Scatter and its limit, dex (halos.toml).
    out : tuple of array
        host and member (int64[n]), proxy (float64[n]) and random numbers (float64[n, 4]: uniform in enclosed mass,
        height and angle; a normal deviate).

    Returns
    -------
    int
        Number of satellites that reach the limit of their host.

    Notes
    -----
    Satellites are drawn in the order of decreasing sub-mass m. The mass ratio M / m is a Poisson process of rate
    1 / `ratio` that begins at `min_ratio`.
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
