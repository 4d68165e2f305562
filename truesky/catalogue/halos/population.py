"""Who lives in a generation cell: the centrals of its halos, and the satellites that fall into it.

model       halos, their galaxies' luminosities, and the box they come from
Cells       what has been drawn of a universe so far: neighbours share it
members     halos and candidate galaxies of one generation cell

Galaxies belong to the cell of their own true position. Halos of the cells about it are drawn as well, and of their
satellites those that land inside are kept: none is lost and none is there twice. What a cell holds depends on the
seed and the cell only, never on which other cells are drawn; a nearer or shallower request has fewer of the same.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from lake_schema import ids, sky
from lake_schema.arrays import Bool, Float, Int
from lake_schema.ids import GENERATION_ORDER
from lake_schema.units import LIGHT_KM_S
from truesky.catalogue.halos import halo_catalogue, halos, matching, satellites
from truesky.catalogue.halos.halo_catalogue import LightCone
from truesky.catalogue.halos.halos import LEVELS, HaloModel, Halos
from truesky.catalogue.halos.luminosity_function import Inverse, Volume
from truesky.catalogue.halos.matching import Masses
from truesky.catalogue.halos.satellites import Satellites
from truesky.catalogue.matter import density_box

CENTRAL, SATELLITE = 0, 1
# Drawn cells that are kept: a block of cells and its rim are at most so many.
_MAX_CACHED_CELLS = 64


@dataclass(frozen=True, slots=True, eq=False)
class Population:
    """Everything that halos and luminosities are drawn from; light_cone : halos that take the place of ours."""

    seed: int
    halos: HaloModel
    masses: Masses
    light_cone: LightCone | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Members:
    """Halos of a cell, and candidate galaxies: centrals, then satellites by host, sorted by index.

    halo_id, host_mass, host_index : of each galaxy's halo, log10 M_200m / (Msun/h);  index : order-29 cell
    ra, dec : deg;  radius : from the halo's centre / R_200m, 0 of centrals
    """

    halos: Halos
    id: Int
    halo_id: Int
    kind: Int
    index: Int
    ra: Float
    dec: Float
    chi: Float
    z: Float
    z_obs: Float
    proxy: Float
    host_mass: Float
    host_index: Int
    radius: Float

    def select(self, keep: Bool) -> Members:
        """The same halos, and the galaxies that are kept: keep : bool[n]."""
        columns = (getattr(self, name)[keep] for name in self.__slots__ if name != "halos")
        return Members(self.halos, *columns)


@dataclass(slots=True, eq=False)
class CellCache:
    """Cells of one population that have been drawn: (order, cell) -> halos and all their satellites.

    lenses : what halos of (order, cell) above a mass do to light
    """

    population: Population
    drawn: OrderedDict[tuple[int, int], tuple[Halos, Satellites]] = field(default_factory=OrderedDict)
    lenses: OrderedDict[tuple[int, int, float], tuple[Float, Int]] = field(default_factory=OrderedDict)

    def halos_and_satellites(self, order: int, cell: int) -> tuple[Halos, Satellites]:
        """Halos drawn by a cell of a level, and their satellites, wherever these are."""
        place = (order, cell)
        if place not in self.drawn:
            population = self.population
            if population.light_cone is None:
                hosts = halos.draw(population.halos, population.seed, order, cell)
            else:
                hosts = halo_catalogue.draw(
                    population.halos, population.masses, population.light_cone, population.seed, order, cell
                )
            self.drawn[place] = hosts, satellites.draw(population.halos, population.masses, hosts, population.seed)
            if len(self.drawn) > _MAX_CACHED_CELLS:
                self.drawn.popitem(last=False)
        self.drawn.move_to_end(place)
        return self.drawn[place]


def model(
    seed: int,
    box_cells: int,
    volume: Volume,
    luminosities: Inverse,
    faintest: Callable[[Float], Float],
    light_cone: LightCone | None = None,
) -> Population:
    """The population of a seed.

    faintest   : z[n] -> faintest M_r[n] that is wanted; the volume's own limit holds as well
    light_cone : halos that take the place of ours
    seed, box_cells : of the box of matter, and its cells a side;  space : redshifts, and the faintest M_r
    luminosities    : inverse of the luminosity function
    """
    masses = matching.masses()
    matched = matching.match_luminosities(masses, luminosities)

    def faintest_drawn(z: Float) -> Float:
        return np.minimum(faintest(z), volume.m_faintest)

    box = density_box.load(seed, box_cells)
    halo_model = halos.model(box, volume, masses, matched, faintest_drawn)
    return Population(seed, halo_model, masses, light_cone)


def halos_of(cells: CellCache, cell: int) -> Halos:
    """Halos of the request that lie in a generation cell, sorted by position.

    cells : what has been drawn;  cell : nested index at order 8
    """
    selected, max_distance = [], cells.population.halos.max_distance
    for order in LEVELS:
        hosts, _ = cells.halos_and_satellites(order, cell >> 2 * (GENERATION_ORDER - order))
        selected.append(
            hosts.select((hosts.index >> 2 * (sky.MAX_ORDER - GENERATION_ORDER) == cell) & (hosts.chi < max_distance))
        )
    combined = Halos(*(np.concatenate([getattr(part, name) for part in selected]) for name in Halos.__slots__))
    return combined.select(np.lexsort((combined.id, combined.index)))


def members(cells: CellCache, cell: int, is_requested: Callable[[int, int], bool] | None = None) -> Members:
    """Halos and candidate galaxies of one generation cell.

    cells  : what has been drawn;  cell : nested index at order 8
    wanted : (order, cell) of what draws halos -> are their satellites wanted? None = all
    """
    cell_halos = halos_of(cells, cell)
    bright = cell_halos.select(cell_halos.proxy >= cells.population.halos.mass_limit(cell_halos.chi))
    places = [(order, neighbour) for order in LEVELS for neighbour in _cells_around(order, cell)]
    places = places if is_requested is None else [place for place in places if is_requested(*place)]
    satellite_columns = [_satellites_inside(cells, *place, cell) for place in places]
    ra, dec = sky.positions_of_indices(bright.index)
    central_columns = (
        bright.id,
        bright.id,
        bright.index,
        ra,
        dec,
        bright.chi,
        bright.velocity,
        bright.proxy,
        bright.log_mass,
        bright.index,
    )
    central = (*central_columns, np.zeros(bright.chi.size))
    columns = [np.concatenate(column) for column in zip(central, *satellite_columns, strict=True)]
    order = np.lexsort((columns[0], columns[2]))
    source, halo_id, index, ra, dec, chi, velocity, proxy, mass, host_index, radius = (
        column[order] for column in columns
    )
    z = cells.population.halos.distances.redshift(chi)
    z_obs = observed_redshift(z, velocity)
    kind = ids.kind_from_id(source)
    return Members(cell_halos, source, halo_id, kind, index, ra, dec, chi, z, z_obs, proxy, mass, host_index, radius)


def observed_redshift(z: Float, velocity: Float) -> Float:
    """[n] of sources that recede with a peculiar velocity, km/s.

    z : float[n] true redshift;  velocity : float[n] km/s
    """
    return np.asarray((1.0 + z) * (1.0 + velocity / LIGHT_KM_S) - 1.0)


def _cells_around(order: int, cell: int) -> list[int]:
    parent_cell = cell >> 2 * (GENERATION_ORDER - order)
    return [parent_cell, *sky.margin_cells(order, parent_cell, order).tolist()]


def _satellites_inside(cells: CellCache, order: int, host_cell: int, cell: int) -> tuple[npt.NDArray[np.generic], ...]:
    """Satellites of one cell's halos that lie in the generation cell: the columns of `members`."""
    hosts, candidates = cells.halos_and_satellites(order, host_cell)
    model = cells.population.halos
    candidates = candidates.select(
        _may_be_inside(candidates, cell)
        & (candidates.chi > model.steps.edge[0])
        & (candidates.chi < model.max_distance)
    )
    index = sky.healpix_29(candidates.ra, candidates.dec)
    inside = index >> 2 * (sky.MAX_ORDER - GENERATION_ORDER) == cell
    candidates, index = candidates.select(inside), index[inside]
    halo = hosts.id[candidates.host]
    source = ids.satellite_id(halo, candidates.member, hosts.bits[candidates.host])
    mass, host_index = hosts.log_mass[candidates.host], hosts.index[candidates.host]
    place = candidates.ra, candidates.dec, candidates.chi
    return source, halo, index, *place, candidates.velocity, candidates.proxy, mass, host_index, candidates.radius


def _may_be_inside(candidates: Satellites, cell: int) -> Bool:
    """Satellites that may lie in the cell: no further from its centre than its corners."""
    ra, dec = sky.cell_centre(GENERATION_ORDER, cell)
    radius = sky.cell_radius(GENERATION_ORDER)
    return np.asarray(sky.separation(candidates.ra, candidates.dec, ra, dec) <= 1.001 * radius)
