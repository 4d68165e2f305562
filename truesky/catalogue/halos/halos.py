"""Halos of the embedded universe: abundance, bias, and draws in the voxels of a cell of the sky.

model       every table that the draws need
draw        halos of one cell of one level
levels      which cells draw a halo, by the angle that its radius spans

A halo belongs to one of three levels, by the angle that its radius spans.  Halos of a level are drawn by the cells
of its order, so that the satellites of a halo end in its cell or in one of the cells about it: near and massive
halos, which span degrees, by wide cells.

Halos are drawn by blocks: a cell, a step along the line of sight and a bin of mass. The number of a block and all that
its halos are is keyed by the block, so that a deeper or farther request draws the same halos and more of them.
Ref: Tinker et al. 2008, 2010; the numbers are in halos.toml.
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
# Any two cells of an order that do not touch are further apart than this, in units of the side of a cell.
_CELL_SEPARATION = 0.5


@dataclass(frozen=True, slots=True, eq=False)
class HaloModel:
    """What halos are drawn from: tables that are the same for every request, and the limits of one.

    line    : radial steps;  log_mass : [bins + 1] edges
    number  : [s, bins] comoving (Mpc/h)^-3 in a bin;  ratio : [s, bins] ln of the density at its edges, low / high
    x       : [s, bins] bias times growth;  field, amplitude : int[s, bins] which smoothed field, and how much of it
    level   : int[s, bins] order of the cells that a halo of this bin is drawn by, -1 = wider than any
    limit   : [s] log10 of the proxy mass of the faintest galaxy;  far : Mpc/h, where the request ends
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
        """log10 of the proxy mass[n] of the faintest galaxy at chi[n]."""
        middle, last = self.steps.middle, self.limit.size - 2
        # Steps are all as deep as a cell of the box, but for the first.
        row = np.clip(((chi - middle[1]) / self.box.model.cell).astype(np.int64) + 1, 1, last)
        row = np.where(chi < middle[1], 0, row)
        part = np.clip((chi - middle[row]) / (middle[row + 1] - middle[row]), 0.0, 1.0)
        return np.asarray(self.limit[row] * (1.0 - part) + self.limit[row + 1] * part)

    @property
    def host_offset(self) -> float:
        """Every halo above `mass_limit` plus this, dex, is drawn: it may have a satellite, which may be seen."""
        return float(np.log10(self.matching.occupation.min_mass_ratio)) - self.matching.occupation.depth

    @property
    def min_mass_limit(self) -> Float:
        """Least `mass_limit`[s] anywhere in a step; infinite beyond the request's end.

        Galaxies end at `far`, their hosts one step behind it.
        """
        padded = np.pad(self.limit, 1, constant_values=np.inf)
        lowest = np.minimum(np.minimum(padded[:-2], padded[2:]), self.limit)
        return np.where(self.steps.edge[:-1] < self.max_distance + self.box.model.cell, lowest, np.inf)

    def blocks_above(self, min_log_mass: Float) -> Bool:
        """Blocks, [s, bins], that hold halos of at least log10 mass least[s] and have a level."""
        return np.asarray((self.level >= 0) & (self.log_mass[None, 1:] >= min_log_mass[:, None]))


@dataclass(frozen=True, slots=True, eq=False)
class Halos:
    """n halos, sorted by index.

    index : order-29 cell;  chi : Mpc/h;  velocity : km/s, receding;  log_mass : log10 M_200m / (Msun/h)
    proxy : log_mass with the scatter that its central has;  id : its identifier;  bits : of a member of it
    """

    index: Int
    chi: Float
    log_mass: Float
    proxy: Float
    velocity: Float
    id: Int
    bits: Int

    def select(self, keep: npt.NDArray[np.generic]) -> Halos:
        """The halos that are kept: keep : bool or int[m] rows."""
        return Halos(*(getattr(self, name)[keep] for name in self.__slots__))


