"""Halos of the embedded universe: abundance, bias, and draws in the voxels of a cell of the sky.

A halo belongs to one of three levels, depending on the angle of its radius. Halos of a level are drawn by cells of its
order, so that the satellites of a halo are in its cell or in the neighbouring cells. Nearby and massive halos, which
span degrees, are drawn by large cells.

A block is a cell, a step along the line of sight and a mass bin. The number of halos in a block and all their
properties depend only on the block, so that a deeper or farther request contains the same halos and more. The
parameters are in halos.toml.

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
from truesky.catalogue.matter import density_box, lightcone
from truesky.catalogue.matter.density_box import Box
from truesky.catalogue.matter.lightcone import Distances, Replicas, Steps, Voxels
from truesky.fluxes import cosmology
from truesky.randomness import per_source

LEVELS = (GENERATION_ORDER, 5, 2)
# Lower limit of the distance between cells of an order that do not touch, in units of the side of a cell.
_CELL_SEPARATION = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class HaloModel:
    """Tables from which halos are drawn: some are the same for every request, others are its limits.

    Attributes
    ----------
    box : Box
        Matter in a box.
    replicas : Replicas
        Rotation of each replica of the box.
    distances : Distances
        Table of redshifts.
    steps : Steps
        Steps along the line of sight.
    log_mass : float array, shape (bins + 1,)
        Edges of the mass bins, log10 Msun/h.
    number : float array, shape (s, bins)
        Comoving number density in a bin, (Mpc/h)^-3.
    ratio : float array, shape (s, bins)
        ln of the ratio of the densities at the lower and upper edge of the bin.
    x : float array, shape (s, bins)
        Bias times growth.
    field, amplitude : array, shape (s, bins)
        Number of the smoothed field, and its amplitude.
    level : int array, shape (s, bins)
        Order of the cells that draw the halos of a block; -1 if they are larger than any level.
    limit : float array, shape (s,)
        log10 of the proxy mass of the faintest galaxy, Msun/h.
    max_distance : float
        Largest distance of the request, Mpc/h.
    matching : Matching
        Luminosities by proxy mass.
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

    def mass_limit(self, chi: Float) -> Float:
        """Return log10 of the proxy mass of the faintest galaxy at comoving distances (Mpc/h)."""
        middle, last = self.steps.middle, self.limit.size - 2
        # Each step except the first is as deep as a cell of the box.
        row = np.clip(((chi - middle[1]) / self.box.model.cell).astype(np.int64) + 1, 1, last)
        row = np.where(chi < middle[1], 0, row)
        part = np.clip((chi - middle[row]) / (middle[row + 1] - middle[row]), 0.0, 1.0)
        return np.asarray(self.limit[row] * (1.0 - part) + self.limit[row + 1] * part)

    @property
    def host_offset(self) -> float:
        """Return the offset from `mass_limit` in dex; all halos above it are drawn, because of their satellites."""
        return float(np.log10(self.matching.occupation.min_mass_ratio)) - self.matching.occupation.depth

    @property
    def min_mass_limit(self) -> Float:
        """Return the smallest `mass_limit` in and next to each step, infinite beyond the end of the request.

        Galaxies end at `max_distance`, their hosts one step behind it.
        """
        padded = np.pad(self.limit, 1, constant_values=np.inf)
        lowest = np.minimum(np.minimum(padded[:-2], padded[2:]), self.limit)
        return np.where(self.steps.edge[:-1] < self.max_distance + self.box.model.cell, lowest, np.inf)

    def blocks_above(self, min_log_mass: Float) -> Bool:
        """Return True for blocks (s, bins) that have a level and contain halos above a log10 mass limit (s,)."""
        return np.asarray((self.level >= 0) & (self.log_mass[None, 1:] >= min_log_mass[:, None]))


