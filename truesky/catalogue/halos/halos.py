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
from truesky.randomness import keyed

LEVELS = (GENERATION_ORDER, 5, 2)
# Any two cells of an order that do not touch are further apart than this, in units of the side of a cell.
_APART = 0.5


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
    turned: Replicas
    distances: Distances
    line: Steps
    log_mass: Float
    number: Float
    ratio: Float
    x: Float
    field: Int
    amplitude: Float
    level: Int
    limit: Float
    far: float
    matching: Matching

    def mass_limit(self, chi: Float) -> Float:
        """log10 of the proxy mass[n] of the faintest galaxy at chi[n]."""
        middle, last = self.line.middle, self.limit.size - 2
        # Steps are all as deep as a cell of the box, but for the first.
        row = np.clip(((chi - middle[1]) / self.box.model.cell).astype(np.int64) + 1, 1, last)
        row = np.where(chi < middle[1], 0, row)
        part = np.clip((chi - middle[row]) / (middle[row + 1] - middle[row]), 0.0, 1.0)
        return np.asarray(self.limit[row] * (1.0 - part) + self.limit[row + 1] * part)

    @property
    def host_offset(self) -> float:
        """Every halo above `mass_limit` plus this, dex, is drawn: it may have a satellite, which may be seen."""
        return float(np.log10(self.matching.occupation.least)) - self.matching.occupation.depth

    @property
    def lowest(self) -> Float:
        """Least `mass_limit`[s] anywhere in a step; infinite beyond the request's end.

        Galaxies end at `far`, their hosts one step behind it.
        """
        padded = np.pad(self.limit, 1, constant_values=np.inf)
        lowest = np.minimum(np.minimum(padded[:-2], padded[2:]), self.limit)
        return np.where(self.line.edge[:-1] < self.far + self.box.model.cell, lowest, np.inf)

    def drawn(self, least: Float) -> Bool:
        """Blocks, [s, bins], that hold halos of at least log10 mass least[s] and have a level."""
        return np.asarray((self.level >= 0) & (self.log_mass[None, 1:] >= least[:, None]))


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

    def part(self, keep: npt.NDArray[np.generic]) -> Halos:
        """The halos that are kept: keep : bool or int[m] rows."""
        return Halos(*(getattr(self, name)[keep] for name in self.__slots__))


def model(box: Box, space: Volume, masses: Masses, matching: Matching, faintest: Callable[[Float], Float]) -> HaloModel:
    """Tables of halos, and the limits of a request.

    faintest : z[n] -> the faintest M_r[n] that is wanted there
    box              : of matter;  space : redshifts of the request
    masses, matching : tables of halos by mass, and of luminosities by mass
    """
    line, table = _line(box.model.cell, float(cosmology.comoving_distance(space.z_min)))
    low = parameters.section("halos.toml", "mass_function")
    bins = round((low["highest"] - low["lowest"]) / low["bin"])
    edge = low["lowest"] + low["bin"] * np.arange(bins + 1)
    if line.z.size * bins > ids.BLOCKS:
        raise BadInput(
            f"{line.z.size} steps of {bins} bins of mass are more blocks than identifiers have: {ids.BLOCKS}"
        )
    at_edge = np.exp(masses.interpolate(masses.ln_density, line.z, edge))
    # Where nothing is left of the mass function, the logarithm of what is left has no meaning.
    ratio = np.maximum(np.log(np.maximum(at_edge[:, :-1], 1e-300) / np.maximum(at_edge[:, 1:], 1e-300)), 1e-6)
    number = low["bin"] * (at_edge[:, :-1] - at_edge[:, 1:]) / ratio
    x = masses.interpolate(masses.bias, line.z, edge[:-1] + 0.5 * low["bin"])
    x = x * density_box.growth(line.z)[:, None]
    field, amplitude = density_box.biased(box.model, x)
    return HaloModel(
        box=box,
        turned=lightcone.replicas(box, float(line.edge[-1])),
        distances=table,
        line=line,
        log_mass=edge,
        number=number,
        ratio=ratio,
        x=x,
        field=field,
        amplitude=amplitude,
        level=levels(masses.radius(edge[1:])[None, :] / line.edge[:-1, None]),
        limit=matching.mass_of(line.z, faintest(line.z)),
        far=float(cosmology.comoving_distance(space.z_max)),
        matching=matching,
    )


def _line(cell: float, near: float) -> tuple[Steps, Distances]:
    """Steps of `cell` Mpc/h from `near` to a step behind the tables' last redshift, and the distances of these."""
    last = (np.ceil(float(cosmology.comoving_distance(Z_LAST)) / cell) + 1.0) * cell
    table = lightcone.distances(float(cosmology.redshift(last)) + 1e-6)
    return lightcone.steps(cell, near, float(last), table), table


def reach(order: int) -> float:
    """Angle, rad, that certainly does not lead from a cell beyond the cells about it."""
    return float(_APART * np.radians(np.sqrt(sky.cell_area(order))))


