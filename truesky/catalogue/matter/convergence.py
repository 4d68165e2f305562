"""Lensing convergence by the simulated matter for sources at several distances, summed along straight lines of sight.

Notes
-----
Straight lines are the Born approximation. The density is constant within the cells of the box. If a pixel of the
lensing map is wider than a cell, the density is averaged over cubes of several cells. Both steps remove power on small
scales. The factors of `transfer` restore this power, but not the structure.

References
----------
Bartelmann & Schneider 2001, Phys. Rep. 340, 291, eq. 6.16 ff.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from functools import lru_cache
from itertools import groupby

import numpy as np

from lake_schema.arrays import Float, Float32, Int
from truesky.catalogue.matter import density_box, lightcone
from truesky.catalogue.matter.density_box import Box, BoxModel
from truesky.cosmology import HUBBLE_DISTANCE
from truesky.numerics import activity, matrices
from truesky.numerics.compiling import exact_jit

# Last redshift of the tables of distance and growth. It does not depend on the most distant sources, so that the
# convergence of nearer sources does not change with them.
_Z_LAST = 12.0
# Number of values of the linear growth D at which the power of the log-normal density relative to linear theory, and
# the factors that correct this power, are computed. Between these values of D, both are interpolated.
_GAIN_NODES = 9
# Number of multipoles above 32 at which the function `transfer` computes its factors; between them, the factors are
# interpolated.
_ELL_NODES = 60
# Number of bins of k for the power of the log-normal density.
_K_BINS = 24
# Number of wave numbers at which `window` is computed.
_K_NODES = 48
# Number of directions of the wave vector over which `window` is averaged.
_DIRECTIONS = 48
# Number of aliased images of the power spectrum on each side along each axis in `window`.
_IMAGES = 2
# Largest wave number at which `window` is computed, in units of the Nyquist wave number of the box.
_WINDOWS = 8.0
# Upper limit of the factors of `transfer`; they would be larger only for sources at z < 0.3.
_MAX_TRANSFER = 2.0
# Number of neighbouring pixels that are summed together: few enough that the cells of the box on their lines of sight
# stay in the processor's cache.
_PATCH_SIZE = 1024
# Number of patches of 1024 neighbouring pixels that a thread sums per task.
_PATCHES_PER_CALL = 48


@dataclass(frozen=True, slots=True, eq=False)
class Layers:
    """Spherical layers of matter around the observer, from near to far.

    Attributes
    ----------
    middle : float array, shape (s,)
        Comoving distance of the middle of the layer, Mpc/h.
    factor : int array, shape (s,)
        Number of box cells per side over which matter is averaged; also the thickness of the layer in cells.
    stretch : int array, shape (s,)
        Number of the stretch (interval of distance) of the layer. The averaged density is computed once per stretch.
    growth : float array, shape (s,)
        Linear growth D in the middle of the stretch, for which the averaged density is computed.
    growth_here : float array, shape (s,)
        Linear growth D in the middle of the layer.
    gain : float array, shape (s,)
        Factor by which the overdensity is multiplied to have the power of linear theory.
    weight : float array, shape (s,)
        Weight of the overdensity in the convergence, without the factor 1 - chi / (distance of the source).
    """

    middle: Float
    factor: Int
    stretch: Int
    growth: Float
    growth_here: Float
    gain: Float
    weight: Float

    def select(self, cut: slice) -> Layers:
        """Return the layers with the row numbers of a slice."""
        return Layers(*(getattr(self, field.name)[cut] for field in fields(self)))


def convergence(box: Box, direction: Float32, width: float, chi: Float, coarsest: int, stretch: float) -> Float32:
    """Compute the convergence of sources at several distances.

    Parameters
    ----------
    box : Box
        Periodic box of simulated matter.
    direction : float32 array, shape (3, n)
        Unit vectors of the lines of sight; n must be a multiple of 1024. It is faster if consecutive vectors are close
        to each other on the sky.
    width : float
        Width of a pixel, rad.
    chi : float array, shape (p,)
        Comoving distances of the sources, Mpc/h, ascending.
    coarsest : int
        Largest number of box cells per side over which matter is averaged.
    stretch : float
        Depth (Mpc/h) of the intervals of distance in which the averaged density is computed once; within an interval it
        is scaled by the linear growth.

    Returns
    -------
    float32 array, shape (p, n)
        Convergence kappa for each source distance and line of sight.

    Notes
    -----
    The convergence is::

        kappa = 3/2 Om (H0 / c)^2 int dchi' chi' (chi - chi') / chi (1 + z') delta
    """
    direction = np.ascontiguousarray(direction.reshape(3, -1, _PATCH_SIZE).swapaxes(0, 1))
    replicas = lightcone.draw_replicas(box, float(chi[-1]))
    slabs = layers(box, width, float(chi[-1]), coarsest, stretch)
    # Because kappa(chi) = sums[:, 0] - sums[:, 1] / chi, two sums along each line of sight are enough for all sources.
    sums = np.zeros((len(direction), 2, _PATCH_SIZE), np.float32)
    planes = np.empty((chi.size, len(direction), _PATCH_SIZE), np.float32)
    done = 0
    with ThreadPoolExecutor(min(os.cpu_count() or 1, 4)) as pool:

        @lru_cache(maxsize=1)
        def density(growth: float, factor: int) -> Float32:
            # Consecutive groups of layers often have the same density.
            return average_density(box, growth, factor, pool).ravel()

        groups = list(_group_layers(slabs, np.searchsorted(chi, slabs.middle)))
        for cut in activity.track(groups, "layer of the lensing matter"):
            while done < chi.size and chi[done] <= slabs.middle[cut.start]:
                planes[done] = sums[:, 0] - sums[:, 1] / np.float32(chi[done])
                done += 1
            group = slabs.select(cut)
            delta = density(float(group.growth[0]), int(group.factor[0]))
            _add_group(box, replicas, group, delta, direction, sums, pool)
    planes[done:] = sums[:, 0] - sums[:, 1] / chi[done:, None, None].astype(np.float32)
    return planes.reshape(chi.size, -1)


def layers(box: Box, width: float, max_distance: float, coarsest: int, stretch: float) -> Layers:
    """Divide the matter out to a distance into layers as thick as the cubes of cells over which it is averaged.

    Parameters
    ----------
    box : Box
        Periodic box of simulated matter.
    width : float
        Width of a pixel, rad.
    max_distance : float
        Comoving distance that the layers reach, Mpc/h.
    coarsest : int
        Largest number of box cells per side over which matter is averaged.
    stretch : float
        Depth (Mpc/h) of the intervals of distance in which the averaged density is computed once.

    Returns
    -------
    Layers
        The layers.
    """
    middle, factor, at = [], [], 0.0
    while at < max_distance:
        cells = min(1 << max(int(np.log2(max(width * at / box.model.cell, 1.0))), 0), coarsest)
        middle.append(at + 0.5 * cells * box.model.cell)
        factor.append(cells)
        at += cells * box.model.cell
    chi, thick = np.array(middle), np.array(factor)
    cosmology = box.model.cosmology
    table = lightcone.distance_table(cosmology, _Z_LAST)
    number = (chi / stretch).astype(np.int64)
    growth = cosmology.growth(table.redshift((number + 0.5) * stretch))
    z = table.redshift(chi)
    growth_here = cosmology.growth(z)
    nodes = np.linspace(float(cosmology.growth(table.z[-1])), 1.0, _GAIN_NODES)
    gain = np.interp(growth_here, nodes, density_box.matter_gain(box.model, nodes))
    weight = 1.5 * cosmology.omega_cold / HUBBLE_DISTANCE**2 * thick * box.model.cell * chi * (1.0 + z)
    return Layers(chi, thick, number, growth, growth_here, gain, weight)


def transfer(box: Box, width: float, chi: Float, l_max: int, coarsest: int, stretch: float) -> Float:
    """Return the factors by which the multipoles of the convergence get the power of linear theory.

    Parameters
    ----------
    box : Box
        Periodic box of simulated matter.
    width : float
        Width of a pixel, rad.
    chi : float array, shape (p,)
        Comoving distances of the sources, Mpc/h, ascending.
    l_max : int
        Highest multipole.
    coarsest : int
        Largest number of box cells per side over which matter is averaged.
    stretch : float
        Depth (Mpc/h) of the intervals of distance in which the averaged density is computed once.

    Returns
    -------
    float array, shape (p, l_max + 1)
        sqrt(C_l of linear theory / C_l of the simulated convergence) for each source distance, at most 2.

    Notes
    -----
    Both power spectra use Limber's approximation. It is accurate enough for the ratio, which is 1 for small l. The
    error of the power is 5 % for l < nside and z > 0.4 (tests).
    """
    slabs = layers(box, width, float(chi[-1]), coarsest, stretch)
    ell = np.unique(np.concatenate([np.arange(32), np.geomspace(32, l_max, _ELL_NODES).astype(int)]))
    k = (ell[:, None] + 0.5) / slabs.middle
    linear = density_box.linear_power(box.model.cosmology, k.ravel()).reshape(k.shape)
    box_power = linear * _sampled_power_ratio(box.model, slabs, k)
    rows = []
    for source_chi in chi:
        lens = slabs.weight * slabs.growth_here * np.maximum(1.0 - slabs.middle / source_chi, 0.0)
        share = lens**2 / (slabs.middle**2 * slabs.factor)
        ratio = np.sqrt(matrices.matmul(linear, share) / matrices.matmul(box_power, share))
        rows.append(np.interp(np.arange(l_max + 1), ell, np.minimum(ratio, _MAX_TRANSFER)))
    return np.array(rows)


def _sampled_power_ratio(model: BoxModel, slabs: Layers, k: Float) -> Float:
    """Return the power of the averaged density divided by the linear power.

    `k` (h/Mpc) and the result have the shape (l, s): l wave numbers for each of the s layers of `slabs`.
    """
    growths = np.linspace(float(slabs.growth_here.min()), 1.0, _GAIN_NODES)
    edges = np.linspace(0.0, np.pi / model.cell, _K_BINS + 1)
    at, share = density_box.linear_share(model, growths, edges)
    nodes = np.geomspace(1e-3, _WINDOWS * np.pi / model.cell, _K_NODES)
    ratio = np.empty(k.shape)
    for factor in np.unique(slabs.factor).tolist():
        selected = slabs.factor == factor
        ratio[:, selected] = np.interp(k[:, selected], nodes, window(model, factor, nodes))
    for s, growth_here in enumerate(slabs.growth_here):
        by_k = [np.interp(growth_here, growths, column) for column in share.T]
        ratio[:, s] *= slabs.gain[s] ** 2 * np.interp(k[:, s], at, by_k)
    return ratio


def window(model: BoxModel, factor: int, k: Float) -> Float:
    """Return the power of a density that is averaged over cubes of cells, relative to the linear power.

    Parameters
    ----------
    model : BoxModel
        Parameters of the box.
    factor : int
        Number of cells per side of a cube.
    k : float array, shape (n,)
        Wave number, h/Mpc.

    Returns
    -------
    float array, shape (n,)
        Ratio of the powers at each wave number, averaged over directions of the wave vector.

    Notes
    -----
    The density is constant within each cube, so the modes of the lattice of cells (up to its Nyquist wave number) also
    appear as aliased images at higher wave numbers. The ratio includes them.
    """
    cell, cosmology = model.cell, model.cosmology
    wide = cell * factor
    number = np.arange(_DIRECTIONS) + 0.5
    up, turn = 1.0 - 2.0 * number / _DIRECTIONS, np.pi * (1.0 + np.sqrt(5.0)) * number
    flat = np.sqrt(1.0 - up**2)
    direction = np.stack([flat * np.cos(turn), flat * np.sin(turn), up], 1)
    order = np.arange(-_IMAGES, _IMAGES + 1) * 2.0 * np.pi / wide
    image = np.stack(np.meshgrid(order, order, order, indexing="ij"), -1).reshape(-1, 3)
    ln_k = np.linspace(np.log(1e-4), np.log(np.sqrt(3.0) * np.pi / cell), 400)
    ln_power = np.log(density_box.linear_power(cosmology, np.exp(ln_k)))
    mean = np.empty(k.size)
    for i, size in enumerate(k):
        wave = size * direction
        source = wave[:, None] - image
        # np.sinc(x) is sin(pi x) / (pi x).
        average = np.sinc(source * wide / (2.0 * np.pi)) / np.sinc(source * cell / (2.0 * np.pi))
        length = np.sqrt((source**2).sum(-1))
        in_lattice = np.all(np.abs(source) < np.pi / cell, -1)
        power = np.where(in_lattice, np.exp(np.interp(np.log(np.maximum(length, 1e-4)), ln_k, ln_power)), 0.0)
        damping = np.prod(np.sinc(wave * wide / (2.0 * np.pi)) ** 2, -1)
        mean[i] = np.mean(damping * np.sum(power * np.prod(average**2, -1), 1))
    return mean / density_box.linear_power(cosmology, k)


def average_density(box: Box, growth: float, factor: int, pool: ThreadPoolExecutor) -> Float32:
    """Return the matter overdensity, averaged over cubes of cells of the box.

    Parameters
    ----------
    box : Box
        Periodic box of simulated matter with n^3 cells.
    growth : float
        Linear growth D, 1 at z = 0.
    factor : int
        Number of cells per side of a cube, which should divide n.
    pool : ThreadPoolExecutor
        Threads that share the work.

    Returns
    -------
    float32 array, shape (n / factor, n / factor, n / factor)
        Mean overdensity of each cube.
    """
    n = box.n // factor
    mean = np.empty((n, n, n), np.float32)
    offset = np.float32(0.5 * growth**2 * box.variance[0])

    def slab(x: int) -> None:
        delta = np.expm1(np.float32(growth) * box.smoothed[0][x * factor : (x + 1) * factor] - offset)
        # Adding whole rows is faster than numpy's mean over several axes.
        rows = delta.sum(0) if factor > 1 else delta[0]
        rows = sum((rows[y::factor] for y in range(1, factor)), rows[::factor])
        mean[x] = sum((rows[:, z::factor] for z in range(1, factor)), rows[:, ::factor]) / np.float32(factor**3)

    list(pool.map(slab, range(n)))
    return mean


def _group_layers(slabs: Layers, plane: Int) -> Iterator[slice]:
    """Yield slices of consecutive layers that have the same averaged density and the same sources behind them.

    Layers have the same averaged density if they are in the same stretch (interval of distance) and matter is averaged
    over cubes of the same size. `plane` is the number of source distances that are nearer than each layer.
    """
    same = zip(slabs.stretch.tolist(), slabs.factor.tolist(), plane.tolist(), strict=True)
    at = 0
    for _, group in groupby(same):
        size = sum(1 for _ in group)
        yield slice(at, at + size)
        at += size


def _add_group(
    box: Box,
    replicas: lightcone.Replicas,
    slabs: Layers,
    delta: Float32,
    direction: Float32,
    sums: Float32,
    pool: ThreadPoolExecutor,
) -> None:
    """Add consecutive layers to the sums from which the convergence follows; `sums` is changed in place.

    The layers must have the same averaged density `delta`. `direction`, `delta` and `sums` have the shapes of
    `add_layers`.
    """
    factor = int(slabs.factor[0])
    shell = (slabs.middle // box.length).astype(np.int64)
    scale = (replicas.sign[shell] * (slabs.middle / box.length)[:, None]).astype(np.float32)
    shift = (replicas.shift[shell] / box.length).astype(np.float32)
    axes = replicas.axes[shell]
    weight = slabs.weight * slabs.gain * slabs.growth_here / slabs.growth
    weights = np.stack([weight, weight * slabs.middle]).astype(np.float32)

    def add_patches(first: int) -> None:
        cut = slice(first, first + _PATCHES_PER_CALL)
        add_layers(direction[cut], delta, box.n // factor, axes, scale, shift, weights, sums[cut])

    list(pool.map(add_patches, range(0, len(direction), _PATCHES_PER_CALL)))


@exact_jit
def add_layers(
    direction: Float32,
    delta: Float32,
    n: int,
    axes: Int,
    scale: Float32,
    shift: Float32,
    weights: Float32,
    sums: Float32,
) -> None:
    """Add the weighted overdensity of several layers along lines of sight to two sums per line of sight.

    Parameters
    ----------
    direction : float32 array, shape (patches, 3, p)
        Unit vectors of the lines of sight, in patches of p neighbours.
    delta : float32 array, shape (n^3,)
        Overdensity in cubes of the periodic box.
    n : int
        Number of cubes per side of the box.
    axes : int array, shape (s, 3)
        Permutation of the axes between the sky and the box for each layer.
    scale, shift : float32 array, shape (s, 3)
        Position in the box in units of its side = direction[axes] * scale + shift, modulo 1.
    weights : float32 array, shape (2, s)
        Weights of each layer in the first and in the second sum.
    sums : float32 array, shape (patches, 2, p)
        Sums, changed in place.

    Notes
    -----
    For k = 0 and 1, the sum k of a line of sight increases by weights[k, s] times the overdensity at its position in
    layer s, for all layers.
    """
    pixels = direction.shape[2]
    index = np.empty(pixels, np.int64)
    for patch in range(direction.shape[0]):
        first, second = sums[patch, 0], sums[patch, 1]
        for s in range(weights.shape[1]):
            along_x, along_y, along_z = (
                direction[patch, axes[s, 0]],
                direction[patch, axes[s, 1]],
                direction[patch, axes[s, 2]],
            )
            scale_x, scale_y, scale_z = scale[s]
            shift_x, shift_y, shift_z = shift[s]
            for p in range(pixels):
                x = along_x[p] * scale_x + shift_x
                y = along_y[p] * scale_y + shift_y
                z = along_z[p] * scale_z + shift_z
                x, y, z = x - np.floor(x), y - np.floor(y), z - np.floor(z)
                # In single precision, x - floor(x) can be exactly 1 if x is slightly below 0: limit the index to the
                # last cell.
                i, j, k = min(int(x * n), n - 1), min(int(y * n), n - 1), min(int(z * n), n - 1)
                index[p] = (i * n + j) * n + k
            first_weight, second_weight = weights[0, s], weights[1, s]
            for p in range(pixels):
                density = delta[index[p]]
                first[p] += first_weight * density
                second[p] += second_weight * density