@dataclass(frozen=True, slots=True, eq=False)
class Halos:
    """Halos sorted by index.

    Attributes
    ----------
    index : int array, shape (n,)
        Order-29 cell.
    chi : float array, shape (n,)
        Comoving distance, Mpc/h.
    log_mass : float array, shape (n,)
        log10 M_200m / (Msun/h).
    proxy : float array, shape (n,)
        log10 mass with the scatter of its central galaxy.
    velocity : float array, shape (n,)
        Line-of-sight velocity, km/s, positive if receding.
    id : int array, shape (n,)
        Identifier.
    bits : int array, shape (n,)
        Number of bits for the members in identifiers.
    """

    index: Int
    chi: Float
    log_mass: Float
    proxy: Float
    velocity: Float
    id: Int
    bits: Int

    def select(self, keep: npt.NDArray[np.generic]) -> Halos:
        """Return the halos of a bool mask or of row numbers."""
        return Halos(*(getattr(self, name)[keep] for name in self.__slots__))


def model(
    box: Box, volume: Volume, masses: Masses, matching: Matching, faintest: Callable[[Float], Float]
) -> HaloModel:
    """Return the tables of halos, and the limits of a request.

    Parameters
    ----------
    box : Box
        Matter in a box.
    volume : Volume
        Redshift range of the request.
    masses : Masses
        Tables of halos by mass.
    matching : Matching
        Luminosities by mass.
    faintest : callable
        Function that returns the faintest requested M_r at each redshift.

    Returns
    -------
    HaloModel
        The model.

    Raises
    ------
    BadInput
        If there are more blocks than identifiers can number.
    """
    steps, distances = _radial_steps(box.model.cell, float(cosmology.comoving_distance(volume.z_min)))
    law = parameters.section("halos.toml", "mass_function")
    bins = round((law["highest"] - law["lowest"]) / law["bin"])
    edge = law["lowest"] + law["bin"] * np.arange(bins + 1)
    if steps.z.size * bins > ids.BLOCK_COUNT:
        raise BadInput(
            f"{steps.z.size} steps times {bins} mass bins must not exceed {ids.BLOCK_COUNT}, the limit of identifiers"
        )
    at_edge = np.exp(masses.interpolate(masses.ln_density, steps.z, edge))
    # At the end of the mass function the densities underflow, and their ratio has no meaning.
    ratio = np.maximum(np.log(np.maximum(at_edge[:, :-1], 1e-300) / np.maximum(at_edge[:, 1:], 1e-300)), 1e-6)
    number = law["bin"] * (at_edge[:, :-1] - at_edge[:, 1:]) / ratio
    x = masses.interpolate(masses.bias, steps.z, edge[:-1] + 0.5 * law["bin"])
    x = x * density_box.growth(steps.z)[:, None]
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
    )


def _radial_steps(cell: float, start: float) -> tuple[Steps, Distances]:
    """Steps of one cell from `start` to one step behind the last redshift of the tables, and a table of redshifts."""
    last = (np.ceil(float(cosmology.comoving_distance(Z_LAST)) / cell) + 1.0) * cell
    table = lightcone.distance_table(float(cosmology.redshift(last)) + 1e-6)
    return lightcone.radial_steps(cell, start, float(last), table), table


def reach(order: int) -> float:
    """Return an angle (rad) that never leads from a cell beyond its neighbours."""
    return float(_CELL_SEPARATION * np.radians(np.sqrt(sky.cell_area(order))))


