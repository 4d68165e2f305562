"""Halos of the embedded universe: abundance, bias, and draws in the voxels of a cell of the sky.

model       every table that the draws need
draw        halos of one cell of one level
limits      the mass from which halos are drawn, against redshift

A halo belongs to one of three levels, by the angle that its radius spans.  Halos of a level are drawn by the cells
of its order, so that the satellites of a halo end in its cell or in one of the cells about it: near and massive
halos, which span degrees, by wide cells.
Ref: Tinker et al. 2008, 2010; the numbers are in halos.toml.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from jobs.catalogue import parameters
from jobs.catalogue.halos.matching import Masses, Matching
from jobs.catalogue.matter import density_box, lightcone
from jobs.catalogue.matter.density_box import Box
from jobs.catalogue.matter.lightcone import Distances, Replicas, Steps, Voxels
from jobs.fluxes import cosmology
from jobs.rng import stream
from lake_schema import sky
from lake_schema.arrays import Bool, Float, Int
from lake_schema.ids import GENERATION_ORDER

LEVELS = (GENERATION_ORDER, 5, 2)
# Any two cells of an order that do not touch are further apart than this, in units of the side of a cell.
_APART = 0.5
# Where the running numbers of a level begin (22 bits in all).
FIRST_NUMBER = {LEVELS[0]: 0, LEVELS[1]: 1 << 21, LEVELS[2]: (1 << 21) + (1 << 20)}
# Radial steps whose voxels are drawn together: few enough that they share their mass bins.
_STEPS_A_BLOCK = 64
# Random bits of a position inside a cell.
_BITS = 62


@dataclass(frozen=True, slots=True, eq=False)
class HaloModel:
    """What halos are drawn from.

    line    : radial steps;  log_mass : [bins + 1] edges
    number  : [s, bins] comoving (Mpc/h)^-3 in a bin;  ratio : [s, bins] ln of the density at its edges, low / high
    x       : [s, bins] bias times growth;  field, amplitude : int[s, bins] which smoothed field, and how much of it
    level   : int[s, bins] order of the cells that a halo of this bin is drawn by, -1 = not drawn
    limit   : [s] log10 of the proxy mass of the faintest galaxy;  depth, scatter : dex
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
    matching: Matching

    def mass_limit(self, chi: Float) -> Float:
        """log10 of the proxy mass[n] of the faintest galaxy at chi[n]."""
        return np.asarray(np.interp(chi, self.line.middle, self.limit))


@dataclass(frozen=True, slots=True, eq=False)
class Halos:
    """n halos, sorted by index.

    index : order-29 cell;  chi : Mpc/h;  velocity : km/s, receding;  log_mass : log10 M_200m / (Msun/h)
    proxy : log_mass with the scatter that its central has
    """

    index: Int
    chi: Float
    log_mass: Float
    proxy: Float
    velocity: Float
    number: Int

    def part(self, keep: npt.NDArray[np.generic]) -> Halos:
        """The halos that are kept: keep : bool or int[m] rows."""
        return Halos(*(getattr(self, name)[keep] for name in self.__slots__))


def model(
    box: Box, near: float, far: float, masses: Masses, matching: Matching, faintest: Callable[[Float], Float]
) -> HaloModel:
    """Tables of halos between two redshifts.

    faintest : z[n] -> the faintest M_r[n] that is wanted there
    box              : of matter;  near, far : redshifts
    masses, matching : tables of halos by mass, and of luminosities by mass
    """
    table = lightcone.distances(far)
    line = lightcone.steps(box.model.cell, float(cosmology.comoving_distance(near)), float(table.chi[-1]), table)
    low = parameters.section("halos.toml", "mass_function")
    bins = round((low["highest"] - low["lowest"]) / low["bin"])
    edge = low["lowest"] + low["bin"] * np.arange(bins + 1)
    at_edge = np.exp(masses.interpolate(masses.ln_density, line.z, edge))
    ratio = np.maximum(np.log(at_edge[:, :-1] / at_edge[:, 1:]), 1e-6)
    number = low["bin"] * (at_edge[:, :-1] - at_edge[:, 1:]) / ratio
    limit = matching.mass_of(line.z, faintest(line.z))
    depth = matching.occupation.depth
    x = masses.interpolate(masses.bias, line.z, edge[:-1] + 0.5 * low["bin"])
    x = x * density_box.growth(line.z)[:, None]
    field, amplitude = density_box.biased(box.model, x)
    wide = masses.radius(edge[1:])[None, :] / line.edge[:-1, None]
    level = levels(wide)
    level[edge[None, 1:] < limit[:, None] - depth] = -1
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
        level=level,
        limit=limit,
        matching=matching,
    )


def reach(order: int) -> float:
    """Angle, rad, that certainly does not lead from a cell beyond the cells about it."""
    return float(_APART * np.radians(np.sqrt(sky.cell_area(order))))


