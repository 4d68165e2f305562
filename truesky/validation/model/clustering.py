"""Measure the clustering of the simulated universe: matter power spectrum, bias of halos, and w(theta) on the sky.

The universe is made from a periodic box with a Gaussian density field, whose replicas fill the light cone. Halos and
galaxies above a mass between two redshifts are drawn in blocks of the sky of 54 deg2 each. Their w(theta) is measured
from counts in pixels, and compared with linear theory and linear bias in Limber's approximation. The Gaussian field
along the same lines of sight shows how the structure in these blocks differs from the mean.

References
----------
Limber 1953, ApJ 117, 134
Landy & Szalay 1993, ApJ 412, 64 (in pixels their estimator is <delta delta'>)
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy import fft
from scipy.special import j0

from lake_schema import sky
from lake_schema.arrays import Bool, Float, Int
from truesky.catalogue.halos import halos, luminosity_function, matching, population, satellites
from truesky.catalogue.halos.luminosity_function import Volume
from truesky.catalogue.halos.population import Population
from truesky.catalogue.matter import convergence, density_box, lightcone
from truesky.catalogue.matter.density_box import Box, BoxModel
from truesky.cosmology import Cosmology
from truesky.request.schema import Universe
from truesky.validation import pairs, theory
from truesky.validation.theory import Shells

# HEALPix order of the blocks in which large separations are measured (53.7 deg^2, with pixels of 6.9 arcmin).
BLOCK_ORDER = 3
# Each block contains one smaller HEALPix cell of this order. Sources in it are counted in pixels of 0.9 arcmin, to
# measure the clustering at small separations.
PIECE_ORDER = 6
# Pixels have a HEALPix order higher than their block or cell by this number.
DEPTH = 6
# The distribution of separations in a block is computed from every n-th pixel to all pixels.
_SPARSE = 16
# Number of bins of the distribution of separations.
_NODES = 2000
# Number of separations at which w is summed over multipoles.
_THETAS = 300
# Width of the shells of comoving distance for the prediction, Mpc/h.
_SHELL = 80.0
# Highest multipole in the sums for w.
_ELL_MAX = 20_000
# Cells per side of the grid on which the power spectrum of the Gaussian field is tabulated.
_MODES = 128


@dataclass(frozen=True, slots=True, eq=False)
class Tracers:
    """Points whose clustering follows the matter: halos (with their central galaxies) and satellite galaxies.

    Attributes
    ----------
    ra, dec : float array, shape (n,)
        Positions, deg.
    chi : float array, shape (n,)
        Comoving distances, Mpc/h.
    bias_growth : float array, shape (n,)
        Linear bias of the halo times the growth factor at its redshift (1 today).
    satellite : bool array, shape (n,)
        True for satellites.
    log_mass, proxy : float array, shape (n,)
        log10 of the mass of the halo, and of the proxy mass that determines the luminosity of the galaxy (for
        satellites the mass of the subhalo), Msun/h.
    velocity : float array, shape (n,)
        Peculiar velocity along the line of sight, km/s.
    """

    ra: Float
    dec: Float
    chi: Float
    bias_growth: Float
    satellite: Bool
    log_mass: Float
    proxy: Float
    velocity: Float

    def select(self, mask: npt.NDArray[np.generic]) -> Tracers:
        """Return only the tracers that a bool mask, shape (n,), or an array of indices selects."""
        return Tracers(*(getattr(self, name)[mask] for name in self.__slots__))


def concatenate(parts: Sequence[Tracers]) -> Tracers:
    """Join several sets of tracers to one; at least one set is required."""
    return Tracers(*(np.concatenate([getattr(part, name) for part in parts]) for name in Tracers.__slots__))


def _power_ratio(field: npt.NDArray[np.floating], model: BoxModel, edges: Float) -> Float:
    """Return the power spectrum of a periodic cube divided by the linear power at z = 0, in bins of wavenumber.

    `field` has the overdensity (or the density divided by its mean) in the cells of a box with the parameters `model`.
    `edges` are the edges of the bins in h/Mpc.
    """
    n, cell = field.shape[0], model.cell
    power = (np.abs(fft.rfftn(field)) ** 2).ravel() * (cell**3 / n**3)
    axis, half = 2 * np.pi * fft.fftfreq(n, cell), 2 * np.pi * fft.rfftfreq(n, cell)
    k = np.sqrt(axis[:, None, None] ** 2 + axis[None, :, None] ** 2 + half**2)
    weight = np.full(k.shape, 2.0)
    weight[..., 0] = weight[..., -1] = 1.0
    place = np.digitize(k.ravel(), edges)
    linear = density_box.linear_power(model.cosmology, np.maximum(k.ravel(), 1e-4))
    total = [np.bincount(place, weight.ravel() * value, edges.size + 1)[1:-1] for value in (power, linear)]
    return np.asarray(total[0] / total[1])


def box_power(box: Box, edges: Float) -> Float:
    """Return the matter power spectrum of a box at z = 0 divided by the linear power, shape (bins,).

    `edges`, shape (bins + 1,), are the edges of the wavenumber bins in h/Mpc.
    """
    return _power_ratio(np.expm1(box.smoothed[0] - np.float32(0.5 * box.variance[0])), box.model, edges)


def halo_bias(box: Box, x: Sequence[float], edges: Float) -> Float:
    """Return the measured bias of the density fields from which halos are drawn, divided by the intended bias.

    Parameters
    ----------
    box : Box
        Periodic box with the density fields of the universe.
    x : sequence of float
        Intended values of bias times growth factor.
    edges : float array, shape (bins + 1,)
        Edges of the wavenumber bins, h/Mpc.

    Returns
    -------
    float array, shape (len(x), bins)
        Square root of the ratio of the power spectra of halos and matter, divided by x.
    """
    matter = box_power(box, edges)
    field, amplitude = density_box.biased_field(box.model, np.array(x))
    rows = []
    for i, times in zip(field.tolist(), amplitude.tolist(), strict=True):
        number = np.exp(np.float32(times) * box.smoothed[i] - np.float32(0.5 * times**2 * box.variance[i]))
        rows.append(np.sqrt(_power_ratio(number, box.model, edges) / matter))
    return np.asarray(np.array(rows) / np.array(x)[:, None])


def velocity_rms(box: Box, x: float) -> float:
    """Return the rms (km/s) of one component of the peculiar velocity at z = 0, averaged over halos with bias `x`."""
    field, amplitude = (value[0] for value in density_box.biased_field(box.model, np.array([x])))
    weight = np.exp(np.float32(amplitude) * box.smoothed[int(field)])
    square = [np.average(u**2, weights=weight) for u in box.velocity]
    return float(density_box.velocity_factor(box.model, 0.0) * np.sqrt(np.mean(square)))


def population_above(seed: int, settings: Universe, z_min: float, z_max: float, log_mass: float) -> Population:
    """Return a model of the halos and galaxies above a mass and between two redshifts.

    Galaxies are limited by their proxy mass (halo or subhalo mass with scatter, which determines the luminosity).

    Parameters
    ----------
    seed : int
        Seed of the universe's periodic box of matter.
    settings : Universe
        Cosmology, and number of cells along each side of the box.
    z_min, z_max : float
        Redshift range.
    log_mass : float
        log10 of the lowest mass, Msun/h.

    Returns
    -------
    Population
        Model, from which `draw_tracers` draws halos and galaxies.
    """
    table = matching.masses(settings.cosmology)
    inverse = luminosity_function.inverse(luminosity_function.schechter(), matching.Z_LAST)
    matched = matching.match_luminosities(table, inverse)
    volume = Volume(z_min, z_max, 0.0)
    box = seed, settings.cosmology, settings.box_cells
    return population.model(
        *box,
        volume,
        inverse,
        lambda z: matched.magnitude(z, np.full(np.size(z), log_mass)),
        structure_below_cells=settings.structure_below_cells,
    )


def draw_tracers(universe: Population, order: int, block: int) -> Tracers:
    """Draw the halos and satellite galaxies whose positions are inside a HEALPix cell.

    Parameters
    ----------
    universe : Population
        Model of halos and satellites.
    order, block : int
        HEALPix order and nested number of the cell.

    Returns
    -------
    Tracers
        Halos and satellites. Halos of different masses are drawn on HEALPix grids of different order (levels); for each
        cell of a level the halos come first, then the satellites. Only cells of a level that overlap with the given
        cell are drawn, so satellites inside it that belong to halos in other cells are missing.
    """
    parts = []
    for level in halos.LEVELS:
        n_cells = 1 << 2 * max(level - order, 0)
        first = block << 2 * (level - order) if level >= order else block >> 2 * (order - level)
        for cell in range(first, first + n_cells):
            hosts = halos.draw(universe.halos, universe.seed, level, cell)
            members = satellites.draw(universe.halos, universe.masses, hosts, universe.seed)
            ra, dec = sky.positions_of_indices(hosts.index)
            z = universe.halos.distances.redshift(hosts.chi)
            x = universe.masses.interpolate_pairs(universe.masses.bias, z, hosts.log_mass)
            x = x * universe.cosmology.growth(z)
            is_satellite = np.repeat([False, True], [ra.size, members.ra.size])
            host = np.concatenate([np.arange(ra.size), members.host])
            pairs = ((ra, members.ra), (dec, members.dec), (hosts.chi, members.chi), (hosts.proxy, members.proxy))
            ra, dec, chi, proxy = (np.concatenate(pair) for pair in pairs)
            speed = np.concatenate([hosts.velocity, members.velocity])
            inside = sky.cell_at(ra, dec, order) == block
            parts.append(
                Tracers(ra, dec, chi, x[host], is_satellite, hosts.log_mass[host], proxy, speed).select(inside)
            )
    return concatenate(parts)


@dataclass(frozen=True, slots=True, eq=False)
class Correlation:
    """Measured angular correlation function w, relative to the mean density of each block of the sky.

    Attributes
    ----------
    theta : float array, shape (bins,)
        Mean separation of the pairs in each bin, deg.
    w : float array, shape (bins,)
        Correlation function, averaged over all blocks.
    error : float array, shape (bins,)
        Standard error from the scatter between blocks.
    pairs : Pairs
        Distribution of the separations of pairs in a block, over which a prediction must be averaged.
    """

    theta: Float
    w: Float
    error: Float
    pairs: Pairs


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Distributions of the separations between pixels of a block of the sky.

    Attributes
    ----------
    nodes : float array, shape (m,)
        Separations, deg.
    of_bin : float array, shape (bins, m)
        For each bin of separation: fraction of its pairs of pixels at each of the m separations.
    of_pixel : float array, shape (bins, m)
        For the pixels in the pairs of each bin: distribution of their separations from all pixels of the block.
    of_all : float array, shape (m,)
        Distribution of the separations of all pairs of pixels in the block.
    """

    nodes: Float
    of_bin: Float
    of_pixel: Float
    of_all: Float

    def subtract_block_mean(self, w: Float) -> tuple[Float, Float]:
        """Average a predicted w, given at the m separations `nodes`, over the pairs of each bin.

        Returns w in each bin, and the w that is measured in each bin if densities are relative to the mean of each
        block.
        """
        mean, pixel, block_mean = (shares @ w for shares in (self.of_bin, self.of_pixel, self.of_all))
        return mean, mean - 2.0 * pixel + block_mean


