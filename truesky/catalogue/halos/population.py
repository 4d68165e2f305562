"""Members of a generation cell: central galaxies of its halos, and satellites whose positions are inside it.

A galaxy belongs to the cell of its true position. The halos of neighbouring cells are drawn as well, and their
satellites inside the cell are kept, so that every satellite is in exactly one cell. The content of a cell depends only
on the seed and the cell. A nearer or shallower request has a subset of it.
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
# Number of cached cells, enough for a block of cells and its neighbours.
_MAX_CACHED_CELLS = 64


@dataclass(frozen=True, slots=True, eq=False)
class Population:
    """Model of halos and luminosities; `light_cone` are the user's halos, which replace the drawn ones."""

    seed: int
    halos: HaloModel
    masses: Masses
    light_cone: LightCone | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Members:
    """Halos of a cell, and its candidate galaxies sorted by index.

    Attributes
    ----------
    halos : Halos
        Halos of the cell.
    id, halo_id : int array, shape (n,)
        Identifiers of the galaxy and of its halo.
    kind : int array, shape (n,)
        CENTRAL or SATELLITE.
    index : int array, shape (n,)
        Order-29 cell.
    ra, dec : float array, shape (n,)
        True position, deg.
    chi : float array, shape (n,)
        Comoving distance, Mpc/h.
    z, z_obs : float array, shape (n,)
        Redshift without and with the peculiar velocity.
    proxy : float array, shape (n,)
        log10 of the proxy mass, Msun/h.
    host_mass : float array, shape (n,)
        log10 M_200m / (Msun/h) of the halo.
    host_index : int array, shape (n,)
        Order-29 cell of the halo.
    radius : float array, shape (n,)
        Distance from the centre of the halo in units of R_200m, 0 for central galaxies.
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
        """Return the same halos with the galaxies of a bool mask, shape (n,)."""
        columns = (getattr(self, name)[keep] for name in self.__slots__ if name != "halos")
        return Members(self.halos, *columns)


@dataclass(slots=True, eq=False)
class CellCache:
    """Cache of drawn cells of a population, which neighbouring cells share.

    Attributes
    ----------
    population : Population
        The population.
    drawn : OrderedDict
        Halos and all their satellites by (order, cell).
    lenses : OrderedDict
        Lensing of the halos by (order, cell, lowest mass).
    """

    population: Population
    drawn: OrderedDict[tuple[int, int], tuple[Halos, Satellites]] = field(default_factory=OrderedDict)
    lenses: OrderedDict[tuple[int, int, float], tuple[Float, Int]] = field(default_factory=OrderedDict)

    def halos_and_satellites(self, order: int, cell: int) -> tuple[Halos, Satellites]:
        """Return the halos that a cell of a level draws, and all their satellites, which may be in other cells."""
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
    """Return the population of a seed.

    Parameters
    ----------
    seed : int
        Seed of the box of matter.
    box_cells : int
        Cells per side of the box.
    volume : Volume
        Redshift range, and the faintest M_r.
    luminosities : Inverse
        Inverse of the luminosity function.
    faintest : callable
        Function that returns the faintest requested M_r at each redshift; the limit of `volume` also applies.
    light_cone : LightCone, optional
        The user's halos, which replace the drawn ones.

    Returns
    -------
    Population
        The population.
    """
    masses = matching.masses()
    matched = matching.match_luminosities(masses, luminosities)

    def faintest_drawn(z: Float) -> Float:
        return np.minimum(faintest(z), volume.m_faintest)

    box = density_box.load(seed, box_cells)
    halo_model = halos.model(box, volume, masses, matched, faintest_drawn)
    return Population(seed, halo_model, masses, light_cone)


def halos_of(cells: CellCache, cell: int) -> Halos:
    """Return the halos of the request in a generation cell (nested index at order 8), sorted by position."""
    selected, max_distance = [], cells.population.halos.max_distance
    for order in LEVELS:
        hosts, _ = cells.halos_and_satellites(order, cell >> 2 * (GENERATION_ORDER - order))
        selected.append(
            hosts.select((hosts.index >> 2 * (sky.MAX_ORDER - GENERATION_ORDER) == cell) & (hosts.chi < max_distance))
        )
    combined = Halos(*(np.concatenate([getattr(part, name) for part in selected]) for name in Halos.__slots__))
    return combined.select(np.lexsort((combined.id, combined.index)))


def members(cells: CellCache, cell: int, is_requested: Callable[[int, int], bool] | None = None) -> Members:
    """Return the halos and candidate galaxies of one generation cell.

    Parameters
    ----------
    cells : CellCache
        Cache of drawn cells.
    cell : int
        Nested index of the order-8 cell.
    is_requested : callable, optional
        Function of (order, cell) that returns True if satellites of halos in that cell are needed; None for all cells.

    Returns
    -------
    Members
        Halos and galaxies.
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
    """Return the observed redshift from the true redshift and the peculiar velocity (km/s, positive if receding)."""
    return np.asarray((1.0 + z) * (1.0 + velocity / LIGHT_KM_S) - 1.0)


def _cells_around(order: int, cell: int) -> list[int]:
    parent_cell = cell >> 2 * (GENERATION_ORDER - order)
    return [parent_cell, *sky.margin_cells(order, parent_cell, order).tolist()]


def _satellites_inside(cells: CellCache, order: int, host_cell: int, cell: int) -> tuple[npt.NDArray[np.generic], ...]:
    """Columns of `members` for the satellites of one cell's halos that are in the generation cell."""
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
    """True for satellites that may be in the cell: not farther from its centre than its corners."""
    ra, dec = sky.cell_centre(GENERATION_ORDER, cell)
    radius = sky.cell_radius(GENERATION_ORDER)
    return np.asarray(sky.separation(candidates.ra, candidates.dec, ra, dec) <= 1.001 * radius)
