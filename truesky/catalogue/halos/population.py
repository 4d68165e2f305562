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
_KEPT = 64


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

    def part(self, keep: Bool) -> Members:
        """The same halos, and the galaxies that are kept: keep : bool[n]."""
        columns = (getattr(self, name)[keep] for name in self.__slots__ if name != "halos")
        return Members(self.halos, *columns)


@dataclass(slots=True, eq=False)
class Cells:
    """Cells of one population that have been drawn: (order, cell) -> halos and all their satellites.

    lenses : what halos of (order, cell) above a mass do to light
    """

    population: Population
    drawn: OrderedDict[tuple[int, int], tuple[Halos, Satellites]] = field(default_factory=OrderedDict)
    lenses: OrderedDict[tuple[int, int, float], tuple[Float, Int]] = field(default_factory=OrderedDict)

    def at(self, order: int, cell: int) -> tuple[Halos, Satellites]:
        """Halos drawn by a cell of a level, and their satellites, wherever these are."""
        place = (order, cell)
        if place not in self.drawn:
            own = self.population
            if own.light_cone is None:
                hosts = halos.draw(own.halos, own.seed, order, cell)
            else:
                hosts = halo_catalogue.draw(own.halos, own.masses, own.light_cone, own.seed, order, cell)
            self.drawn[place] = hosts, satellites.draw(own.halos, own.masses, hosts, own.seed)
            if len(self.drawn) > _KEPT:
                self.drawn.popitem(last=False)
        self.drawn.move_to_end(place)
        return self.drawn[place]


def model(
    seed: int,
    box_cells: int,
    space: Volume,
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
    matched = matching.matching(masses, luminosities)

    def wanted(z: Float) -> Float:
        return np.minimum(faintest(z), space.m_faintest)

    box = density_box.load(seed, box_cells)
    drawn_from = halos.model(box, space, masses, matched, wanted)
    return Population(seed, drawn_from, masses, light_cone)


def halos_of(cells: Cells, cell: int) -> Halos:
    """Halos of the request that lie in a generation cell, sorted by position.

    cells : what has been drawn;  cell : nested index at order 8
    """
    own, far = [], cells.population.halos.far
    for order in LEVELS:
        hosts, _ = cells.at(order, cell >> 2 * (GENERATION_ORDER - order))
        own.append(hosts.part((hosts.index >> 2 * (sky.DEEPEST - GENERATION_ORDER) == cell) & (hosts.chi < far)))
    together = Halos(*(np.concatenate([getattr(part, name) for part in own]) for name in Halos.__slots__))
    return together.part(np.lexsort((together.id, together.index)))


def members(cells: Cells, cell: int, wanted: Callable[[int, int], bool] | None = None) -> Members:
    """Halos and candidate galaxies of one generation cell.

    cells  : what has been drawn;  cell : nested index at order 8
    wanted : (order, cell) of what draws halos -> are their satellites wanted? None = all
    """
    own = halos_of(cells, cell)
    lit = own.part(own.proxy >= cells.population.halos.mass_limit(own.chi))
    places = [(order, around) for order in LEVELS for around in _around(order, cell)]
    places = places if wanted is None else [place for place in places if wanted(*place)]
    landed = [_landed(cells, *place, cell) for place in places]
    ra, dec = sky.positions(lit.index)
    own_columns = (lit.id, lit.id, lit.index, ra, dec, lit.chi, lit.velocity, lit.proxy, lit.log_mass, lit.index)
    central = (*own_columns, np.zeros(lit.chi.size))
    columns = [np.concatenate(column) for column in zip(central, *landed, strict=True)]
    order = np.lexsort((columns[0], columns[2]))
    source, halo_id, index, ra, dec, chi, velocity, proxy, mass, home, radius = (column[order] for column in columns)
    z = cells.population.halos.distances.redshift(chi)
    z_obs = observed_redshift(z, velocity)
    kind = ids.kind_of(source)
    return Members(own, source, halo_id, kind, index, ra, dec, chi, z, z_obs, proxy, mass, home, radius)


def observed_redshift(z: Float, velocity: Float) -> Float:
    """[n] of sources that recede with a peculiar velocity, km/s.

    z : float[n] true redshift;  velocity : float[n] km/s
    """
    return np.asarray((1.0 + z) * (1.0 + velocity / LIGHT_KM_S) - 1.0)


def _around(order: int, cell: int) -> list[int]:
    own = cell >> 2 * (GENERATION_ORDER - order)
    return [own, *sky.margin_cells(order, own, order).tolist()]


def _landed(cells: Cells, order: int, around: int, cell: int) -> tuple[npt.NDArray[np.generic], ...]:
    """Satellites of one cell's halos that lie in the generation cell: the columns of `members`."""
    hosts, found = cells.at(order, around)
    model = cells.population.halos
    found = found.part(_near(found, cell) & (found.chi > model.line.edge[0]) & (found.chi < model.far))
    index = sky.healpix_29(found.ra, found.dec)
    inside = index >> 2 * (sky.DEEPEST - GENERATION_ORDER) == cell
    found, index = found.part(inside), index[inside]
    halo = hosts.id[found.host]
    source = ids.satellite_id(halo, found.member, hosts.bits[found.host])
    mass, home = hosts.log_mass[found.host], hosts.index[found.host]
    place = found.ra, found.dec, found.chi
    return source, halo, index, *place, found.velocity, found.proxy, mass, home, found.radius


def _near(found: Satellites, cell: int) -> Bool:
    """Satellites that may lie in the cell: no further from its centre than its corners."""
    ra, dec = sky.cell_centre(GENERATION_ORDER, cell)
    radius = sky.cell_radius(GENERATION_ORDER)
    return np.asarray(sky.separation(found.ra, found.dec, ra, dec) <= 1.001 * radius)