def correlation(blocks: Sequence[tuple[int, Sequence[Tracers | Float]]], order: int, edges: Float) -> list[Correlation]:
    """Measure w(theta) of several kinds of tracers (such as halos and galaxies) in blocks of the sky.

    Parameters
    ----------
    blocks : sequence of (int, sequence of Tracers or float arrays)
        For each block, its nested HEALPix number, and for each kind the tracers in it or a map of its pixels.
    order : int
        HEALPix order of the blocks.
    edges : float array, shape (bins + 1,)
        Edges of the separation bins, deg, ascending.

    Returns
    -------
    list of Correlation
        One correlation function for each kind of tracers. Errors are NaN with a single block.
    """
    deltas = [[_overdensity(tracers, order, cell) for tracers in by_kind] for cell, by_kind in blocks]
    delta, chance = (np.array([[pair[i] for pair in row] for row in deltas]) for i in range(2))
    bins, n_kinds = edges.size - 1, delta.shape[1]
    product, number, angle = np.zeros((len(blocks), n_kinds, bins)), np.zeros((len(blocks), bins)), np.zeros(bins)
    for row, (cell, _) in enumerate(blocks):
        number[row], separation_sum, product[row] = pairs.sum_products(
            _vectors(order, cell), delta[row].T, np.radians(edges)
        )
        angle += np.degrees(separation_sum)
    product += chance[:, :, None] * number[:, None]
    scatter = np.std(product / number[:, None], axis=0, ddof=1) / np.sqrt(len(blocks))
    total = product.sum(0) / number.sum(0)
    separations = _pixel_pairs(order, blocks[0][0], edges)
    theta = angle / number.sum(0)
    return [Correlation(theta, w, error, separations) for w, error in zip(total, scatter, strict=True)]


