"""Clustering of the simulated universe: power of the box, bias of halos, and w(theta) against Limber's approximation.

Halos and galaxies above a mass between two redshifts are drawn in blocks of the sky, hundreds of deg2 in total. Their
w(theta) is measured from counts in pixels and compared with linear theory and linear bias. The Gaussian field of the
box along the same lines of sight shows how the structure in these blocks differs from the mean.

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
from truesky.catalogue.matter.density_box import Box
from truesky.fluxes import cosmology
from truesky.validation import pairs, theory
from truesky.validation.theory import Shells

# Blocks are cells of this order (53.7 deg2) in pixels of 6.9 arcmin. Small separations are counted in one smaller
# cell per block, in pixels of 0.9 arcmin. Pixels are DEPTH orders finer than their block.
BLOCK_ORDER, PIECE_ORDER, DEPTH = 3, 6, 6
# One pixel in this number is used as first pixel of a pair in the statistics of separations.
_SPARSE = 16
# Nodes of the separations of pairs, and of the separations at which w is summed over multipoles.
_NODES, _THETAS = 2000, 300
# Width of shells for the redshift distribution and the bias (Mpc/h), and highest multipole.
_SHELL, _ELL_MAX = 80.0, 20_000
# Cells per side of the grid on which the power of the Gaussian field is tabulated.
_MODES = 128


@dataclass(frozen=True, slots=True, eq=False)
class Tracers:
    """Points that trace the matter: halos and satellites.

    Attributes
    ----------
    ra, dec : float array, shape (n,)
        Position, deg.
    chi : float array, shape (n,)
        Comoving distance, Mpc/h.
    bias_growth : float array, shape (n,)
        Bias of the halo times the growth factor.
    satellite : bool array, shape (n,)
        True for satellites.
    log_mass, proxy : float array, shape (n,)
        log10 of halo mass and of proxy mass.
    velocity : float array, shape (n,)
        Line-of-sight velocity, km/s.
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
        """Return the tracers selected by a mask or by indices."""
        return Tracers(*(getattr(self, name)[mask] for name in self.__slots__))


def concatenate(parts: Sequence[Tracers]) -> Tracers:
    """Return the tracers of several parts together."""
    return Tracers(*(np.concatenate([getattr(part, name) for part in parts]) for name in Tracers.__slots__))


# ------------------------------------------------------------------------------------------------ the box


def _power_ratio(field: npt.NDArray[np.floating], cell: float, edges: Float) -> Float:
    """P(k) of a cube over linear P(k) in bins of k between edges in h/Mpc."""
    n = field.shape[0]
    power = (np.abs(fft.rfftn(field)) ** 2).ravel() * (cell**3 / n**3)
    axis, half = 2 * np.pi * fft.fftfreq(n, cell), 2 * np.pi * fft.rfftfreq(n, cell)
    k = np.sqrt(axis[:, None, None] ** 2 + axis[None, :, None] ** 2 + half**2)
    weight = np.full(k.shape, 2.0)
    weight[..., 0] = weight[..., -1] = 1.0
    place = np.digitize(k.ravel(), edges)
    linear = density_box.linear_power(np.maximum(k.ravel(), 1e-4))
    total = [np.bincount(place, weight.ravel() * value, edges.size + 1)[1:-1] for value in (power, linear)]
    return np.asarray(total[0] / total[1])


def box_power(box: Box, edges: Float) -> Float:
    """Return P(k) / P_linear(k) of the matter at z = 0 in bins of k between edges in h/Mpc."""
    return _power_ratio(np.expm1(box.smoothed[0] - np.float32(0.5 * box.variance[0])), box.model.cell, edges)


def halo_bias(box: Box, x: Sequence[float], edges: Float) -> Float:
    """Return the measured bias of the fields from which halos are drawn, relative to the requested bias.

    Parameters
    ----------
    box : Box
        Box of matter.
    x : sequence of float
        Bias times growth factor.
    edges : float array, shape (bins + 1,)
        Edges of the bins, h/Mpc.

    Returns
    -------
    float array, shape (x, bins)
        Bias against the matter of the box, divided by x.
    """
    matter = box_power(box, edges)
    field, amplitude = density_box.biased_field(box.model, np.array(x))
    rows = []
    for i, times in zip(field.tolist(), amplitude.tolist(), strict=True):
        number = np.exp(np.float32(times) * box.smoothed[i] - np.float32(0.5 * times**2 * box.variance[i]))
        rows.append(np.sqrt(_power_ratio(number, box.model.cell, edges) / matter))
    return np.asarray(np.array(rows) / np.array(x)[:, None])


