"""Lensing by matter that follows the structure below the cells of the box of simulated matter.

The lensing maps contain the matter of the box, whose density is constant within its cells. Halos are added to it, each
with an equal negative mass around it. Both leave out that the matter around halos clusters as they do, on scales
between the radius of a halo and a cell of the box. This module adds it. The density of matter follows the field G(x) of
`fine_structure`, so that its overdensity beyond that of the box, delta, is::

    delta_fine(x) = (1 + delta(x)) (exp(B G(x)) / <exp(B G)> - 1)

Its mean is 0. The amplitude B of matter is proportional to the linear growth, as its bias is 1.

Notes
-----
The convergence is summed along lines of sight through the pixels of a HEALPix map, which are kept by cell. It is then
interpolated on a square grid around the sources, where Fourier transforms give shear and deflection. The kernels of the
transforms reach only to an angle beyond which there is no lensing. The result at a source therefore does not depend on
the grid, except for the interpolation.

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
# Below this argument, the window of `_kernels` is computed from its series; the error is 1e-12.
_SERIES = 0.05
# Smallest window of the interpolation that `_kernels` corrects. Modes with a smaller one are close to the limit of the
# sampling.
_LEAST_WINDOW = 0.6


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
        Comoving distance, Mpc/h. Steps that end behind it are left out.

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
    # The next even number of nodes that has only small factors, with at least `reach` beyond the circle.
    side = scipy.fft.next_fast_len(2 * nodes + 2)
    side += side % 2
    axis = step * (np.arange(side) - side // 2)
    kappa = np.zeros((matter.planes.size, side, side))
    inside = np.hypot(axis[:, None], axis) < radius + reach
    kappa[:, inside] = _interpolate(matter, _directions(frame, *np.meshgrid(axis, axis))[:, inside])
    pixel = float(np.radians(np.sqrt(sky.cell_area(chosen.order))))
    modes = scipy.fft.rfft2(kappa)[:, None] * _kernels(side, step, reach, pixel)
    lensing = scipy.fft.irfft2(modes, (side, side))
    cut = slice(side // 2 - inner, side // 2 + inner + 1)
    return step, np.ascontiguousarray(np.moveaxis(lensing[:, :, cut, cut], 1, -1))


def _directions(frame: Float, x: Float, y: Float) -> Float:
    """Return the unit vectors, shape (3, ...), at positions in the stereographic projection (rad).

    `frame` has the unit vectors to the east, to the north and to the centre.
    """
    quarter = 0.25 * (x * x + y * y)
    east, north, along = x / (1.0 + quarter), y / (1.0 + quarter), (1.0 - quarter) / (1.0 + quarter)
    return np.asarray(np.stack([axis[0] * east + axis[1] * north + axis[2] * along for axis in frame.T]))


def _interpolate(matter: FineMatter, direction: Float) -> Float:
    """Return the convergence for sources on each plane, shape (p, n), in directions of shape (3, n).

    It is interpolated linearly between the pixels.
    """
    order = settings().order
    angle, turn = np.arccos(np.clip(direction[2], -1.0, 1.0)), np.arctan2(direction[1], direction[0])
    pixel, weight = hp.get_interp_weights(1 << order, angle, turn, nest=True)
    shift = 2 * (order - GENERATION_ORDER)
    cells, place = np.unique(pixel >> shift, return_inverse=True)
    kappa = np.stack([_cached_convergence(matter, cell) for cell in cells.tolist()], 1)
    values = kappa[:, place.reshape(pixel.shape), pixel & ((1 << shift) - 1)]
    return np.asarray(np.sum(values * weight, 1))


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
def _kernels(side: int, step: float, reach: float, pixel: float) -> Complex:
    """Return the factors by which modes of the convergence become those of the lensing, shape (5, side, side / 2 + 1).

    The five are kappa, gamma1, gamma2, and the deflection along x and y away from a mass. Every mass is compensated
    with the weight 3 (1 - (theta / reach)^2)^2 / (pi reach^2), so that there is no lensing at larger angles. The
    factors also restore what linear interpolation between pixels with the side `pixel` takes from the modes. `step`,
    `reach` and `pixel` are in rad.
    """
    y, x = 2.0 * np.pi * scipy.fft.fftfreq(side, step)[:, None], 2.0 * np.pi * scipy.fft.rfftfreq(side, step)
    square = x * x + y * y
    scaled = np.sqrt(square) * reach
    safe = np.maximum(scaled, _SERIES)
    # One minus the Fourier transform of the weight.
    missing = np.where(scaled < _SERIES, scaled**2 / 16.0, 1.0 - 48.0 * scipy.special.jv(3, safe) / safe**3)
    # At the highest frequency of an even number of nodes, the sign of a frequency is undefined.
    missing[side // 2], missing[:, -1] = 0.0, 0.0
    missing /= np.maximum(np.exp(-square * pixel**2 / 12.0), _LEAST_WINDOW)
    over = missing / np.where(square > 0.0, square, 1.0)
    factors = (missing, (x * x - y * y) * over, 2.0 * x * y * over, -2j * x * over, -2j * y * over)
    return np.asarray(np.stack(np.broadcast_arrays(*factors)))