def _separations(first: Float, second: Float, edges: Float) -> tuple[Int, Float]:
    """Return the separation of all pairs of two sets of unit vectors in deg, and its bin between `edges` (deg).

    The bin is -1 below the first edge, and the number of bins above the last. Both results are flat arrays.
    """
    theta = np.degrees(np.arccos(np.clip(first @ second.T, -1.0, 1.0))).ravel()
    return np.searchsorted(edges, theta) - 1, theta


def _pixel_pairs(order: int, cell: int, edges: Float) -> Pairs:
    """Return the distributions of separations between pixels of a block, from every 16th pixel to all pixels.

    `order` and `cell` are the HEALPix order and nested number of the block; `edges` (deg) are the separation bins.
    """
    place, bins = _vectors(order, cell), edges.size - 1
    fine = np.linspace(0.0, 3.0 * sky.cell_radius(order), _NODES + 1)
    of_bin, of_pixel, of_all = np.zeros((bins, _NODES)), np.zeros((bins, _NODES)), np.zeros(_NODES)
    for vector in place[::_SPARSE]:
        bin_index, theta = _separations(vector[None, :], place, edges)
        node = np.searchsorted(fine, theta, side="right") - 1
        node_counts = np.bincount(node, minlength=_NODES)
        of_all += node_counts
        for i in range(bins):
            inside = node[bin_index == i]
            of_bin[i] += np.bincount(inside, minlength=_NODES)
            of_pixel[i] += inside.size * node_counts
    shares = [part / part.sum(-1, keepdims=True) for part in (of_bin, of_pixel, of_all)]
    return Pairs(0.5 * (fine[1:] + fine[:-1]), *shares)


