"""Draw dark matter halos as a biased Poisson sample of the simulated matter.

Halos are drawn per HEALPix cell. A halo belongs to one of three levels (cells of order 8, 5 or 2), depending on its
angular radius: halos that span a larger angle are drawn in larger cells. The satellites of a halo are therefore always
in the cell of the halo or in the neighbouring cells of its level.

A block is a cell, a step in distance and a mass bin. The number of halos in a block and all their properties depend
only on the block and the seed. A deeper or farther catalogue therefore contains the same halos and more. The parameters
are in halos.toml.

References
----------
Tinker et al. 2008, 2010
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lake_schema import ids, sky
from lake_schema.arrays import Bool, Float, Int
from lake_schema.errors import BadInput
from lake_schema.ids import GENERATION_ORDER
from truesky.catalogue import parameters
from truesky.catalogue.halos import compiled_halos
from truesky.catalogue.halos.luminosity_function import Volume
from truesky.catalogue.halos.matching import Z_LAST, Masses, Matching
from truesky.catalogue.matter import density_box, fine_structure, lightcone
from truesky.catalogue.matter.density_box import Box
from truesky.catalogue.matter.fine_structure import FineStructure
from truesky.catalogue.matter.lightcone import Distances, Replicas, Steps, Voxels
from truesky.cosmology import Cosmology
from truesky.randomness import per_source

# HEALPix orders of the cells in which halos are drawn, from small to large cells.
LEVELS = (GENERATION_ORDER, 5, 2)
# Lower limit of the distance between two HEALPix cells that do not touch, in units of the side of a cell.
_CELL_SEPARATION = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class HaloModel:
    """Tables from which halos are drawn, by step in distance (s) and mass bin, and the limits of the catalogue.

    Attributes
    ----------
    box : Box
        Periodic box of simulated matter.
    replicas : Replicas
        Rotations of the copies of the box that fill space.
    distances : Distances
        Table of redshift by comoving distance.
    steps : Steps
        Steps in comoving distance.
    log_mass : float array, shape (bins + 1,)
        Edges of the mass bins, log10 of M_200m in Msun/h.
    number : float array, shape (s, bins)
        Comoving number density of halos in a bin, (Mpc/h)^-3.
    ratio : float array, shape (s, bins)
        ln of the ratio of dn/dlog10 M at the lower and the upper edge of the bin.
    x : float array, shape (s, bins)
        Halo bias times linear growth.
    field, amplitude : array, shape (s, bins)
        Index of the smoothed Gaussian field that the halos follow, and the factor of the field in the exponential.
    level : int array, shape (s, bins)
        HEALPix order of the cells in which the halos are drawn; -1 for halos that are too large for any cell, which are
        not drawn.
    limit : float array, shape (s,)
        log10 of the proxy mass (Msun/h) of the faintest galaxy of the catalogue. The proxy mass determines the
        luminosity of a galaxy: it is the mass of the halo or sub-halo with a scatter.
    max_distance : float
        Comoving distance of the farthest galaxies of the catalogue, Mpc/h.
    matching : Matching
        Absolute magnitudes by proxy mass.
    fine : FineStructure or None
        Structure of the density of halos below the voxels; None if halos have random positions in their voxels.
    """

    box: Box
    replicas: Replicas
    distances: Distances
    steps: Steps
    log_mass: Float
    number: Float
    ratio: Float
    x: Float
    field: Int
    amplitude: Float
    level: Int
    limit: Float
    max_distance: float
    matching: Matching
    fine: FineStructure | None

    def mass_limit(self, chi: Float) -> Float:
        """Return log10 of the proxy mass (Msun/h) of the catalogue's faintest galaxy at comoving distances (Mpc/h).

        The proxy mass is the mass of a halo or sub-halo with a scatter, and determines the luminosity of its galaxy.
        The result is linear between the middles of the steps in distance, and constant before the first and after the
        last of them.
        """
        middle, last = self.steps.middle, self.limit.size - 2
        # All steps except the first have the depth of a cell of the box, so the row follows from a division.
        row = np.clip(((chi - middle[1]) / self.box.model.cell).astype(np.int64) + 1, 1, last)
        row = np.where(chi < middle[1], 0, row)
        part = np.clip((chi - middle[row]) / (middle[row + 1] - middle[row]), 0.0, 1.0)
        return np.asarray(self.limit[row] * (1.0 - part) + self.limit[row + 1] * part)

    @property
    def host_offset(self) -> float:
        """Return log10 of the smallest mass of a halo with a satellite in the catalogue, minus `mass_limit`, dex.

        `mass_limit` is log10 of the smallest proxy mass (mass of a halo or sub-halo with a scatter) of a galaxy in the
        catalogue. All halos above `mass_limit` + `host_offset` are drawn, because a satellite may be bright enough even
        if the central galaxy is not.
        """
        return float(np.log10(self.matching.occupation.min_mass_ratio)) - self.matching.occupation.depth

    @property
    def min_mass_limit(self) -> Float:
        """Return the smallest `mass_limit` in each step in distance and its two neighbours, shape (s,).

        `mass_limit` is log10 of the smallest proxy mass (mass of a halo or sub-halo with a scatter) of a galaxy in the
        catalogue. The result is infinite for steps that begin more than one cell of the box behind `max_distance`.
        Halos that are nearer may have satellites within `max_distance`.
        """
        padded = np.pad(self.limit, 1, constant_values=np.inf)
        lowest = np.minimum(np.minimum(padded[:-2], padded[2:]), self.limit)
        return np.where(self.steps.edge[:-1] < self.max_distance + self.box.model.cell, lowest, np.inf)

    def blocks_above(self, min_log_mass: Float) -> Bool:
        """Return True for the pairs of step and mass bin, shape (s, bins), that contain halos above log10 mass limits.

        `min_log_mass` has one limit (Msun/h) per step. Halos whose angular radius is too large for the HEALPix cells in
        which halos are drawn are not drawn, so they do not count.
        """
        return np.asarray((self.level >= 0) & (self.log_mass[None, 1:] >= min_log_mass[:, None]))


@dataclass(frozen=True, slots=True, eq=False)
class Halos:
    """Table of halos, sorted by position.

    Attributes
    ----------
    index : int array, shape (n,)
        Position: nested index of the HEALPix cell of order 29.
    chi : float array, shape (n,)
        Comoving distance, Mpc/h.
    log_mass : float array, shape (n,)
        log10 M_200m / (Msun/h).
    proxy : float array, shape (n,)
        log10 of the proxy mass (Msun/h), which determines the luminosity of the central galaxy: the mass with a
        scatter.
    velocity : float array, shape (n,)
        Line-of-sight peculiar velocity, km/s, positive if receding.
    id : int array, shape (n,)
        Identifier.
    bits : int array, shape (n,)
        Number of bits at the end of identifiers that number the galaxies in the halo.
    """

    index: Int
    chi: Float
    log_mass: Float
    proxy: Float
    velocity: Float
    id: Int
    bits: Int

    def select(self, keep: npt.NDArray[np.generic]) -> Halos:
        """Return some of the halos, given as a bool mask of shape (n,) or as row numbers."""
        return Halos(*(getattr(self, name)[keep] for name in self.__slots__))


def model(
    box: Box,
    volume: Volume,
    masses: Masses,
    matching: Matching,
    faintest: Callable[[Float], Float],
    fine: FineStructure | None = None,
) -> HaloModel:
    """Return the tables from which halos are drawn, and the limits of the catalogue.

    Parameters
    ----------
    box : Box
        Periodic box of simulated matter.
    volume : Volume
        Redshift range of the catalogue.
    masses : Masses
        Tables of halo abundance and bias by mass and redshift.
    matching : Matching
        Absolute magnitudes of galaxies by proxy mass (mass of the halo or sub-halo with a scatter).
    faintest : callable
        Function that returns the faintest absolute magnitude M_r (0.1r for h = 1) of the catalogue at redshifts.
    fine : FineStructure, optional
        Structure of the density of halos below the voxels; None for random positions in voxels.

    Returns
    -------
    HaloModel
        The model.

    Raises
    ------
    BadInput
        If there are more combinations of step and mass bin than identifiers can contain.
    """
    cosmology = box.model.cosmology
    steps, distances = _radial_steps(cosmology, box.model.cell, float(cosmology.comoving_distance(volume.z_min)))
    law = parameters.section("halos.toml", "mass_function")
    bins = round((law["highest"] - law["lowest"]) / law["bin"])
    edge = law["lowest"] + law["bin"] * np.arange(bins + 1)
    if steps.z.size * bins > ids.BLOCK_COUNT:
        raise BadInput(
            f"{steps.z.size} steps times {bins} mass bins must not exceed {ids.BLOCK_COUNT}, the limit of identifiers"
        )
    at_edge = np.exp(masses.interpolate(masses.ln_density, steps.z, edge))
    # At the highest masses the densities underflow to 0. Limit the ratio, so that it is finite and above 0.
    ratio = np.maximum(np.log(np.maximum(at_edge[:, :-1], 1e-300) / np.maximum(at_edge[:, 1:], 1e-300)), 1e-6)
    number = law["bin"] * (at_edge[:, :-1] - at_edge[:, 1:]) / ratio
    x = masses.interpolate(masses.bias, steps.z, edge[:-1] + 0.5 * law["bin"])
    x = x * cosmology.growth(steps.z)[:, None]
    field, amplitude = density_box.biased_field(box.model, x)
    return HaloModel(
        box=box,
        replicas=lightcone.draw_replicas(box, float(steps.edge[-1])),
        distances=distances,
        steps=steps,
        log_mass=edge,
        number=number,
        ratio=ratio,
        x=x,
        field=field,
        amplitude=amplitude,
        level=levels(masses.radius(edge[1:])[None, :] / steps.edge[:-1, None]),
        limit=matching.proxy_mass(steps.z, faintest(steps.z)),
        max_distance=float(cosmology.comoving_distance(volume.z_max)),
        matching=matching,
        fine=fine,
    )


def _radial_steps(cosmology: Cosmology, cell: float, start: float) -> tuple[Steps, Distances]:
    """Return the steps in comoving distance, and a table of redshift by distance.

    `cell` is the depth of a step, that is the side of a cell of the box, and `start` the inner edge of the first step
    (both Mpc/h). The steps end behind the last redshift of the halo tables.
    """
    last = (np.ceil(float(cosmology.comoving_distance(Z_LAST)) / cell) + 1.0) * cell
    table = lightcone.distance_table(cosmology, float(cosmology.redshift(last)) + 1e-6)
    return lightcone.radial_steps(cell, start, float(last), table), table


def reach(order: int) -> float:
    """Return an angle in rad: positions that are closer together are in the same cell of an order, or in neighbours."""
    return float(_CELL_SEPARATION * np.radians(np.sqrt(sky.cell_area(order))))


def draw(halos: HaloModel, seed: int, order: int, cell: int, min_log_mass: Float | None = None) -> Halos:
    """Draw the halos of one level (cells of order 8, 5 or 2) in a HEALPix cell, as a Poisson sample of the matter.

    Parameters
    ----------
    halos : HaloModel
        Tables from `model`.
    seed : int
        Seed of the random numbers.
    order, cell : int
        Order of the level, and nested index of the cell.
    min_log_mass : float array, shape (s,), optional
        log10 of the mass (Msun/h) above which halos are returned, for each step in distance; infinite for no halos.
        None to return the halos that may contain a galaxy that is bright enough for the catalogue.

    Returns
    -------
    Halos
        The halos, sorted by position, then by identifier. Halos of the other levels are not included.
    """
    occupation, lowest = halos.matching.occupation, halos.min_mass_limit
    used = halos.blocks_above(lowest - occupation.depth if min_log_mass is None else min_log_mass) & (
        halos.level == order
    )
    voxels = lightcone.voxels(halos.box, halos.replicas, halos.steps, order, cell, used.any(1))
    # `thresholds` are the smallest mass of a halo with satellites and the smallest proxy mass (mass with a scatter) of
    # a central galaxy; a halo must reach one of them. For orders 5 and 2 draw all halos of a block, because
    # `_identifiers` numbers them by counting.
    thresholds = (lowest + halos.host_offset, lowest) if min_log_mass is None else (min_log_mass, min_log_mass)
    thresholds = thresholds if order == GENERATION_ORDER else (np.full(lowest.size, -np.inf), lowest)
    key = int(per_source.keys(np.array([cell]), seed, "halos", order)[0])
    subvoxels = None if halos.fine is None else fine_structure.divide(halos.fine, halos.steps, voxels)
    weight = np.ones((voxels.step.size, len(halos.box.smoothed))) if subvoxels is None else subvoxels.weight
    voxel, column, rank, place, numbers = _draw_blocks(halos, used, voxels, weight, thresholds, key)
    step = voxels.step[voxel]
    fall, width = halos.ratio[step, column], halos.log_mass[1] - halos.log_mass[0]
    # Draw the mass from a dn/dlog10 M that decreases exponentially within the bin.
    log_mass = halos.log_mass[column] - width * np.log1p(numbers[:, 1] * np.expm1(-fall)) / fall
    proxy = log_mass + occupation.scatter * numbers[:, 2]
    if halos.fine is None or subvoxels is None:
        chi = fine_structure.distance_at(halos.steps, step, numbers[:, 0])
        shift = 2 * (sky.MAX_ORDER - voxels.order[voxel])
        index = (voxels.cell[voxel] << shift) | (place >> np.uint64(2)).astype(np.int64) & ((np.int64(1) << shift) - 1)
    else:
        field = halos.field[step, column]
        index, chi = fine_structure.place_halos(halos.fine, halos.steps, voxels, subvoxels, (voxel, field, place))
    factor = density_box.velocity_factor(halos.box.model, halos.steps.z)
    identifiers, bits = _identifiers(halos, step, column, index, rank if order == GENERATION_ORDER else None)
    drawn = Halos(index, chi, log_mass, proxy, factor[step] * voxels.velocity[voxel], identifiers, bits)
    if min_log_mass is None:
        limit = halos.mass_limit(chi)
        selected = (log_mass >= limit + halos.host_offset) | (proxy >= limit)
    else:
        selected = log_mass >= min_log_mass[step]
    row = np.flatnonzero(selected)
    return drawn.select(row[np.lexsort((identifiers[row], index[row]))])


def levels(angle: Float) -> Int:
    """Return the HEALPix order (8, 5 or 2) of the cells in which halos with these angular radii (rad) are drawn.

    It is -1 for halos that are too large for the cells of order 2.
    """
    level = np.full(angle.shape, -1)
    for order in sorted(LEVELS):
        level[angle < reach(order)] = order
    return level


def _draw_blocks(
    halos: HaloModel, used: Bool, voxels: Voxels, weight: Float, thresholds: tuple[Float, Float], key: int
) -> tuple[Int, Int, Int, npt.NDArray[np.uint64], Float]:
    """Draw halos in all blocks (step in distance and mass bin) of a cell, sorted by block.

    Return for each halo its voxel (small piece of volume), mass bin, number in the block, random bits for its position,
    and three random numbers: uniform ones for the distance and the mass, and a normal deviate for the scatter between
    mass and proxy mass. `weight` are the weights of the voxels, shape (v, fields). `thresholds` are the limits of log10
    mass and of log10 proxy mass (mass with a scatter) by step; a halo must reach one of them.
    """
    steps, first = np.unique(voxels.step, return_index=True)
    first = np.append(first, voxels.step.size)
    amplitude, field = halos.amplitude[steps], halos.field[steps]
    volume = np.pi / 3.0 * halos.steps.volume[steps] / 4.0 ** voxels.order[first[:-1]]
    with np.errstate(divide="ignore"):
        ln_number = np.log(halos.number[steps] * volume[:, None]) - 0.5 * amplitude**2 * halos.box.variance[field]
    g = np.stack([smooth.ravel()[voxels.box] for smooth in halos.box.smoothed], 1)
    tables = (ln_number, amplitude, field, g, weight)
    number = compiled_halos.draw_counts(np.uint64(key), first, steps, used[steps], tables)
    n = int(number.sum())
    out = (*np.empty((4, n), np.int64), np.empty(n, np.uint64), np.empty((n, 3)))
    occupation = halos.matching.occupation
    limits = (
        halos.log_mass[1:],
        *(limit[steps] for limit in thresholds),
        occupation.scatter,
        occupation.depth / occupation.scatter,
    )
    filled = slice(compiled_halos.fill_halos(np.uint64(key), first, steps, number, tables, limits, out))
    return out[0][filled], out[2][filled], out[3][filled], out[4][filled], out[5][filled]


def _identifiers(halos: HaloModel, step: Int, column: Int, index: Int, number: Int | None) -> tuple[Int, Int]:
    """Return the identifiers of halos, and the number of bits for the galaxies of each halo.

    A block is a step in distance (`step`) and a mass bin (`column`). `number` are the numbers of the halos in their
    block. It is None for halos that were drawn in cells larger than order 8. These halos must be sorted by block, and
    are numbered here in each order-8 cell.
    """
    block, cell = step * (halos.log_mass.size - 1) + column, index >> 2 * (sky.MAX_ORDER - GENERATION_ORDER)
    if number is None:
        number = np.empty(block.size, np.int64)
        compiled_halos.count_before(block, cell, number)
    bits = ids.member_bits(halos.log_mass[column])
    return ids.drawn_halo_id(cell, block, number, bits), bits
