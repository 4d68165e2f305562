"""Light-cone through copies of the box of simulated matter, and its division into voxels (small pieces of volume).

Space around the observer is divided into spherical shells, as deep as the side of the box. In each shell the periodic
box is rotated, mirrored and shifted in another way (a replica), so that structure does not repeat along a line of
sight. Structure is discontinuous only at the edges of the shells. The seed determines the position of the observer in
the box. Distances are comoving, in Mpc/h.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Bool, Float, Int
from lake_schema.lazy_healpy import healpy as hp
from truesky.catalogue.matter.density_box import Box
from truesky.cosmology import Cosmology
from truesky.randomness.rng import stream

# Side of a HEALPix cell in rad, times nside.
_SIDE = 1.023
# Largest width of a voxel across the line of sight, in units of a cell of the box.
_WIDEST = 1.2
# Step in distance of the table of redshifts, Mpc/h.
_CHI_STEP = 0.25


@dataclass(frozen=True, slots=True, eq=False)
class Replicas:
    """Rotation and shift of the box in each spherical shell.

    The position x relative to the observer in shell j is at sign[j] x[axes[j]] + shift[j] in the periodic box.

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
    """Steps in comoving distance; multiples of the cell size of the box are always edges.

    Attributes
    ----------
    edge : float array, shape (s + 1,)
        Edges of the steps, ascending, Mpc/h.
    z : float array, shape (s,)
        Redshift at the middle of each step.
    """

    edge: Float
    z: Float

    @property
    def middle(self) -> Float:
        """Return the comoving distance of the middle of each step, shape (s,), Mpc/h."""
        return 0.5 * (self.edge[1:] + self.edge[:-1])

    @property
    def volume(self) -> Float:
        """Return the comoving volume of each step per solid angle, shape (s,), (Mpc/h)^3 per steradian."""
        return np.asarray((self.edge[1:] ** 3 - self.edge[:-1] ** 3) / 3.0)


@dataclass(frozen=True, slots=True, eq=False)
class Voxels:
    """Small pieces of the light-cone in a sky cell: the volume of a smaller HEALPix cell in one step in distance.

    Attributes
    ----------
    step : int array, shape (v,)
        Number of the step in distance.
    order, cell : int array, shape (v,)
        Order and nested index of the HEALPix cell that bounds the voxel on the sky.
    box : int array, shape (v,)
        Flat index of the cell of the box that contains the centre of the voxel.
    velocity : float array, shape (v,)
        Component of `Box.velocity` along the line of sight, positive if receding, Mpc/h. Multiplied by
        `density_box.velocity_factor` it is in km/s.
    """

    step: Int
    order: Int
    cell: Int
    box: Int
    velocity: Float


@dataclass(frozen=True, slots=True, eq=False)
class Distances:
    """Table of redshifts z at comoving distances chi (Mpc/h), which start at 0 and have a constant step.

    Interpolated redshifts are accurate to 1e-8.
    """

    chi: Float
    z: Float

    def redshift(self, chi: npt.ArrayLike) -> Float:
        """Return the redshifts of comoving distances in Mpc/h, which must be inside the table; nothing is checked."""
        at = np.asarray(chi, float) / _CHI_STEP
        node = np.minimum(at.astype(np.int64), self.z.size - 2)
        low = self.z[node]
        return np.asarray(low + (at - node) * (self.z[node + 1] - low))


def distance_table(cosmology: Cosmology, z_max: float) -> Distances:
    """Return the table of redshift by comoving distance from 0 to z_max, or up to one step farther."""
    steps = int(np.ceil(float(cosmology.comoving_distance(z_max)) / _CHI_STEP))
    chi = np.asarray(_CHI_STEP * np.arange(steps + 1), float)
    return Distances(chi, cosmology.redshift(chi))


def draw_replicas(box: Box, chi_max: float) -> Replicas:
    """Draw the rotations and shifts of the box in the shells out to the distance chi_max (Mpc/h).

    They depend only on the seed and the side of the box. The box in the nearest shell is shifted, but not rotated.
    """
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
    """Return the cell of the box at positions of the light-cone, and the directions in the frame of the box.

    Parameters
    ----------
    box : Box
        Periodic box of simulated matter.
    replicas : Replicas
        Rotation and shift of the box in each shell.
    direction : float array, shape (n, 3)
        Unit vectors from the observer to the positions.
    chi : float or float array, shape (n,)
        Comoving distance, Mpc/h.

    Returns
    -------
    cell : int array, shape (n,)
        Flat index of the cell of the box.
    direction : float array, shape (n, 3)
        The same unit vectors in the frame of the box.
    """
    shell = np.broadcast_to(np.asarray(chi // box.length, np.int64), direction.shape[:1])
    box_direction = replicas.sign[shell] * np.take_along_axis(direction, replicas.axes[shell], 1)
    place = (box_direction * np.reshape(chi, (-1, 1)) + replicas.shift[shell]) / box.model.cell
    x, y, z = np.floor(place).astype(np.int64).T % box.n
    return (x * box.n + y) * box.n + z, box_direction


def radial_steps(cell: float, start: float, end: float, table: Distances) -> Steps:
    """Return steps in comoving distance with edges at all multiples of the cell size between two distances.

    Parameters
    ----------
    cell : float
        Side of the box's cells, Mpc/h.
    start, end : float
        First and last edge of the steps, Mpc/h.
    table : Distances
        Table of redshift by comoving distance.

    Returns
    -------
    Steps
        The steps.
    """
    inner = np.arange(np.floor(start / cell) + 1, np.ceil(end / cell)) * cell
    edge = np.concatenate([[start], inner, [end]])
    return Steps(edge, table.redshift(0.5 * (edge[1:] + edge[:-1])))


def width(order: int, chi: Float) -> Float:
    """Return the side (Mpc/h) of HEALPix cells of an order at comoving distances `chi` (Mpc/h), across the sight line.

    It is the side of an average cell, so that it does not depend on the position on the sky.
    """
    return np.asarray(_SIDE * chi / (1 << order))


def voxels(box: Box, replicas: Replicas, steps: Steps, order: int, cell: int, used: Bool) -> Voxels:
    """Divide the light-cone in a sky cell into voxels (small pieces of volume).

    A voxel is as deep as a step in distance (4 Mpc/h, except the first step) and at most about 5 Mpc/h wide. Close to
    the observer, where the whole sky cell is narrower, a voxel is as wide as the cell.

    Parameters
    ----------
    box : Box
        Periodic box of simulated matter.
    replicas : Replicas
        Rotation and shift of the box in each shell.
    steps : Steps
        Steps in comoving distance.
    order, cell : int
        Order and nested index of the HEALPix cell.
    used : bool array, shape (s,)
        True for the steps to divide; other steps have no voxels.

    Returns
    -------
    Voxels
        The voxels, sorted by the order of their HEALPix cells, then by step. Empty if no step is used.
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
