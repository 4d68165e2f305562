"""The box along the line of sight: replicas, and the voxels of a cell of the sky.

replicas        how each spherical shell, one box side deep, is turned, mirrored and shifted, so that structure
                does not repeat along a line of sight; structure breaks only where chi is a multiple of the side
box_cells       sky direction and distance -> cell of the box, and the direction as the box sees it
steps, voxels   the volume of a HEALPix cell in pieces of about 4 Mpc/h

Comoving Mpc/h; the observer sits at a place of the box that the seed chooses.
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

# Side of a HEALPix cell in units of 1 / nside, rad, and how much wider than a cell of the box a voxel may be.
_SIDE, _WIDEST = 1.023, 1.2
# Of the table of redshifts, Mpc/h.
_CHI_STEP = 0.25


@dataclass(frozen=True, slots=True, eq=False)
class Replicas:
    """Shell j holds box position sign[j] x[axes[j]] + shift[j] at sky position x, Mpc/h.

    axes : int[shell, 3];  sign, shift : [shell, 3]
    """

    axes: Int
    sign: Float
    shift: Float


@dataclass(frozen=True, slots=True, eq=False)
class Steps:
    """Radial steps from one chi to another; no step straddles a multiple of the box's cell.

    edge : [s + 1] Mpc/h;  z : [s] at the middle
    """

    edge: Float
    z: Float

    @property
    def middle(self) -> Float:
        """float[s] Mpc/h."""
        return 0.5 * (self.edge[1:] + self.edge[:-1])

    @property
    def volume(self) -> Float:
        """float[s] (Mpc/h)^3 a steradian."""
        return np.asarray((self.edge[1:] ** 3 - self.edge[:-1] ** 3) / 3.0)


@dataclass(frozen=True, slots=True, eq=False)
class Voxels:
    """Pieces of a cell's volume.

    step : int[v];  order, cell : int[v] nested HEALPix cell that bounds it;  box : int[v] flat cell of the box
    velocity : [v] u towards growing distance, Mpc/h (times velocity_factor: km/s)
    """

    step: Int
    order: Int
    cell: Int
    box: Int
    velocity: Float


@dataclass(frozen=True, slots=True, eq=False)
class Distances:
    """Redshift against comoving distance, tabulated at uniform chi from 0: z(chi) within 1e-8."""

    chi: Float
    z: Float

    def redshift(self, chi: npt.ArrayLike) -> Float:
        """Redshift[n] of chi : float[n] Mpc/h, within the table."""
        at = np.asarray(chi, float) / _CHI_STEP
        node = np.minimum(at.astype(np.int64), self.z.size - 2)
        low = self.z[node]
        return np.asarray(low + (at - node) * (self.z[node + 1] - low))


def distance_table(z_max: float) -> Distances:
    """The table out to z_max, or a step of it further."""
    steps = int(np.ceil(float(cosmology.comoving_distance(z_max)) / _CHI_STEP))
    chi = np.asarray(_CHI_STEP * np.arange(steps + 1), float)
    return Distances(chi, cosmology.redshift(chi))


def draw_replicas(box: Box, chi_max: float) -> Replicas:
    """Replicas out to chi_max, from the box's seed; the nearest is not turned."""
    turns = [(axes, sign) for axes in permutations(range(3)) for sign in product((1.0, -1.0), repeat=3)]
    shells = int(chi_max // box.length) + 1
    chosen, shifts = [], []
    for shell in range(shells):
        # Each shell has a stream of its own: a deeper light-cone leaves the nearer shells as they were.
        rng = stream(box.seed, "replica", shell)
        chosen.append(turns[int(rng.integers(len(turns)))] if shell else turns[0])
        shifts.append(box.length * rng.random(3))
    axes, sign = zip(*chosen, strict=True)
    return Replicas(np.array(axes), np.array(sign), np.array(shifts))


def box_cells(box: Box, replicas: Replicas, direction: Float, chi: Float) -> tuple[Int, Float]:
    """(flat cell of the box[n], direction in the box's frame [n, 3]).

    direction : [n, 3] unit vectors;  chi : [n] Mpc/h
    box       : of matter;  turned : how each replica of it is turned
    """
    shell = np.broadcast_to(np.asarray(chi // box.length, np.int64), direction.shape[:1])
    box_direction = replicas.sign[shell] * np.take_along_axis(direction, replicas.axes[shell], 1)
    place = (box_direction * np.reshape(chi, (-1, 1)) + replicas.shift[shell]) / box.model.cell
    x, y, z = np.floor(place).astype(np.int64).T % box.n
    return (x * box.n + y) * box.n + z, box_direction


def radial_steps(cell: float, start: float, end: float, table: Distances) -> Steps:
    """Steps of `cell` Mpc/h from near to far.

    cell : side of the box's cells;  near, far : Mpc/h;  table : of distances
    """
    inner = np.arange(np.floor(start / cell) + 1, np.ceil(end / cell)) * cell
    edge = np.concatenate([[start], inner, [end]])
    return Steps(edge, table.redshift(0.5 * (edge[1:] + edge[:-1])))


def voxels(box: Box, replicas: Replicas, steps: Steps, order: int, cell: int, used: Bool) -> Voxels:
    """Voxels of a nested cell, in the steps that are used (bool[s]).

    order, cell : of the nested cell;  used : bool[s]
    box, turned : of matter, and how each replica of it is turned;  line : steps along the line of sight
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