def velocity_rms(box: Box, x: float) -> float:
    """Return the rms in km/s of one velocity component of halos of bias `x` at z = 0 in the whole box."""
    field, amplitude = (value[0] for value in density_box.biased_field(box.model, np.array([x])))
    weight = np.exp(np.float32(amplitude) * box.smoothed[int(field)])
    square = [np.average(u**2, weights=weight) for u in box.velocity]
    return float(density_box.velocity_factor(box.model, 0.0) * np.sqrt(np.mean(square)))


# ------------------------------------------------------------------------------------------------ on the sky


def population_above(seed: int, box_cells: int, z_min: float, z_max: float, log_mass: float) -> Population:
    """Return halos, and galaxies by their proxy mass, above a mass and between two redshifts.

    Parameters
    ----------
    seed : int
        Seed of the box of matter.
    box_cells : int
        Cells per side of the box.
    z_min, z_max : float
        Redshift range.
    log_mass : float
        log10 of the lowest mass, in the unit of table `halos`.

    Returns
    -------
    Population
        Model from which `draw_tracers` draws.
    """
    table, inverse = matching.masses(), luminosity_function.inverse(luminosity_function.schechter(), matching.Z_LAST)
    matched = matching.match_luminosities(table, inverse)
    volume = Volume(z_min, z_max, 0.0)
    return population.model(
        seed, box_cells, volume, inverse, lambda z: matched.magnitude(z, np.full(np.size(z), log_mass))
    )


def draw_tracers(universe: Population, order: int, block: int) -> Tracers:
    """Draw the halos and satellites inside a nested cell.

    Parameters
    ----------
    universe : Population
        Model of halos and satellites.
    order, block : int
        HEALPix order and number of the cell.

    Returns
    -------
    Tracers
        Halos, followed by satellites, per level of the halo grid.
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
            x = universe.masses.interpolate_pairs(universe.masses.bias, z, hosts.log_mass) * density_box.growth(z)
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
    """Angular correlation function relative to the mean of each block.

    Attributes
    ----------
    theta : float array, shape (bins,)
        Mean separation, deg.
    w : float array, shape (bins,)
        Correlation function.
    error : float array, shape (bins,)
        Standard error from the scatter between blocks.
    pairs : Pairs
        Separations over which w is averaged.
    """

    theta: Float
    w: Float
    error: Float
    pairs: Pairs


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Distributions of the separations of pairs of pixels in a block.

    Attributes
    ----------
    nodes : float array, shape (m,)
        Separations, deg.
    of_bin : float array, shape (bins, m)
        Fraction of the pairs of each bin at each separation.
    of_pixel : float array, shape (bins, m)
        The same for pairs of the pixels of each bin with the whole block.
    of_all : float array, shape (m,)
        The same for all pairs of the block.
    """

    nodes: Float
    of_bin: Float
    of_pixel: Float
    of_all: Float

    def subtract_block_mean(self, w: Float) -> tuple[Float, Float]:
        """Return w per bin from w at the nodes, and w per bin relative to the mean of each block."""
        mean, pixel, block_mean = (shares @ w for shares in (self.of_bin, self.of_pixel, self.of_all))
        return mean, mean - 2.0 * pixel + block_mean


