"""Draw the halos of one generation cell (HEALPix cell of order 8), and the galaxies whose true positions are inside it.

The galaxies in halos are called members: central galaxies and satellites. The halos of neighbouring cells are drawn as
well, and their satellites inside the cell are kept, so every satellite is in exactly one cell. A cell has the same
halos and galaxies whatever other cells are drawn; they depend on the seed and the number of the cell. A catalogue with
a smaller redshift range or a brighter limit contains a subset of them.
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
from truesky.catalogue.matter import density_box, fine_structure
from truesky.catalogue.matter.fine_convergence import FineMatter
from truesky.cosmology import Cosmology

CENTRAL, SATELLITE = 0, 1
# Largest number of HEALPix cells whose halos are kept in memory, enough for neighbouring cells drawn one after another.
_MAX_CACHED_CELLS = 64


@dataclass(frozen=True, slots=True, eq=False)
class Population:
    """Model of the halos, and of the luminosities of the galaxies in them.

    Attributes
    ----------
    seed : int
        Seed of all random numbers.
    halos : HaloModel
        Tables from which halos are drawn, and the limits of the catalogue.
    masses : Masses
        Abundance, bias and concentration of halos by mass and redshift.
    light_cone : LightCone or None
        The user's halos, which replace the drawn halos; None to draw halos.
    """

    seed: int
    halos: HaloModel
    masses: Masses
    light_cone: LightCone | None = None

    @property
    def cosmology(self) -> Cosmology:
        """Return the parameters of the universe."""
        return self.masses.cosmology


@dataclass(frozen=True, slots=True, eq=False)
class Members:
    """Halos of an order-8 cell, and the galaxies in halos (members) whose true positions are in the cell.

    Galaxies are sorted by position. Their magnitudes and colours are drawn later, so some are too faint for the
    catalogue.

    Attributes
    ----------
    halos : Halos
        Halos whose centres are in the cell.
    id, halo_id : int array, shape (n,)
        Identifiers of the galaxy and of its halo.
    kind : int array, shape (n,)
        CENTRAL or SATELLITE.
    index : int array, shape (n,)
        True position: nested index of the HEALPix cell of order 29.
    ra, dec : float array, shape (n,)
        True position, deg.
    chi : float array, shape (n,)
        Comoving distance, Mpc/h.
    z, z_obs : float array, shape (n,)
        Redshift without and with the peculiar velocity.
    proxy : float array, shape (n,)
        log10 of the proxy mass (Msun/h), which determines the luminosity: mass of the halo (central galaxies) or of the
        sub-halo (satellites) with a scatter.
    host_mass : float array, shape (n,)
        log10 M_200m / (Msun/h) of the halo.
    host_index : int array, shape (n,)
        Position of the halo: nested index of the HEALPix cell of order 29.
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
        """Return the same halos, with the galaxies for which the mask `keep`, shape (n,), is True."""
        columns = (getattr(self, name)[keep] for name in self.__slots__ if name != "halos")
        return Members(self.halos, *columns)


@dataclass(slots=True, eq=False)
class CellCache:
    """Halos that are already drawn, kept in memory because neighbouring cells need the same halos.

    Attributes
    ----------
    population : Population
        Model from which halos are drawn.
    drawn : OrderedDict
        Halos drawn in a HEALPix cell and all their satellites, by (order, nested index). The most recently used cells
        are last.
    lenses : OrderedDict
        Table and identifiers of the halos that lens, by (order, nested index, log10 of the lowest mass in Msun/h).
    matter : FineMatter or None
        Matter that lenses in addition to halos and the box; None until it is first needed.
    """

    population: Population
    drawn: OrderedDict[tuple[int, int], tuple[Halos, Satellites]] = field(default_factory=OrderedDict)
    lenses: OrderedDict[tuple[int, int, float], tuple[Float, Int]] = field(default_factory=OrderedDict)
    matter: FineMatter | None = None

    def halos_and_satellites(self, order: int, cell: int) -> tuple[Halos, Satellites]:
        """Return the halos drawn in a HEALPix cell of order 8, 5 or 2, and all their satellites.

        The halos of a larger order have smaller angular radii. Satellites may be in neighbouring cells.
        """
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
    cosmology: Cosmology,
    box_cells: int,
    volume: Volume,
    luminosities: Inverse,
    faintest: Callable[[Float], Float],
    light_cone: LightCone | None = None,
    *,
    structure_below_cells: bool = True,
) -> Population:
    """Return the model from which the halos of a seed, and the galaxies in them, are drawn.

    Parameters
    ----------
    seed : int
        Seed of the simulated matter and of all halos and galaxies.
    cosmology : Cosmology
        Parameters of the universe.
    box_cells : int
        Cells per side of the box of simulated matter, an even number.
    volume : Volume
        Redshift range, and the faintest absolute magnitude.
    luminosities : Inverse
        Table of luminosity by cumulative number density (inverse of the luminosity function).
    faintest : callable
        Function that returns the faintest absolute magnitude M_r (0.1r for h = 1) of the catalogue at redshifts. The
        limit of `volume` also applies.
    light_cone : LightCone, optional
        The user's halos, which replace the drawn halos; None to draw halos.
    structure_below_cells : bool, optional
        True if the density of halos has structure below the cells of the box, False for random positions in voxels.

    Returns
    -------
    Population
        The model.
    """
    masses = matching.masses(cosmology)
    matched = matching.match_luminosities(masses, luminosities)

    def faintest_drawn(z: Float) -> Float:
        return np.minimum(faintest(z), volume.m_faintest)

    box = density_box.load(seed, box_cells, cosmology)
    fine = fine_structure.model(seed) if structure_below_cells else None
    halo_model = halos.model(box, volume, masses, matched, faintest_drawn, fine)
    return Population(seed, halo_model, masses, light_cone)


def halos_of(cells: CellCache, cell: int) -> Halos:
    """Return the halos of the catalogue whose positions are in the order-8 cell with nested index `cell`.

    They are sorted by position, then by identifier.
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
    """Return the halos in one generation cell (HEALPix cell of order 8), and the galaxies in halos inside the cell.

    Parameters
    ----------
    cells : CellCache
        Cache of the halos that are already drawn, by HEALPix cell.
    cell : int
        Nested index of the order-8 cell.
    is_requested : callable, optional
        Function of (order, nested index) that returns True if the satellites of the halos drawn in that HEALPix cell
        are needed. None for all cells.

    Returns
    -------
    Members
        Halos, and central galaxies and satellites that may be bright enough for the catalogue.
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
    """Return the satellites in the order-8 cell `cell` of the halos that are drawn in the cell (order, host_cell).

    Return them as arrays: identifier, identifier of the halo, position (order-29 cell), ra and dec (deg), comoving
    distance (Mpc/h), velocity (km/s), log10 proxy mass, log10 mass and position of the halo, and distance from its
    centre (R_200m).
    """
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
    """Return True for satellites that are not farther from the centre of an order-8 cell than its corners."""
    ra, dec = sky.cell_centre(GENERATION_ORDER, cell)
    radius = sky.cell_radius(GENERATION_ORDER)
    return np.asarray(sky.separation(candidates.ra, candidates.dec, ra, dec) <= 1.001 * radius)
