"""Clustering at and within the size of halos: w(theta) of bright galaxies over that of a power law.

The galaxies have M_r < -20 and a redshift of about 0.5. Pairs of galaxies in order-5 cells are compared with pairs of
random points. Both are relative to the mean density of all cells, not to the mean of each cell. The power law is
projected with Limber's equation and the distances of the galaxies.

Notes
-----
Pairs across the borders of cells are in neither count.

References
----------
Limber 1953, ApJ 117, 134
Peebles 1980, The Large-Scale Structure of the Universe, eq. 52.7
"""

from __future__ import annotations

import numpy as np
from scipy.special import gamma

from lake_schema import sky
from lake_schema.arrays import Float
from truesky.catalogue.halos import luminosity_function, matching, population
from truesky.catalogue.halos.luminosity_function import Volume
from truesky.catalogue.halos.population import Population
from truesky.fluxes import cosmology
from truesky.randomness.rng import stream
from truesky.validation import pairs
from truesky.validation.model import clustering

# Projected separations (Mpc/h); redshifts and luminosities of the galaxies; length (Mpc/h) and slope of the power law.
EDGES = np.array([0.04, 0.16, 0.32, 1.28, 5.12])
Z_MIN, Z_MAX, MAX_ABS_MAG = 0.4, 0.6, -20.0
LENGTH, SLOPE = 5.5, 1.8
ORDER = 5
# Random points per cell, and bins of distance.
_RANDOM, _BINS = 20_000, 40


def galaxy_population(seed: int, box_cells: int) -> Population:
    """Return halos that host galaxies brighter than MAX_ABS_MAG in a box with `box_cells` cells per side."""
    matched = luminosity_function.inverse(luminosity_function.schechter(), matching.Z_LAST)
    space = Volume(Z_MIN - 0.05, Z_MAX + 0.05, MAX_ABS_MAG)
    return population.model(seed, box_cells, space, matched, lambda z: np.full(np.size(z), MAX_ABS_MAG))


def figures(universe: Population, count: int) -> dict[str, float]:
    """Return w over that of the power law in each bin, and its error from the scatter between cells.

    The population comes from `galaxy_population`; `count` order-5 cells are distributed over the sky. Names contain the
    lower edge of each bin.
    """
    low, high = (float(cosmology.comoving_distance(z)) for z in (Z_MIN, Z_MAX))
    theta = EDGES / (0.75 * (high**4 - low**4) / (high**3 - low**3))
    cells = ((np.arange(count) + 0.31) * (12 << 2 * ORDER) / count).astype(int).tolist()
    pair_counts, chance, number, chi = np.zeros((count, 4)), np.zeros((count, 4)), np.zeros(count), []
    for row, cell in enumerate(cells):
        sample = clustering.draw_tracers(universe, ORDER, cell)
        z = universe.halos.distances.redshift(sample.chi)
        bright = universe.halos.matching.magnitude(z, sample.proxy) < MAX_ABS_MAG
        sample = sample.select(bright & (sample.chi > low) & (sample.chi < high))
        number[row] = sample.chi.size
        chi.append(sample.chi)
        pair_counts[row] = _count_pairs(sample.ra, sample.dec, theta)
        _, ra, dec = sky.random_in_cell(ORDER, cell, _RANDOM, stream(universe.seed, "small_scales", cell))
        chance[row] = _count_pairs(ra, dec, theta) / _RANDOM**2
    expected = chance.mean(0) * number.mean() ** 2
    ratio = (pair_counts / expected - 1.0) / power_law(np.concatenate(chi), theta)
    names = [f"w_m20_{edge:g}" for edge in EDGES[:-1]]
    error = ratio.std(0, ddof=1) / np.sqrt(count)
    return {
        **dict(zip(names, ratio.mean(0).tolist(), strict=True)),
        **{f"{name}_error": value for name, value in zip(names, error.tolist(), strict=True)},
    }


def _count_pairs(ra: Float, dec: Float, theta: Float) -> Float:
    """Ordered pairs in each bin of separation with edges `theta` in rad."""
    same = np.zeros(ra.size, np.int64)
    return np.asarray(2.0 * pairs.count_pairs(sky.unit_vectors(ra, dec), same, same, theta).total[0])


def power_law(chi: Float, theta: Float) -> Float:
    """Return w of xi = (r / LENGTH)^-SLOPE, averaged over the pairs of each bin.

    The galaxies lie at comoving distances `chi` (Mpc/h); the bins of separation have edges `theta` (rad).
    """
    share, edges = np.histogram(chi, _BINS, density=True)
    middle, step = 0.5 * (edges[1:] + edges[:-1]), edges[1] - edges[0]
    depth = float(np.sum(share**2 * middle ** (1.0 - SLOPE)) * step)
    level = gamma(0.5) * gamma(0.5 * (SLOPE - 1.0)) / gamma(0.5 * SLOPE) * LENGTH**SLOPE * depth
    power = 3.0 - SLOPE
    return np.asarray(level * 2.0 / power * np.diff(theta**power) / np.diff(theta**2))