def draw(halos: HaloModel, seed: int, order: int, cell: int, min_log_mass: Float | None = None) -> Halos:
    """Draw the halos of one level in a cell: a Poisson sample of the biased field.

    Parameters
    ----------
    halos : HaloModel
        Tables from `model`.
    seed : int
        Seed of the request.
    order, cell : int
        Order and nested index of the cell.
    min_log_mass : float array, shape (s,), optional
        log10 of the mass above which all halos are returned, infinite for steps without halos. None for the halos that
        may contain galaxies of the request: a satellite, or a central galaxy above `mass_limit`.

    Returns
    -------
    Halos
        The halos.
    """
    occupation, lowest = halos.matching.occupation, halos.min_mass_limit
    used = halos.blocks_above(lowest - occupation.depth if min_log_mass is None else min_log_mass) & (
        halos.level == order
    )
    voxels = lightcone.voxels(halos.box, halos.replicas, halos.steps, order, cell, used.any(1))
    # Either threshold must be reached. All halos of the larger cells must be drawn, because they are numbered below.
    thresholds = (lowest + halos.host_offset, lowest) if min_log_mass is None else (min_log_mass, min_log_mass)
    thresholds = thresholds if order == GENERATION_ORDER else (np.full(lowest.size, -np.inf), lowest)
    voxel, column, rank, place, numbers = _draw_blocks(
        halos, used, voxels, thresholds, int(per_source.keys(np.array([cell]), seed, "halos", order)[0])
    )
    step = voxels.step[voxel]
    fall, width = halos.ratio[step, column], halos.log_mass[1] - halos.log_mass[0]
    # dn/dlogM decreases exponentially within a bin.
    log_mass = halos.log_mass[column] - width * np.log1p(numbers[:, 1] * np.expm1(-fall)) / fall
    proxy = log_mass + occupation.scatter * numbers[:, 2]
    inner, outer = halos.steps.edge[step], halos.steps.edge[step + 1]
    chi = np.cbrt(inner**3 + numbers[:, 0] * (outer**3 - inner**3))
    shift = 2 * (sky.MAX_ORDER - voxels.order[voxel])
    index = (voxels.cell[voxel] << shift) | (place >> np.uint64(2)).astype(np.int64) & ((np.int64(1) << shift) - 1)
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
    """Return the order of the cells that draw halos with these angular radii (rad), -1 if no level is large enough."""
    level = np.full(angle.shape, -1)
    for order in sorted(LEVELS):
        level[angle < reach(order)] = order
    return level


def _draw_blocks(
    halos: HaloModel, used: Bool, voxels: Voxels, thresholds: tuple[Float, Float], key: int
) -> tuple[Int, Int, Int, npt.NDArray[np.uint64], Float]:
    """Return (voxel, mass bin, number in the block, random bits, random numbers (n, 3)) of halos, sorted by block."""
    steps, first = np.unique(voxels.step, return_index=True)
    first = np.append(first, voxels.step.size)
    amplitude, field = halos.amplitude[steps], halos.field[steps]
    volume = np.pi / 3.0 * halos.steps.volume[steps] / 4.0 ** voxels.order[first[:-1]]
    with np.errstate(divide="ignore"):
        ln_number = np.log(halos.number[steps] * volume[:, None]) - 0.5 * amplitude**2 * halos.box.variance[field]
    g = np.stack([smooth.ravel()[voxels.box] for smooth in halos.box.smoothed], 1)
    tables = (ln_number, amplitude, field, g)
    number = compiled_halos.draw_counts(np.uint64(key), first, steps, used[steps], *tables)
    n = int(number.sum())
    out = (*np.empty((4, n), np.int64), np.empty(n, np.uint64), np.empty((n, 3)))
    occupation = halos.matching.occupation
    limits = (
        halos.log_mass[1:],
        *(limit[steps] for limit in thresholds),
        occupation.scatter,
        occupation.depth / occupation.scatter,
    )
    filled = slice(compiled_halos.fill_halos(np.uint64(key), first, steps, number, *tables, limits, out))
    return out[0][filled], out[2][filled], out[3][filled], out[4][filled], out[5][filled]


def _identifiers(halos: HaloModel, step: Int, column: Int, index: Int, number: Int | None) -> tuple[Int, Int]:
    """Return (identifiers, member bits) of halos; halos of larger cells are numbered here in their generation cells."""
    block, cell = step * (halos.log_mass.size - 1) + column, index >> 2 * (sky.MAX_ORDER - GENERATION_ORDER)
    if number is None:
        number = np.empty(block.size, np.int64)
        compiled_halos.count_before(block, cell, number)
    bits = ids.member_bits(halos.log_mass[column])
    return ids.drawn_halo_id(cell, block, number, bits), bits
