"""Measure the clustering of bright galaxies at separations up to the size of halos, relative to a power law.

The galaxies have M_r - 5 log h < -20 and redshifts of 0.4 to 0.6. Pairs of galaxies in HEALPix cells of order 5 are
compared with pairs of random points, to get w(theta). Densities are relative to the mean of all cells. The w of the
power law is computed with Limber's equation and the distances of the galaxies.

Notes
-----
Pairs across the borders of cells are counted neither for galaxies nor for random points.

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
from truesky.randomness.rng import stream
from truesky.request.schema import Universe
from truesky.validation import pairs
from truesky.validation.model import clustering

# Edges of the bins of projected separation, Mpc/h.
EDGES = np.array([0.04, 0.16, 0.32, 1.28, 5.12])
# Lowest redshift of the galaxies whose clustering is measured.
Z_MIN = 0.4
# Highest redshift of the galaxies whose clustering is measured.
Z_MAX = 0.6
# Galaxies must be brighter than this absolute magnitude M_r - 5 log h.
MAX_ABS_MAG = -20.0
# Correlation length of the observed power law, Mpc/h.
LENGTH = 5.5
# Slope (negative exponent) of the observed power law.
SLOPE = 1.8
# HEALPix order of the cells in which pairs are counted.
ORDER = 5
# Number of random points in each cell.
_RANDOM = 20_000
# Number of bins of the galaxies' distance distribution.
_BINS = 40


def galaxy_population(seed: int, settings: Universe) -> Population:
    """Return a model of the halos that host galaxies with M_r - 5 log h < -20 at 0.4 < z < 0.6.

    `seed` and `settings` define the periodic box of matter of the universe, and the structure below its cells.
    """
    matched = luminosity_function.inverse(luminosity_function.schechter(), matching.Z_LAST)
    space = Volume(Z_MIN - 0.05, Z_MAX + 0.05, MAX_ABS_MAG)
    box = seed, settings.cosmology, settings.box_cells
    return population.model(
        *box,
        space,
        matched,
        lambda z: np.full(np.size(z), MAX_ABS_MAG),
        structure_below_cells=settings.structure_below_cells,
    )


def figures(universe: Population, count: int) -> dict[str, float]:
    """Measure w of bright galaxies divided by w of the power law, in bins of projected separation.

    `universe` comes from `galaxy_population`, and `count` is the number of cells as in `measure_cells`. Names of the
    results contain the lower edge of the bin in Mpc/h; errors are from the scatter between cells.
    """
    return summarise(measure_cells(universe, count))


def summarise(ratio: Float) -> dict[str, float]:
    """Return the means and errors of the rows of `measure_cells`, by the names of `figures`."""
    names = [f"w_m20_{edge:g}" for edge in EDGES[:-1]]
    error = ratio.std(0, ddof=1) / np.sqrt(len(ratio))
    return {
        **dict(zip(names, ratio.mean(0).tolist(), strict=True)),
        **{f"{name}_error": value for name, value in zip(names, error.tolist(), strict=True)},
    }


def measure_cells(universe: Population, count: int) -> Float:
    """Measure w of bright galaxies divided by w of the power law in each of several cells.

    Parameters
    ----------
    universe : Population
        Model from `galaxy_population`.
    count : int
        Number of HEALPix cells of order 5, at least 2, which are distributed over the sky.

    Returns
    -------
    float array, shape (count, 4)
        The ratios by cell and bin of projected separation. Two universes with the same halos share most of their noise.
    """
    low, high = (float(universe.cosmology.comoving_distance(z)) for z in (Z_MIN, Z_MAX))
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
    return np.asarray((pair_counts / expected - 1.0) / power_law(np.concatenate(chi), theta))


def _count_pairs(ra: Float, dec: Float, theta: Float) -> Float:
    """Return the number of ordered pairs (each pair counts twice) in separation bins with edges `theta` (rad).

    Positions are in deg.
    """
    same = np.zeros(ra.size, np.int64)
    return np.asarray(2.0 * pairs.count_pairs(sky.unit_vectors(ra, dec), same, same, theta).total[0])


def power_law(chi: Float, theta: Float) -> Float:
    """Return w in each separation bin for the spatial correlation function xi(r) = (r / 5.5 Mpc/h)^-1.8.

    `chi` are the comoving distances of the galaxies (Mpc/h), and `theta` the edges of the bins (rad).
    """
    share, edges = np.histogram(chi, _BINS, density=True)
    middle, step = 0.5 * (edges[1:] + edges[:-1]), edges[1] - edges[0]
    depth = float(np.sum(share**2 * middle ** (1.0 - SLOPE)) * step)
    level = gamma(0.5) * gamma(0.5 * (SLOPE - 1.0)) / gamma(0.5 * SLOPE) * LENGTH**SLOPE * depth
    power = 3.0 - SLOPE
    return np.asarray(level * 2.0 / power * np.diff(theta**power) / np.diff(theta**2))
