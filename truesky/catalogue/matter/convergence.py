"""Convergence of the box's matter on source planes, summed along straight lines of sight.

Notes
-----
This is the Born approximation. Matter is constant within the cells of the box, or within cubes of several cells if a
pixel is that wide. This removes power at the scales of cells. `transfer` restores the power, but not the structure.

References
----------
Bartelmann & Schneider 2001, Phys. Rep. 340, 291, eq. 6.16 ff.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from itertools import groupby

import numpy as np

from lake_schema.arrays import Float, Float32, Int
from truesky.catalogue.matter import density_box, lightcone
from truesky.catalogue.matter.density_box import Box, BoxModel
from truesky.fluxes import cosmology
from truesky.numerics import matrices
from truesky.numerics.compiling import exact_jit

# Redshift limit of the tables. It does not depend on the last plane, so that nearer planes do not change with it.
_Z_LAST = 12.0
_GAIN_NODES, _ELL_NODES, _K_BINS, _K_NODES = 9, 60, 24, 48
# Number of directions for the average of the window, number of images per side, and the range of its nodes in units of
# the highest k.
_DIRECTIONS, _IMAGES, _WINDOWS = 48, 2, 8.0
# Upper limit of the transfer in amplitude; more power is missing only for sources at z < 0.3.
_MAX_TRANSFER = 2.0
# Number of pixels per patch: few enough that the cells of the box that they share stay in the processor's cache.
_PATCH_SIZE = 1024
# Number of patches per task of a thread.
_PATCHES_PER_CALL = 48


@dataclass(frozen=True, slots=True, eq=False)
class Layers:
    """Layers of matter from near to far.

    Attributes
    ----------
    middle : float array, shape (s,)
        Distance of the middle, Mpc/h.
    factor : int array, shape (s,)
        Number of box cells per side over which matter is averaged.
    stretch : int array, shape (s,)
        Number of the stretch; matter within a stretch uses the same growth.
    growth : float array, shape (s,)
        Growth D for which the matter is averaged.
    growth_here : float array, shape (s,)
        Growth D at the layer.
    gain : float array, shape (s,)
        Factor that gives delta the power of linear theory.
    weight : float array, shape (s,)
        Weight of linear delta / D in the convergence, without the factors of the source distance.
    """

    middle: Float
    factor: Int
    stretch: Int
    growth: Float
    growth_here: Float
    gain: Float
    weight: Float

    def select(self, cut: slice) -> Layers:
        """Return the layers of a slice."""
        return Layers(*(getattr(self, field.name)[cut] for field in fields(self)))


def convergence(box: Box, direction: Float32, width: float, chi: Float, coarsest: int, stretch: float) -> Float32:
    """Compute the convergence of sources at several distances.

    Parameters
    ----------
    box : Box
        Matter in a box.
    direction : float32 array, shape (3, n)
        Unit vectors, with neighbours close to each other; n is a multiple of 1024.
    width : float
        Width of a pixel, rad.
    chi : float array, shape (p,)
        Comoving distances of the sources, Mpc/h, ascending.
    coarsest : int
        Largest number of cells per side over which matter is averaged.
    stretch : float
        Depth in Mpc/h within which the growth is linear.

    Returns
    -------
    float32 array, shape (p, n)
        Convergence.

    Notes
    -----
    The convergence is::

        kappa = 3/2 Om (H0 / c)^2 int dchi' chi' (chi - chi') / chi (1 + z') delta
    """
    direction = np.ascontiguousarray(direction.reshape(3, -1, _PATCH_SIZE).swapaxes(0, 1))
    replicas = lightcone.draw_replicas(box, float(chi[-1]))
    slabs = layers(box, width, float(chi[-1]), coarsest, stretch)
    # Because kappa(chi) = first - second / chi, two sums are enough for all planes.
    sums = np.zeros((len(direction), 2, _PATCH_SIZE), np.float32)
    planes = np.empty((chi.size, len(direction), _PATCH_SIZE), np.float32)
    done = 0
    with ThreadPoolExecutor(min(os.cpu_count() or 1, 4)) as pool:
        for cut in _group_layers(slabs, np.searchsorted(chi, slabs.middle)):
            while done < chi.size and chi[done] <= slabs.middle[cut.start]:
                planes[done] = sums[:, 0] - sums[:, 1] / np.float32(chi[done])
                done += 1
            _add_group(box, replicas, slabs.select(cut), direction, sums, pool)
    planes[done:] = sums[:, 0] - sums[:, 1] / chi[done:, None, None].astype(np.float32)
    return planes.reshape(chi.size, -1)


def layers(box: Box, width: float, max_distance: float, coarsest: int, stretch: float) -> Layers:
    """Return layers as thick as the cubes of cells over which a pixel is averaged.

    Parameters
    ----------
    box : Box
        Matter in a box.
    width : float
        Width of a pixel, rad.
    max_distance : float
        Distance of the last layer, Mpc/h.
    coarsest : int
        Largest number of cells per side over which matter is averaged.
    stretch : float
        Depth in Mpc/h within which the growth is linear.

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
    table = lightcone.distance_table(_Z_LAST)
    number = (chi / stretch).astype(np.int64)
    growth = density_box.growth(table.redshift((number + 0.5) * stretch))
    z = table.redshift(chi)
    growth_here = density_box.growth(z)
    nodes = np.linspace(float(density_box.growth(table.z[-1])), 1.0, _GAIN_NODES)
    gain = np.interp(growth_here, nodes, density_box.matter_gain(box.model, nodes))
    weight = 1.5 * cosmology.OMEGA_M / cosmology.HUBBLE_DISTANCE**2 * thick * box.model.cell * chi * (1.0 + z)
    return Layers(chi, thick, number, growth, growth_here, gain, weight)


