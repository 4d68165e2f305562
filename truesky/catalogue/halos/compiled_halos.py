"""Compiled loops of `halos.draw` and `satellites.draw`, which draw halos and satellite galaxies.

The random numbers of a halo depend only on its block (sky cell, step in distance and mass bin) and its number in the
block. The random numbers of a satellite depend only on its halo and its number in the halo.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from truesky.numerics.compiling import exact_jit
from truesky.randomness.compiled_draws import child_key, normal, poisson, uniform

# Numbers with which the keys of a halo's random numbers are derived, one per property: voxel (piece of volume),
# distance, mass, position in the voxel, and scatter between mass and luminosity.
VOXEL, DISTANCE, MASS, PLACE, SCATTER = range(5)
# Numbers with which the keys of a satellite's random numbers are derived, one per property: step of the mass ratio,
# radius, height and azimuth in the halo, velocity, and scatter between mass and luminosity.
STEP, RADIUS, HEIGHT, AZIMUTH, KICK, SUB_SCATTER = range(6)


@exact_jit
def cut_normal(key: Any, number: Any, cut: Any) -> Any:
    """Draw a standard normal deviate that is at most `cut` standard deviations from 0, by rejection.

    Parameters
    ----------
    key : uint64
        Key from which the random numbers are made.
    number : int
        Number with which the key of the first deviate is derived from `key`; it increases by 64 per rejected deviate.
    cut : float
        Limit, standard deviations.

    Returns
    -------
    float
        The deviate, from -cut to cut.
    """
    while True:
        deviate = normal(child_key(key, number))
        if abs(deviate) <= cut:
            return deviate
        number += 64


@exact_jit
def draw_counts(key: Any, first: Any, steps: Any, used: Any, tables: Any) -> Any:
    """Draw the number of halos in each block (step in distance and mass bin) of a sky cell.

    Parameters
    ----------
    key : uint64
        Key from which the random numbers of the cell are made.
    first : int array, shape (s + 1,)
        First voxel of each step; a voxel is a small piece of the volume of the cell. The last value is the number of
        voxels.
    steps : int array, shape (s,)
        Numbers of the steps, counted from the observer.
    used : bool array, shape (s, bins)
        True for blocks that are drawn.
    tables : tuple of array
        Five arrays: ln of the number of halos per voxel where the Gaussian field is 0, shape (s, bins); factor of the
        field in the exponential, shape (s, bins); column of the last two arrays with the field that the halos of a
        block follow, shape (s, bins); Gaussian fields of matter in the voxels, float32, shape (v, fields); and weights
        of the voxels by structure that the fields do not have, shape (v, fields).

    Returns
    -------
    int array, shape (s, bins)
        Number of halos; 0 for blocks that are not used.

    Notes
    -----
    The numbers are Poisson with the mean of exp(ln_number + amplitude g) weight, summed over the voxels of the step.
    """
    ln_number, amplitude, field, g, weight = tables
    halo_counts = np.zeros(used.shape, np.int64)
    bins = used.shape[1]
    for s in range(steps.size):
        for b in range(bins):
            if used[s, b]:
                mean = 0.0
                for v in range(first[s], first[s + 1]):
                    f = field[s, b]
                    mean += np.exp(ln_number[s, b] + amplitude[s, b] * np.float64(g[v, f])) * weight[v, f]
                halo_counts[s, b] = poisson(child_key(child_key(key, steps[s] * bins + b), 0), mean)
    return halo_counts


@exact_jit
def fill_halos(key: Any, first: Any, steps: Any, number: Any, tables: Any, limits: Any, out: Any) -> int:
    """Draw the voxel and the random numbers of each halo, and store the halos that may reach a mass limit in `out`.

    Parameters
    ----------
    key : uint64
        Key from which the random numbers of the cell are made.
    first, steps : int array
        First voxel of each step and numbers of the steps, same as in `draw_counts`.
    number : int array, shape (s, bins)
        Number of halos in each block (step in distance and mass bin).
    tables : tuple of array
        Same as in `draw_counts`.
    limits : tuple
        Five values: upper edges of the mass bins, shape (bins,); lower limits of log10 mass, shape (s,), and of log10
        proxy mass (mass with a scatter), shape (s,), in Msun/h; the scatter, dex; and the largest scatter, standard
        deviations. A halo is stored if the upper edge of its bin reaches the first limit, or with the scatter the
        second limit.
    out : tuple of array
        Six arrays to fill, long enough for all halos: voxel, row of the step, mass bin and number in the block
        (int64[n]); random bits for the position (uint64[n]); random numbers (float64[n, 3]: uniform for the distance,
        uniform for the mass, normal deviate of the scatter).

    Returns
    -------
    int
        Number of halos that are stored in `out`.
    """
    voxel, row, column, rank, place, drawn = out
    ln_number, amplitude, field, g, weight = tables
    upper_edge, host_limit, central_limit, scatter, cut = limits
    bins, at = number.shape[1], 0
    # Mean number of halos of a block in each voxel of its step.
    mean = np.empty(np.max(first[1:] - first[:-1]) if steps.size else 0)
    for s in range(steps.size):
        for b in range(bins):
            block = child_key(key, steps[s] * bins + b)
            total = 0.0
            if number[s, b]:
                f = field[s, b]
                for v in range(first[s], first[s + 1]):
                    mean[v - first[s]] = np.exp(ln_number[s, b] + amplitude[s, b] * np.float64(g[v, f])) * weight[v, f]
                    total += mean[v - first[s]]
            for j in range(number[s, b]):
                halo_key = child_key(block, j + 1)
                deviate = cut_normal(halo_key, SCATTER, cut)
                if upper_edge[b] < host_limit[s] and upper_edge[b] + scatter * deviate < central_limit[s]:
                    continue
                remaining = uniform(child_key(halo_key, VOXEL)) * total
                v = first[s]
                while v < first[s + 1] - 1:
                    remaining -= mean[v - first[s]]
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
    """Number the halos with the same block and cell: 0, 1, 2 and so on, in the order of the arrays.

    Parameters
    ----------
    block : int array, shape (n,)
        Number of the block (step in distance and mass bin) of each halo; equal values must be consecutive.
    cell : int array, shape (n,)
        Nested index of the order-8 cell of each halo.
    out : int array, shape (n,)
        Filled with the numbers.
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
    """Draw the satellites of host halos, and store the satellites above a mass limit in `out`.

    Parameters
    ----------
    keys : uint64 array, shape (h,)
        Keys from which the random numbers of each host are made.
    log_mass : float array, shape (h,)
        log10 of the masses of the hosts, Msun/h.
    limit : float array, shape (h,)
        Lower limit of log10 of the proxy mass (mass of the sub-halo with a scatter) for each host, Msun/h.
    min_ratio : float
        Smallest ratio of host mass and sub-halo mass (min_mass_ratio in halos.toml).
    ratio : float array, shape (h,)
        Mean increase of this ratio from one satellite to the next.
    scatter, depth : float
        Standard deviation and largest value of the scatter of the proxy mass, dex (halos.toml).
    out : tuple of array
        Four arrays of length n to fill: row of the host and number of the satellite in it from 1 (int64), log10 of the
        proxy mass (float64), and random numbers (float64[n, 4]: uniform for enclosed mass, height and azimuth, and a
        normal deviate for the velocity). Satellites after the n-th are not stored.

    Returns
    -------
    int
        Number of satellites above the limit, which may be larger than n; then call the function again with longer
        arrays.

    Notes
    -----
    Satellites are drawn in the order of decreasing sub-halo mass m. The mass ratios M / m are a Poisson process of rate
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
