"""Light-cone through replicas of the box, and the voxels of a cell of the sky.

Each spherical shell, as deep as the side of the box, contains a rotated, mirrored and shifted replica, so that
structure does not repeat along a line of sight. Structure is discontinuous only where chi is a multiple of the side.
The seed determines the position of the observer in the box. Distances are comoving, in Mpc/h.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product

import healpy as hp
import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Bool, Float, Int
from truesky.catalogue.matter.density_box import Box
from truesky.fluxes import cosmology
from truesky.randomness.rng import stream

# Side of a HEALPix cell in units of 1 / nside (rad), and largest width of a voxel in units of a cell of the box.
_SIDE, _WIDEST = 1.023, 1.2
# Step of the table of redshifts, Mpc/h.
_CHI_STEP = 0.25


@dataclass(frozen=True, slots=True, eq=False)
class Replicas:
    """Rotation and shift of the box in each shell: the box position of x is sign[j] x[axes[j]] + shift[j] in shell j.

    Attributes
    ----------
    axes : int array, shape (shells, 3)
        Permutation of the axes.
    sign : float array, shape (shells, 3)
        1 or -1 for each axis.
    shift : float array, shape (shells, 3)
        Shift, Mpc/h.
    """

    axes: Int
    sign: Float
    shift: Float


@dataclass(frozen=True, slots=True, eq=False)
class Steps:
    """Radial steps; no step contains a multiple of the box's cell size inside.

    Attributes
    ----------
    edge : float array, shape (s + 1,)
        Edges, Mpc/h.
    z : float array, shape (s,)
        Redshift at the middle of each step.
    """

    edge: Float
    z: Float

    @property
    def middle(self) -> Float:
        """Return the middle of each step, Mpc/h."""
        return 0.5 * (self.edge[1:] + self.edge[:-1])

    @property
    def volume(self) -> Float:
        """Return the volume of each step in (Mpc/h)^3 per steradian."""
        return np.asarray((self.edge[1:] ** 3 - self.edge[:-1] ** 3) / 3.0)


@dataclass(frozen=True, slots=True, eq=False)
class Voxels:
    """Pieces of the volume of a cell of the sky.

    Attributes
    ----------
    step : int array, shape (v,)
        Radial step.
    order, cell : int array, shape (v,)
        Order and nested index of the HEALPix cell that bounds the voxel.
    box : int array, shape (v,)
        Flat cell of the box.
    velocity : float array, shape (v,)
        u along the line of sight, positive if receding, Mpc/h; times velocity_factor it is in km/s.
    """

    step: Int
    order: Int
    cell: Int
    box: Int
    velocity: Float


@dataclass(frozen=True, slots=True, eq=False)
class Distances:
    """Table of redshifts at uniform comoving distances from 0; z(chi) is accurate to 1e-8."""

    chi: Float
    z: Float

    def redshift(self, chi: npt.ArrayLike) -> Float:
        """Return the redshift of comoving distances in Mpc/h, which must be inside the table."""
        at = np.asarray(chi, float) / _CHI_STEP
        node = np.minimum(at.astype(np.int64), self.z.size - 2)
        low = self.z[node]
        return np.asarray(low + (at - node) * (self.z[node + 1] - low))


def distance_table(z_max: float) -> Distances:
    """Return the table of redshifts out to z_max or up to one step farther."""
    steps = int(np.ceil(float(cosmology.comoving_distance(z_max)) / _CHI_STEP))
    chi = np.asarray(_CHI_STEP * np.arange(steps + 1), float)
    return Distances(chi, cosmology.redshift(chi))


def draw_replicas(box: Box, chi_max: float) -> Replicas:
    """Return the replicas out to chi_max (Mpc/h) from the box's seed; the nearest replica is not rotated."""
    turns = [(axes, sign) for axes in permutations(range(3)) for sign in product((1.0, -1.0), repeat=3)]
    shells = int(chi_max // box.length) + 1
    chosen, shifts = [], []
    for shell in range(shells):
        # Each shell has a separate random stream, so that a deeper light-cone does not change the nearer shells.
        rng = stream(box.seed, "replica", shell)
        chosen.append(turns[int(rng.integers(len(turns)))] if shell else turns[0])
        shifts.append(box.length * rng.random(3))
    axes, sign = zip(*chosen, strict=True)
    return Replicas(np.array(axes), np.array(sign), np.array(shifts))


def box_cells(box: Box, replicas: Replicas, direction: Float, chi: Float) -> tuple[Int, Float]:
    """Return the cell of the box, and the direction in the frame of the box, at positions of the light-cone.

    Parameters
    ----------
    box : Box
        Matter in a box.
    replicas : Replicas
        Rotation of each replica.
    direction : float array, shape (n, 3)
        Unit vectors.
    chi : float or float array, shape (n,)
        Comoving distance, Mpc/h.

    Returns
    -------
    cell : int array, shape (n,)
        Flat cell of the box.
    direction : float array, shape (n, 3)
        Unit vectors in the frame of the box.
    """
    shell = np.broadcast_to(np.asarray(chi // box.length, np.int64), direction.shape[:1])
    box_direction = replicas.sign[shell] * np.take_along_axis(direction, replicas.axes[shell], 1)
    place = (box_direction * np.reshape(chi, (-1, 1)) + replicas.shift[shell]) / box.model.cell
    x, y, z = np.floor(place).astype(np.int64).T % box.n
    return (x * box.n + y) * box.n + z, box_direction


def radial_steps(cell: float, start: float, end: float, table: Distances) -> Steps:
    """Return radial steps with edges at multiples of the cell size.

    Parameters
    ----------
    cell : float
        Side of the box's cells, Mpc/h.
    start, end : float
        First and last edge, Mpc/h.
    table : Distances
        Table of redshifts.

    Returns
    -------
    Steps
        The steps.
    """
    inner = np.arange(np.floor(start / cell) + 1, np.ceil(end / cell)) * cell
    edge = np.concatenate([[start], inner, [end]])
    return Steps(edge, table.redshift(0.5 * (edge[1:] + edge[:-1])))


def voxels(box: Box, replicas: Replicas, steps: Steps, order: int, cell: int, used: Bool) -> Voxels:
    """Return the voxels of a cell of the sky, about 4 Mpc/h wide.

    Parameters
    ----------
    box : Box
        Matter in a box.
    replicas : Replicas
        Rotation of each replica.
    steps : Steps
        Steps along the line of sight.
    order, cell : int
        Order and nested index of the cell.
    used : bool array, shape (s,)
        True for the steps to divide.

    Returns
    -------
    Voxels
        The voxels, sorted by the order of their HEALPix cells, then by step.
    """
    min_order = np.ceil(np.log2(np.maximum(_SIDE * steps.middle / (_WIDEST * box.model.cell), 1.0)))
    orders = np.maximum(min_order.astype(np.int64), order)
    pieces: list[tuple[Int, Int, Int, Float]] = []
    for fine in np.unique(orders[used]).tolist():
        selected_steps = np.flatnonzero(used & (orders == fine))
        inside = (np.int64(cell) << 2 * (fine - order)) + np.arange(1 << 2 * (fine - order))
        step, sub = np.repeat(selected_steps, inside.size), np.tile(inside, selected_steps.size)
        vector = np.stack(hp.pix2vec(1 << fine, inside, nest=True), 1)
        pieces.append((step, np.full(step.size, fine), sub, np.tile(vector, (selected_steps.size, 1))))
    if not pieces:
        empty = np.zeros(0, np.int64)
        return Voxels(empty, empty, empty, empty, np.zeros(0))
    step, voxel_order, sub = (np.concatenate([piece[i] for piece in pieces]) for i in range(3))
    index, directions = box_cells(box, replicas, np.concatenate([piece[3] for piece in pieces]), steps.middle[step])
    velocity = np.sum([box.velocity[axis].ravel()[index] * directions[:, axis] for axis in range(3)], 0)
    return Voxels(step, voxel_order, sub, index, velocity)