def transfer(box: Box, width: float, chi: Float, l_max: int, coarsest: int, stretch: float) -> Float:
    """Return the factor that gives the multipoles of the convergence the power of linear theory.

    Parameters
    ----------
    box : Box
        Matter in a box.
    width : float
        Width of a pixel, rad.
    chi : float array, shape (p,)
        Comoving distances of the sources, Mpc/h, ascending.
    l_max : int
        Highest multipole.
    coarsest : int
        Largest number of cells per side over which matter is averaged.
    stretch : float
        Depth in Mpc/h within which the growth is linear.

    Returns
    -------
    float array, shape (p, l_max + 1)
        sqrt(C_l of linear theory / C_l of the box), at most 2.

    Notes
    -----
    Both power spectra use Limber's approximation. It is accurate enough for the ratio, which is 1 for small l. The
    error of the power is 5 % for l < nside and z > 0.4 (tests).
    """
    slabs = layers(box, width, float(chi[-1]), coarsest, stretch)
    ell = np.unique(np.concatenate([np.arange(32), np.geomspace(32, l_max, _ELL_NODES).astype(int)]))
    k = (ell[:, None] + 0.5) / slabs.middle
    linear = density_box.linear_power(k.ravel()).reshape(k.shape)
    box_power = linear * _sampled_power_ratio(box.model, slabs, k)
    rows = []
    for source_chi in chi:
        lens = slabs.weight * slabs.growth_here * np.maximum(1.0 - slabs.middle / source_chi, 0.0)
        share = lens**2 / (slabs.middle**2 * slabs.factor)
        ratio = np.sqrt(matrices.matmul(linear, share) / matrices.matmul(box_power, share))
        rows.append(np.interp(np.arange(l_max + 1), ell, np.minimum(ratio, _MAX_TRANSFER)))
    return np.array(rows)