def draw(halos: HaloModel, seed: int, order: int, cell: int) -> Halos:
    """Halos of one level in a nested cell of its order, a Poisson sample of the biased field.

    Kept are those above the mass limit, and those below it whose central is scattered above it.
    halos : tables of `model`;  seed : of the request;  order, cell : of the nested cell
    """
    used = halos.level == order
    space = lightcone.voxels(halos.box, halos.turned, halos.line, order, cell, used.any(1))
    rng = stream(seed, "halos", order, cell)
    voxel, column = _occupied(halos, used, space, rng)
    step = space.step[voxel]
    log_mass, proxy, kept = _masses(halos, step, column, rng)
    voxel, step, log_mass, proxy = voxel[kept], step[kept], log_mass[kept], proxy[kept]
    chi = _between(halos.line.edge[step], halos.line.edge[step + 1], rng.random(step.size))
    shift = 2 * (sky.DEEPEST - space.order[voxel])
    offset = rng.integers(0, 1 << _BITS, step.size, dtype=np.int64) & ((np.int64(1) << shift) - 1)
    index = (space.cell[voxel] << shift) | offset
    factor = density_box.velocity_factor(halos.box.model, halos.line.z)
    velocity = factor[step] * space.velocity[voxel]
    row = np.lexsort((chi, index))
    number = FIRST_NUMBER[order] + np.arange(row.size)
    return Halos(index[row], chi[row], log_mass[row], proxy[row], velocity[row], number)


def levels(wide: Float) -> Int:
    """Order of the cells that draw a halo whose radius spans this angle, rad; -1 where it spans more than any.

    wide : float[...] rad
    """
    level = np.full(wide.shape, -1)
    for order in sorted(LEVELS):
        level[wide < reach(order)] = order
    return level


def _occupied(halos: HaloModel, used: Bool, space: Voxels, rng: np.random.Generator) -> tuple[Int, Int]:
    """(voxel[n], mass bin[n]) of the halos."""
    pieces = [_block(halos, used, space, rng, rows) for rows in _blocks(space.step)]
    none = np.zeros(0, np.int64)
    return np.concatenate([none, *(p[0] for p in pieces)]), np.concatenate([none, *(p[1] for p in pieces)])


def _blocks(step: Int) -> list[slice]:
    """Rows of voxels, which are sorted by step within an order, in stretches of neighbouring steps."""
    change = np.flatnonzero(np.diff(step // _STEPS_A_BLOCK)) + 1
    edges = [0, *change.tolist(), step.size]
    return [slice(first, last) for first, last in pairwise(edges) if last > first]


def _block(halos: HaloModel, used: Bool, space: Voxels, rng: np.random.Generator, rows: slice) -> tuple[Int, Int]:
    """Halos of some voxels: a Poisson number, spread over voxels and bins by their means."""
    first, last = int(space.step[rows].min()), int(space.step[rows].max()) + 1
    columns = np.flatnonzero(used[first:last].any(0))
    cut = (slice(first, last), slice(columns[0], columns[-1] + 1))
    amplitude, field = halos.amplitude[cut].astype(np.float32), halos.field[cut]
    with np.errstate(divide="ignore"):
        ln_number = np.log(np.where(used[cut], halos.number[cut], 0.0)) - 0.5 * amplitude**2 * halos.box.variance[field]
    ln_number += np.log(np.pi / 3.0 * halos.line.volume[first:last])[:, None]
    step, box = space.step[rows] - first, space.box[rows]
    g = np.stack([smooth.ravel()[box] for smooth in halos.box.smoothed], 1)
    exponent = amplitude[step] * np.take_along_axis(g, field[step], 1)
    exponent += ln_number.astype(np.float32)[step]
    exponent -= (np.log(4.0) * space.order[rows]).astype(np.float32)[:, None]
    total = np.cumsum(np.exp(exponent), dtype=float)
    where = np.searchsorted(total, np.sort(rng.random(rng.poisson(total[-1]))) * total[-1], side="right")
    voxel, column = np.divmod(np.minimum(where, total.size - 1), columns[-1] + 1 - columns[0])
    return voxel + rows.start, column + columns[0]


def _masses(halos: HaloModel, step: Int, column: Int, rng: np.random.Generator) -> tuple[Float, Float, Bool]:
    """Masses inside their bins, where dn/dlogM falls exponentially, and proxies."""
    fall = halos.ratio[step, column]
    width = halos.log_mass[1] - halos.log_mass[0]
    log_mass = halos.log_mass[column] - width * np.log1p(rng.random(step.size) * np.expm1(-fall)) / fall
    occupation = halos.matching.occupation
    proxy = log_mass + occupation.scatter * rng.standard_normal(step.size)
    limit = halos.limit[step]
    return log_mass, proxy, (log_mass >= limit) | (proxy >= limit)


def _between(near: Float, far: Float, u: Float) -> Float:
    """Distances uniform in the volume of their steps."""
    return np.asarray(np.cbrt(near**3 + u * (far**3 - near**3)))