def _overdensity(tracers: Tracers | Float, order: int, cell: int) -> tuple[Float, float]:
    """Return the overdensity of the pixels of a block relative to the mean of this block, and a correction of w.

    Because n points are counted relative to their own mean, their w is too low by 1 / n. The correction is this number,
    which a caller adds to w; it is 0 if `tracers` is a map. The mean of the block is removed because it dominates the
    noise without telling anything about smaller scales.
    """
    if not isinstance(tracers, Tracers):
        return np.asarray(tracers - tracers.mean()), 0.0
    pixel = sky.cell_at(tracers.ra, tracers.dec, order + DEPTH) - (cell << 2 * DEPTH)
    inside = (pixel >= 0) & (pixel < 1 << 2 * DEPTH)
    number = np.bincount(pixel[inside], minlength=1 << 2 * DEPTH)
    return np.asarray(number / number.mean() - 1.0), 1.0 / float(number.sum())


def _vectors(order: int, cell: int) -> Float:
    return sky.unit_vectors(*sky.cell_centres(order + DEPTH, (cell << 2 * DEPTH) + np.arange(1 << 2 * DEPTH)))


def shells(cosmology: Cosmology, tracers: Tracers, z_min: float, z_max: float) -> Shells:
    """Return the distribution of tracers over shells of comoving distance, weighted with bias times growth factor.

    Parameters
    ----------
    cosmology : Cosmology
        Parameters of the universe.
    tracers : Tracers
        Halos or galaxies; those outside the redshift range are ignored.
    z_min, z_max : float
        Redshift range.

    Returns
    -------
    Shells
        Shells of equal width, at most 80 Mpc/h, between the two redshifts.
    """
    first, last = (float(cosmology.comoving_distance(z)) for z in (z_min, z_max))
    edges = np.linspace(first, last, int(np.ceil((last - first) / _SHELL)) + 1)
    return theory.shells(tracers.chi, tracers.bias_growth, edges)


