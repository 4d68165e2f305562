"""Lensing by the matter around halos, which follows the structure below the cells of the box of simulated matter.

The lensing maps contain the matter of the box, whose density is constant within its cells. Halos are added to it, each
with an equal negative mass around it. Both leave out that matter clusters on scales between the radius of a halo and a
cell of the box. This module adds it. The density follows the field G(x) of `fine_structure`: the overdensity that is
added to delta, the overdensity of the box, is::

    delta_fine(x) = (1 + delta(x)) (exp(B G(x)) / <exp(B G)> - 1)

Its mean is 0. B is proportional to the linear growth. The factor is fitted: with it, xi+ and xi- of sources at z = 1
agree with non-linear theory in the default cosmology. B is larger than for halos of bias 1, because it makes up for
halos that are too light to lens, and for the negative mass around halos. The matter of halos that lens is included.

Notes
-----
The convergence is summed along straight lines of sight through the pixels of a HEALPix map, which are kept by cell. It
is then spread on a square grid around the sources, where Fourier transforms give shear and deflection. Their kernels
end at an angle beyond which there is no lensing, so the result at a source does not depend on the grid, except for the
interpolation. This angle removes most of the lensing by matter at z < 0.4.

References
----------
Bartelmann & Schneider 2001, Phys. Rep. 340, 291, eqs. 3.10 and 6.16 ff.; Kaiser & Squires 1993, ApJ 404, 441
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import scipy

from lake_schema import sky
from lake_schema.arrays import Complex, Float, Int
from lake_schema.ids import GENERATION_ORDER
from lake_schema.lazy_healpy import healpy as hp
from truesky.catalogue import parameters
from truesky.catalogue.matter import compiled_fine_structure as compiled
from truesky.catalogue.matter import fine_structure
from truesky.catalogue.matter.density_box import Box
from truesky.catalogue.matter.fine_structure import FineStructure
from truesky.catalogue.matter.lightcone import Replicas, Steps
from truesky.cosmology import HUBBLE_DISTANCE

# Largest number of order-8 cells whose convergence is kept in memory, 6 KB each.
_MAX_CACHED_CELLS = 4096
# Below this argument, `_missing` is computed from its series; the relative error of both is below 1e-9.
_SERIES = 0.05
# Radius within which the convergence of a pixel is spread over the nodes, in units of the side of a pixel.
_SPREAD = 1.5
# `_kernels` corrects the window w of this spreading by w / (w^2 + this number), so that it amplifies no mode more than
# 1.7 times.
_LEAST_POWER = 0.1
# Smallest sum of weights by which a node is divided; only nodes without pixels nearby have less.
_LEAST_WEIGHT = 0.1


@dataclass(frozen=True, slots=True)
class Parameters:
    """Amplitude and sampling of the matter; explained in fine_structure.toml, [matter]. Angles are in arcmin."""

    amplitude: float
    order: int
    step: float
    reach: float


@dataclass(frozen=True, slots=True, eq=False)
class Points:
    """Points along a line of sight at which the density is evaluated, shape (s,) each.

    Attributes
    ----------
    chi : float array
        Comoving distances, Mpc/h, ascending.
    growth : float array
        Linear growth D, 1 at z = 0.
    amplitude, log_norm : float array
        B and ln <exp(B G)>.
    weight : float array
        Weight of the overdensity in the convergence, without the factor 1 - chi / (distance of the source).
    """

    chi: Float
    growth: Float
    amplitude: Float
    log_norm: Float
    weight: Float


@dataclass(frozen=True, slots=True, eq=False)
class FineMatter:
    """Matter that follows the structure below the cells of the box, and its convergence where it is already known.

    Attributes
    ----------
    box : Box
        Periodic box of simulated matter.
    replicas : Replicas
        Rotation and shift of the box in each shell.
    structure : FineStructure
        Field G(x).
    points : Points
        Points along each line of sight.
    planes : float array, shape (p,)
        Inverse comoving distances of the sources, ascending from 0 (infinity), h/Mpc.
    by_cell : OrderedDict
        Convergence in the pixels of order-8 cells, shape (p, pixels), by nested index of the cell.
    """

    box: Box
    replicas: Replicas
    structure: FineStructure
    points: Points
    planes: Float
    by_cell: OrderedDict[int, Float] = field(default_factory=OrderedDict)


def settings() -> Parameters:
    """Return the built-in amplitude and sampling of the matter."""
    return Parameters(**parameters.section("fine_structure.toml", "matter"))


def points(box: Box, steps: Steps, structure: FineStructure, max_distance: float) -> Points:
    """Return the points at which matter nearer than a distance is evaluated: two per step in distance.

    Parameters
    ----------
    box : Box
        Periodic box of simulated matter.
    steps : Steps
        Steps in comoving distance.
    structure : FineStructure
        Structure of a seed.
    max_distance : float
        Comoving distance, Mpc/h. Steps that end beyond it are left out.

    Returns
    -------
    Points
        The points.
    """
    chosen, cosmology = settings(), box.model.cosmology
    used = np.flatnonzero(steps.edge[1:] <= max_distance)
    chi = fine_structure.distance_at(steps, used, np.array([[0.25], [0.75]])).T.ravel()
    depth, z = (np.repeat(values[used], 2) for values in (0.5 * np.diff(steps.edge), steps.z))
    growth = cosmology.growth(z)
    amplitude = chosen.amplitude * growth
    log_norm = np.log(fine_structure.mean_exponential(structure.scatter, amplitude))
    weight = 1.5 * cosmology.omega_cold / HUBBLE_DISTANCE**2 * depth * chi * (1.0 + z)
    return Points(chi, growth, amplitude, log_norm, weight)


def convergence(matter: FineMatter, pixel: Int) -> Float:
    """Return the convergence by the fine structure of matter along lines of sight.

    Parameters
    ----------
    matter : FineMatter
        The matter.
    pixel : int array, shape (n,)
        Nested indices of the HEALPix pixels (of the order in `settings`) through whose centres the lines of sight run.

    Returns
    -------
    float array, shape (p, n)
        Convergence of sources on each of the planes.
    """
    at, box, replicas = matter.points, matter.box, matter.replicas
    direction = np.stack(hp.pix2vec(1 << settings().order, pixel, nest=True))
    shape = (at.chi.size, pixel.size)
    vector = np.ascontiguousarray(np.broadcast_to(direction[:, None], (3, *shape))).reshape(3, -1)
    value = fine_structure.values(matter.structure, vector, np.repeat(at.chi, pixel.size)).reshape(shape)
    shell = (at.chi // box.length).astype(np.int64)
    frames = replicas.axes[shell], replicas.sign[shell], replicas.shift[shell] / box.length
    out = np.empty((matter.planes.size, pixel.size))
    compiled.sum_matter(
        direction,
        value,
        (box.smoothed[0].ravel(), box.n, box.length, float(box.variance[0])),
        frames,
        (at.chi, at.growth, at.amplitude, at.log_norm, at.weight),
        matter.planes,
        out,
    )
    return out


def lensing_grid(matter: FineMatter, frame: Float, radius: float) -> tuple[float, Float]:
    """Return the lensing by the fine structure of matter on a square grid.

    Parameters
    ----------
    matter : FineMatter
        The matter; the convergence in cells that are new is added to `matter.by_cell`.
    frame : float array, shape (3, 3)
        Unit vectors to the east, to the north and to the centre of the grid, which is in the stereographic projection
        around the centre.
    radius : float
        Radius of the circle around the centre in which lensing is needed, rad.

    Returns
    -------
    step : float
        Distance between nodes, rad.
    lensing : float array, shape (p, side, side, 5)
        kappa, gamma1, gamma2, deflection to the east and north (rad) for sources on each plane, by y and x. The centre
        is the node in the middle. Values outside the circle are wrong.
    """
    chosen = settings()
    step, reach = (np.radians(angle / 60.0) for angle in (chosen.step, chosen.reach))
    inner = int(np.ceil(radius / step))
    nodes = inner + int(np.ceil(reach / step))
    # An even number of nodes with at least `reach` beyond the circle, for which the transform is fast.
    side = 2 * scipy.fft.next_fast_len(nodes + 1)
    spread = _SPREAD * float(np.radians(np.sqrt(sky.cell_area(chosen.order))))
    kappa = _on_grid(matter, frame, (side, step, radius + reach), spread)
    modes = scipy.fft.rfft2(kappa)[:, None] * _kernels(side, step, reach, spread)
    lensing = scipy.fft.irfft2(modes, (side, side))
    cut = slice(side // 2 - inner, side // 2 + inner + 1)
    return step, np.ascontiguousarray(np.moveaxis(lensing[:, :, cut, cut], 1, -1))


def _on_grid(matter: FineMatter, frame: Float, grid: tuple[int, float, float], spread: float) -> Float:
    """Return the convergence for sources on each plane at the nodes of a square grid, shape (p, side, side).

    `grid` has the number of nodes per side, the distance between them, and the radius (rad) of the circle around the
    centre outside which the result is incomplete. `frame` has the unit vectors to the east, to the north and to the
    centre. The convergence of a pixel is spread within the angle `spread` (rad), and nodes have weighted means.
    """
    side, step, radius = grid
    x, y, z = frame[2]
    centre = np.degrees(np.arctan2(y, x)), np.degrees(np.arctan2(z, np.hypot(x, y)))
    cells = sky.cells_in_cone(*centre, np.degrees(radius + spread), GENERATION_ORDER).tolist()
    children = 1 << 2 * (settings().order - GENERATION_ORDER)
    pixel = (np.array(cells, np.int64)[:, None] * children + np.arange(children)).ravel()
    direction = np.stack(hp.pix2vec(1 << settings().order, pixel, nest=True), 1)
    east, north, along = (np.sum(direction * axis, -1) for axis in frame)
    place = np.stack([east, north]) * (2.0 / (1.0 + along))
    kappa = np.concatenate([_cached_convergence(matter, cell) for cell in cells], 1)
    total = np.zeros((kappa.shape[0] + 1, side, side))
    compiled.spread_pixels(place, np.ascontiguousarray(kappa.T), step, spread, total)
    return np.asarray(total[:-1] / np.maximum(total[-1], _LEAST_WEIGHT))


def _cached_convergence(matter: FineMatter, cell: int) -> Float:
    """Return the convergence in the pixels of an order-8 cell for sources on each plane, shape (p, pixels)."""
    cache, children = matter.by_cell, 1 << 2 * (settings().order - GENERATION_ORDER)
    if cell not in cache:
        cache[cell] = convergence(matter, np.int64(cell) * children + np.arange(children))
        if len(cache) > _MAX_CACHED_CELLS:
            cache.popitem(last=False)
    cache.move_to_end(cell)
    return cache[cell]


@lru_cache(maxsize=4)
def _kernels(side: int, step: float, reach: float, spread: float) -> Complex:
    """Return the factors by which modes of the convergence become those of the lensing, shape (5, side, side / 2 + 1).

    The five are kappa, gamma1, gamma2, and the deflection along x and y away from a mass. Every mass is compensated
    with the weight 3 (1 - (theta / reach)^2)^2 / (pi reach^2), so that there is no lensing at larger angles. The
    factors also correct for the attenuation by a spreading with the same weight and the radius `spread`; 0 if there is
    none. `step`, `reach` and `spread` are in rad.
    """
    y, x = 2.0 * np.pi * scipy.fft.fftfreq(side, step)[:, None], 2.0 * np.pi * scipy.fft.rfftfreq(side, step)
    square = x * x + y * y
    window = 1.0 - _missing(np.sqrt(square) * spread)
    missing = _missing(np.sqrt(square) * reach) * (1.0 + _LEAST_POWER) * window / (window**2 + _LEAST_POWER)
    # At the highest frequency of an even number of nodes, the sign of a frequency is undefined.
    missing[side // 2], missing[:, -1] = 0.0, 0.0
    over = missing / np.where(square > 0.0, square, 1.0)
    factors = (missing, (x * x - y * y) * over, 2.0 * x * y * over, -2j * x * over, -2j * y * over)
    return np.asarray(np.stack(np.broadcast_arrays(*factors)))


def _missing(scaled: Float) -> Float:
    """Return 1 minus the Fourier transform of the weight 3 (1 - r^2)^2 / pi within r < 1, at wave numbers `scaled`."""
    safe = np.maximum(scaled, _SERIES)
    series = scaled**2 / 16.0 - scaled**4 / 640.0
    return np.asarray(np.where(scaled < _SERIES, series, 1.0 - 48.0 * scipy.special.jv(3, safe) / safe**3))