def draw(halos: HaloModel, seed: int, order: int, cell: int, least: Float | None = None) -> Halos:
    """Halos of one level in a nested cell of its order, a Poisson sample of the biased field.

    halos : tables of `model`;  seed : of the request;  order, cell : of the nested cell
    least : [s] log10 of the mass from which on all halos are wanted, infinite where none are, whatever the limit;
            None = those that may hold galaxies of the request: a satellite, or a central above `mass_limit`
    """
    occupation, lowest = halos.matching.occupation, halos.lowest
    used = halos.drawn(lowest - occupation.depth if least is None else least) & (halos.level == order)
    space = lightcone.voxels(halos.box, halos.turned, halos.line, order, cell, used.any(1))
    # Either is enough; of wide cells all halos are numbered.
    wanted = (lowest + halos.host_offset, lowest) if least is None else (least, least)
    wanted = wanted if order == GENERATION_ORDER else (np.full(lowest.size, -np.inf), lowest)
    voxel, column, which, place, numbers = _blocks(
        halos, used, space, wanted, int(keyed.keys(np.array([cell]), seed, "halos", order)[0])
    )
    step = space.step[voxel]
    fall, width = halos.ratio[step, column], halos.log_mass[1] - halos.log_mass[0]
    # Inside a bin dn/dlogM falls exponentially.
    log_mass = halos.log_mass[column] - width * np.log1p(numbers[:, 1] * np.expm1(-fall)) / fall
    proxy = log_mass + occupation.scatter * numbers[:, 2]
    near, far = halos.line.edge[step], halos.line.edge[step + 1]
    chi = np.cbrt(near**3 + numbers[:, 0] * (far**3 - near**3))
    shift = 2 * (sky.DEEPEST - space.order[voxel])
    index = (space.cell[voxel] << shift) | (place >> np.uint64(2)).astype(np.int64) & ((np.int64(1) << shift) - 1)
    factor = density_box.velocity_factor(halos.box.model, halos.line.z)
    own, bits = _identifiers(halos, step, column, index, which if order == GENERATION_ORDER else None)
    found = Halos(index, chi, log_mass, proxy, factor[step] * space.velocity[voxel], own, bits)
    if least is None:
        limit = halos.mass_limit(chi)
        kept = (log_mass >= limit + halos.host_offset) | (proxy >= limit)
    else:
        kept = log_mass >= least[step]
    row = np.flatnonzero(kept)
    return found.part(row[np.lexsort((own[row], index[row]))])


def levels(wide: Float) -> Int:
    """Order of the cells that draw a halo whose radius spans this angle, rad; -1 where it spans more than any.

    wide : float[...] rad
    """
    level = np.full(wide.shape, -1)
    for order in sorted(LEVELS):
        level[wide < reach(order)] = order
    return level


def _blocks(
    halos: HaloModel, used: Bool, space: Voxels, wanted: tuple[Float, Float], key: int
) -> tuple[Int, Int, Int, npt.NDArray[np.uint64], Float]:
    """(voxel[n], mass bin[n], number in the block[n], random bits[n], [n, 3] numbers) of halos, block after block.

    wanted : [s] log10 of mass and proxy of which either is enough
    """
    steps, first = np.unique(space.step, return_index=True)
    first = np.append(first, space.step.size)
    amplitude, field = halos.amplitude[steps], halos.field[steps]
    volume = np.pi / 3.0 * halos.line.volume[steps] / 4.0 ** space.order[first[:-1]]
    with np.errstate(divide="ignore"):
        ln_number = np.log(halos.number[steps] * volume[:, None]) - 0.5 * amplitude**2 * halos.box.variance[field]
    g = np.stack([smooth.ravel()[space.box] for smooth in halos.box.smoothed], 1)
    tables = (ln_number, amplitude, field, g)
    number = compiled_halos.counts(np.uint64(key), first, steps, used[steps], *tables)
    n = int(number.sum())
    out = (*np.empty((4, n), np.int64), np.empty(n, np.uint64), np.empty((n, 3)))
    own = halos.matching.occupation
    limits = halos.log_mass[1:], *(limit[steps] for limit in wanted), own.scatter, own.depth / own.scatter
    found = slice(compiled_halos.halos(np.uint64(key), first, steps, number, *tables, limits, out))
    return out[0][found], out[2][found], out[3][found], out[4][found], out[5][found]


def _identifiers(halos: HaloModel, step: Int, column: Int, index: Int, number: Int | None) -> tuple[Int, Int]:
    """(identifiers[n], bits of a member[n]) of halos; of wide cells they have no number yet, and are all of a block."""
    block, cell = step * (halos.log_mass.size - 1) + column, index >> 2 * (sky.DEEPEST - GENERATION_ORDER)
    if number is None:
        number = np.empty(block.size, np.int64)
        compiled_halos.numbered(block, cell, number)
    bits = ids.member_bits(halos.log_mass[column])
    return ids.drawn_halo_id(cell, block, number, bits), bits