def _sampled_power_ratio(model: BoxModel, slabs: Layers, k: Float) -> Float:
    """Power of the matter along lines of sight / linear power, shape (l, s)."""
    growths = np.linspace(float(slabs.growth_here.min()), 1.0, _GAIN_NODES)
    edges = np.linspace(0.0, np.pi / model.cell, _K_BINS + 1)
    at, share = density_box.linear_share(model, growths, edges)
    nodes = np.geomspace(1e-3, _WINDOWS * np.pi / model.cell, _K_NODES)
    ratio = np.empty(k.shape)
    for factor in np.unique(slabs.factor).tolist():
        selected = slabs.factor == factor
        ratio[:, selected] = np.interp(k[:, selected], nodes, window(model.cell, factor, nodes))
    for s, growth_here in enumerate(slabs.growth_here):
        by_k = [np.interp(growth_here, growths, column) for column in share.T]
        ratio[:, s] *= slabs.gain[s] ** 2 * np.interp(k[:, s], at, by_k)
    return ratio


def window(cell: float, factor: int, k: Float) -> Float:
    """Return the power of matter that is averaged over cubes of cells and constant within them / linear power.

    Parameters
    ----------
    cell : float
        Side of a cell, Mpc/h.
    factor : int
        Number of cells per side of a cube.
    k : float array, shape (n,)
        Wave number, h/Mpc.

    Returns
    -------
    float array, shape (n,)
        Ratio of the powers, averaged over directions.

    Notes
    -----
    The power contains modes up to the highest of the lattice of cells, and their images, which constant cubes produce.
    """
    wide = cell * factor
    number = np.arange(_DIRECTIONS) + 0.5
    up, turn = 1.0 - 2.0 * number / _DIRECTIONS, np.pi * (1.0 + np.sqrt(5.0)) * number
    flat = np.sqrt(1.0 - up**2)
    direction = np.stack([flat * np.cos(turn), flat * np.sin(turn), up], 1)
    order = np.arange(-_IMAGES, _IMAGES + 1) * 2.0 * np.pi / wide
    image = np.stack(np.meshgrid(order, order, order, indexing="ij"), -1).reshape(-1, 3)
    ln_k = np.linspace(np.log(1e-4), np.log(np.sqrt(3.0) * np.pi / cell), 400)
    ln_power = np.log(density_box.linear_power(np.exp(ln_k)))
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
    return mean / density_box.linear_power(k)


def average_density(box: Box, growth: float, factor: int, pool: ThreadPoolExecutor) -> Float32:
    """Return the matter overdensity in cubes of cells.

    Parameters
    ----------
    box : Box
        Matter in a box of n^3 cells.
    growth : float
        Growth of the linear density, 1 today.
    factor : int
        Number of cells per side of a cube.
    pool : ThreadPoolExecutor
        Threads that share the work.

    Returns
    -------
    float32 array, shape (n / factor, n / factor, n / factor)
        Overdensity.
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
    """Yield slices of layers that share their matter and the planes behind them."""
    same = zip(slabs.stretch.tolist(), slabs.factor.tolist(), plane.tolist(), strict=True)
    at = 0
    for _, group in groupby(same):
        size = sum(1 for _ in group)
        yield slice(at, at + size)
        at += size


def _add_group(
    box: Box, replicas: lightcone.Replicas, slabs: Layers, direction: Float32, sums: Float32, pool: ThreadPoolExecutor
) -> None:
    """Add layers of the same growth and factor to both sums."""
    factor = int(slabs.factor[0])
    delta = average_density(box, float(slabs.growth[0]), factor, pool).ravel()
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
    """Add the weighted matter along lines of sight to the sums.

    Parameters
    ----------
    direction : float32 array, shape (patches, 3, p)
        Unit vectors.
    delta : float32 array, shape (n^3,)
        Overdensity of the periodic box.
    n : int
        Number of cubes per side of the box.
    axes : int array, shape (s, 3)
        Axes of the direction in the frame of the box.
    scale, shift : float32 array, shape (s, 3)
        Position in units of the box = direction[axes] scale + shift.
    weights : float32 array, shape (2, s)
        Weights of the layers in both sums.
    sums : float32 array, shape (patches, 2, p)
        Sums, changed in place.

    Notes
    -----
    For both k, sums[:, k, p] increases by the sum over layers s of weights[k, s] delta(cell of line of sight p in layer
    s).
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