def model(
    box: Box, volume: Volume, masses: Masses, matching: Matching, faintest: Callable[[Float], Float]
) -> HaloModel:
    """Tables of halos, and the limits of a request.

    faintest : z[n] -> the faintest M_r[n] that is wanted there
    box              : of matter;  space : redshifts of the request
    masses, matching : tables of halos by mass, and of luminosities by mass
    """
    steps, distances = _radial_steps(box.model.cell, float(cosmology.comoving_distance(volume.z_min)))
    law = parameters.section("halos.toml", "mass_function")
    bins = round((law["highest"] - law["lowest"]) / law["bin"])
    edge = law["lowest"] + law["bin"] * np.arange(bins + 1)
    if steps.z.size * bins > ids.BLOCK_COUNT:
        raise BadInput(
            f"{steps.z.size} steps of {bins} bins of mass are more blocks than identifiers have: {ids.BLOCK_COUNT}"
        )
    at_edge = np.exp(masses.interpolate(masses.ln_density, steps.z, edge))
    # Where nothing is left of the mass function, the logarithm of what is left has no meaning.
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
    """Steps of `cell` Mpc/h from `near` to a step behind the tables' last redshift, and the distances of these."""
    last = (np.ceil(float(cosmology.comoving_distance(Z_LAST)) / cell) + 1.0) * cell
    table = lightcone.distance_table(float(cosmology.redshift(last)) + 1e-6)
    return lightcone.radial_steps(cell, start, float(last), table), table


def reach(order: int) -> float:
    """Angle, rad, that certainly does not lead from a cell beyond the cells about it."""
    return float(_CELL_SEPARATION * np.radians(np.sqrt(sky.cell_area(order))))


def draw(halos: HaloModel, seed: int, order: int, cell: int, min_log_mass: Float | None = None) -> Halos:
    """Halos of one level in a nested cell of its order, a Poisson sample of the biased field.

    halos : tables of `model`;  seed : of the request;  order, cell : of the nested cell
    least : [s] log10 of the mass from which on all halos are wanted, infinite where none are, whatever the limit;
            None = those that may hold galaxies of the request: a satellite, or a central above `mass_limit`
    """
    occupation, lowest = halos.matching.occupation, halos.min_mass_limit
    used = halos.blocks_above(lowest - occupation.depth if min_log_mass is None else min_log_mass) & (
        halos.level == order
    )
    voxels = lightcone.voxels(halos.box, halos.replicas, halos.steps, order, cell, used.any(1))
    # Either is enough; of wide cells all halos are numbered.
    thresholds = (lowest + halos.host_offset, lowest) if min_log_mass is None else (min_log_mass, min_log_mass)
    thresholds = thresholds if order == GENERATION_ORDER else (np.full(lowest.size, -np.inf), lowest)
    voxel, column, rank, place, numbers = _draw_blocks(
        halos, used, voxels, thresholds, int(per_source.keys(np.array([cell]), seed, "halos", order)[0])
    )
    step = voxels.step[voxel]
    fall, width = halos.ratio[step, column], halos.log_mass[1] - halos.log_mass[0]
    # Inside a bin dn/dlogM falls exponentially.
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
    """Order of the cells that draw a halo whose radius spans this angle, rad; -1 where it spans more than any.

    wide : float[...] rad
    """
    level = np.full(angle.shape, -1)
    for order in sorted(LEVELS):
        level[angle < reach(order)] = order
    return level


def _draw_blocks(
    halos: HaloModel, used: Bool, voxels: Voxels, thresholds: tuple[Float, Float], key: int
) -> tuple[Int, Int, Int, npt.NDArray[np.uint64], Float]:
    """(voxel[n], mass bin[n], number in the block[n], random bits[n], [n, 3] numbers) of halos, block after block.

    wanted : [s] log10 of mass and proxy of which either is enough
    """
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
    """(identifiers[n], bits of a member[n]) of halos; of wide cells they have no number yet, and are all of a block."""
    block, cell = step * (halos.log_mass.size - 1) + column, index >> 2 * (sky.MAX_ORDER - GENERATION_ORDER)
    if number is None:
        number = np.empty(block.size, np.int64)
        compiled_halos.count_before(block, cell, number)
    bits = ids.member_bits(halos.log_mass[column])
    return ids.drawn_halo_id(cell, block, number, bits), bits