def limber(
    cosmology: Cosmology, tracer_shells: Shells, measured: Correlation, power: Callable[[Cosmology, Float], Float]
) -> tuple[Float, Float]:
    """Predict the angular correlation function w from a power spectrum in Limber's approximation.

    Parameters
    ----------
    cosmology : Cosmology
        Parameters of the universe.
    tracer_shells : Shells
        Distribution of the tracers over distance, weighted with bias times growth factor.
    measured : Correlation
        Measurement for whose separation bins w is predicted.
    power : callable
        Function of (cosmology, k) that returns the matter power P(k) at z = 0 in (Mpc/h)^3 for k in h/Mpc.

    Returns
    -------
    w, mean_subtracted : float array, shape (bins,)
        Predicted w in each bin, and the w that is measured if densities are relative to the mean of each block.
    """
    ell = np.geomspace(1.0, _ELL_MAX, 400)
    c_l = theory.galaxy_power(cosmology, ell, tracer_shells, lambda universe, k, _: power(universe, k))
    multipoles = np.arange(1, _ELL_MAX + 1)
    # Cut off high multipoles smoothly: a sharp cutoff would cause oscillations at small separations.
    weight = (2 * multipoles + 1) / (4 * np.pi) * np.interp(np.log(multipoles), np.log(ell), c_l)
    weight *= np.exp(-((multipoles / (0.5 * _ELL_MAX)) ** 2))
    nodes = measured.pairs.nodes
    theta = np.geomspace(nodes[0], nodes[-1], _THETAS)
    w = np.array([np.sum(weight * j0((multipoles + 0.5) * np.radians(at))) for at in theta])
    return measured.pairs.subtract_block_mean(np.interp(np.log(nodes), np.log(theta), w))


def projected_field(box: Box, order: int, cell: int, tracer_shells: Shells) -> Float:
    """Integrate the Gaussian density field of the universe along the line of sight of each pixel of a block.

    Parameters
    ----------
    box : Box
        Periodic box with the density field; its replicas fill the light cone.
    order, cell : int
        HEALPix order and nested number of the block.
    tracer_shells : Shells
        Distribution of tracers over distance, which is the weight of the field along the line of sight.

    Returns
    -------
    float array, shape (4096,)
        Weighted field in each pixel of the block, in nested order.
    """
    box_replicas, direction = (
        lightcone.draw_replicas(box, float(tracer_shells.chi[-1] + tracer_shells.width[-1])),
        _vectors(order, cell),
    )
    step, g, total = box.model.cell, box.smoothed[0].ravel(), np.zeros(len(direction))
    ends = tracer_shells.chi[0] - 0.5 * tracer_shells.width[0], tracer_shells.chi[-1] + 0.5 * tracer_shells.width[-1]
    for chi in np.arange(ends[0] + 0.5 * step, ends[1], step):
        place, _ = lightcone.box_cells(box, box_replicas, direction, np.full(len(direction), chi))
        total += step * np.interp(chi, tracer_shells.chi, tracer_shells.weight) * g[place]
    return total


def gaussian_power(cosmology: Cosmology, k: Float) -> Float:
    """Return the power spectrum P(k) in (Mpc/h)^3 of the simulated Gaussian field, for k in h/Mpc.

    It includes the effect of finite cells, in which the field is constant, and is 0 for k of 1.2 h/Mpc or more.
    """
    model = density_box.box_model(cosmology)
    cell = model.cell
    on_modes = density_box._log_power(model, _MODES).ravel()
    length = np.sqrt(density_box._k_squared(_MODES, cell)).ravel()
    edges = np.concatenate([[0.0], (np.arange(8) + 0.5) * 2 * np.pi / (_MODES * cell), np.geomspace(0.12, 1.3, 40)])
    place = np.digitize(length[1:], edges)
    number = np.maximum(np.bincount(place), 1)
    at, share = (np.bincount(place, value) / number for value in (length[1:], on_modes[1:]))
    is_filled = at > 0
    ratio = np.interp(k, at[is_filled], share[is_filled] / density_box.linear_power(cosmology, at[is_filled]))
    nodes = np.geomspace(1e-3, 1.2, 40)
    ratio *= np.interp(k, nodes, convergence.window(model, 1, nodes))
    return np.where(k < 1.2, density_box.linear_power(cosmology, k) * ratio, 0.0)