def correlation(blocks: Sequence[tuple[int, Sequence[Tracers | Float]]], order: int, edges: Float) -> list[Correlation]:
    """Measure w(theta) of each kind of tracer in blocks.

    Parameters
    ----------
    blocks : sequence of (int, sequence of Tracers or float arrays)
        Number of each cell, and tracers, or values of its pixels, for each kind.
    order : int
        HEALPix order of the cells.
    edges : float array, shape (bins + 1,)
        Edges of the separation bins, deg.

    Returns
    -------
    list of Correlation
        One for each kind.
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
    """Bin of the separation of each pair (-1 or the number of bins if outside), and the separation in deg."""
    theta = np.degrees(np.arccos(np.clip(first @ second.T, -1.0, 1.0))).ravel()
    return np.searchsorted(edges, theta) - 1, theta


def _pixel_pairs(order: int, cell: int, edges: Float) -> Pairs:
    """Separations of every _SPARSE-th pixel from all pixels."""
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
    """Overdensity of the pixels, and 1 / n, the anticorrelation of n points in a block of fixed total number.

    The mean is that of the block. The common overdensity of a block contains no information about smaller scales and
    dominates the noise.
    """
    if not isinstance(tracers, Tracers):
        return np.asarray(tracers - tracers.mean()), 0.0
    pixel = sky.cell_at(tracers.ra, tracers.dec, order + DEPTH) - (cell << 2 * DEPTH)
    inside = (pixel >= 0) & (pixel < 1 << 2 * DEPTH)
    number = np.bincount(pixel[inside], minlength=1 << 2 * DEPTH)
    return np.asarray(number / number.mean() - 1.0), 1.0 / float(number.sum())


def _vectors(order: int, cell: int) -> Float:
    return sky.unit_vectors(*sky.cell_centres(order + DEPTH, (cell << 2 * DEPTH) + np.arange(1 << 2 * DEPTH)))


def shells(tracers: Tracers, z_min: float, z_max: float) -> Shells:
    """Return tracers between two redshifts in shells of equal width, with bias times growth.

    Parameters
    ----------
    tracers : Tracers
        Halos or galaxies.
    z_min, z_max : float
        Redshift range.

    Returns
    -------
    Shells
        Fraction of tracers times bias in each shell.
    """
    first, last = (float(cosmology.comoving_distance(z)) for z in (z_min, z_max))
    edges = np.linspace(first, last, int(np.ceil((last - first) / _SHELL)) + 1)
    return theory.shells(tracers.chi, tracers.bias_growth, edges)


def limber(tracer_shells: Shells, measured: Correlation, power: Callable[[Float], Float]) -> tuple[Float, Float]:
    """Predict w for a power spectrum in the separation bins of a measurement.

    Parameters
    ----------
    tracer_shells : Shells
        Tracers by distance.
    measured : Correlation
        Measurement whose pairs are used.
    power : callable
        P(k) in (Mpc/h)^3 of k in h/Mpc.

    Returns
    -------
    w, mean_subtracted : float array, shape (bins,)
        w, and w relative to the mean of each block.
    """
    ell = np.geomspace(1.0, _ELL_MAX, 400)
    c_l = theory.galaxy_power(ell, tracer_shells, lambda k, _: power(k))
    multipoles = np.arange(1, _ELL_MAX + 1)
    # A smooth cutoff at high multipoles avoids ringing at small separations.
    weight = (2 * multipoles + 1) / (4 * np.pi) * np.interp(np.log(multipoles), np.log(ell), c_l)
    weight *= np.exp(-((multipoles / (0.5 * _ELL_MAX)) ** 2))
    nodes = measured.pairs.nodes
    theta = np.geomspace(nodes[0], nodes[-1], _THETAS)
    w = np.array([np.sum(weight * j0((multipoles + 0.5) * np.radians(at))) for at in theta])
    return measured.pairs.subtract_block_mean(np.interp(np.log(nodes), np.log(theta), w))


def projected_field(box: Box, order: int, cell: int, tracer_shells: Shells) -> Float:
    """Project the Gaussian field of the box along the lines of sight of the pixels of a block.

    Parameters
    ----------
    box : Box
        Box of matter.
    order, cell : int
        HEALPix order and number of the nested block.
    tracer_shells : Shells
        Tracers by distance; they weight the field.

    Returns
    -------
    float array, shape (pixels,)
        Projected field.
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


def gaussian_power(k: Float) -> Float:
    """P(k) of the Gaussian field in (Mpc/h)^3 for k in h/Mpc; the field is constant within cells of the box."""
    cell = density_box.box_model().cell
    on_modes = density_box._log_power(_MODES, cell).ravel()
    length = np.sqrt(density_box._k_squared(_MODES, cell)).ravel()
    edges = np.concatenate([[0.0], (np.arange(8) + 0.5) * 2 * np.pi / (_MODES * cell), np.geomspace(0.12, 1.3, 40)])
    place = np.digitize(length[1:], edges)
    number = np.maximum(np.bincount(place), 1)
    at, share = (np.bincount(place, value) / number for value in (length[1:], on_modes[1:]))
    is_filled = at > 0
    ratio = np.interp(k, at[is_filled], share[is_filled] / density_box.linear_power(at[is_filled]))
    nodes = np.geomspace(1e-3, 1.2, 40)
    ratio *= np.interp(k, nodes, convergence.window(cell, 1, nodes))
    return np.where(k < 1.2, density_box.linear_power(k) * ratio, 0.0)
