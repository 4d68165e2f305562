"""Galaxies by where they are seen: those of generation cells, whichever cells they are truly in.

draw   table `galaxies` of some generation cells

What is truly in the cells is drawn whole, and what is seen elsewhere is left out. Of the cells about them only a strip
is looked at, as wide as light is bent there. Of its candidates those that the box shows near enough are followed
through the halos, and those that are seen inside get colours, lines and shapes. A galaxy is drawn from its true cell
alone, so that it is the same whoever asks, and is seen in one place: none is lost or there twice, whichever files are
made.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa
from scipy.spatial import cKDTree

from lake_schema import sky
from lake_schema.arrays import Bool, Float, Float32, Int
from lake_schema.errors import BadInput
from lake_schema.ids import GENERATION_ORDER
from lake_schema.tables.galaxies import GALAXIES
from truesky.catalogue.cells import sort_rows
from truesky.catalogue.galaxies import galaxies, halo_lensing, lensing
from truesky.catalogue.galaxies.galaxies import GalaxyModel
from truesky.catalogue.galaxies.halo_lensing import Neighbourhood
from truesky.catalogue.galaxies.lensing import Planes
from truesky.catalogue.halos import halos, population
from truesky.catalogue.halos.population import CellCache

# Distances are told of cells of this order, 26" wide: finer ones would cost more than they spare.
_BORDER_ORDER = 13
# Largest deflection by halos that is allowed for, rad: twice that of a halo of 10^15.5 Msun/h.
_MAX_HALO_DEFLECTION = float(np.radians(2.5 / 60.0))


@dataclass(frozen=True, slots=True, eq=False)
class _RequestedCells:
    """Generation cells, ascending, and directions of small cells along their borders.

    known : distances told, by (order, cell)
    """

    cells: Int
    border: cKDTree
    distances: dict[tuple[int, int], float] = field(default_factory=dict)

    @classmethod
    def from_cells(cls, requested: Sequence[int]) -> _RequestedCells:
        cells = np.unique(np.asarray(requested, np.int64))
        borders = [sky.border_cells(GENERATION_ORDER, cell, _BORDER_ORDER) for cell in cells.tolist()]
        return cls(cells, cKDTree(_directions(np.concatenate([*borders, np.zeros(0, np.int64)]))))

    def contains(self, index: Int) -> Bool:
        """[n] Which order-29 places lie inside."""
        return np.isin(sky.parent(index, sky.MAX_ORDER, GENERATION_ORDER), self.cells)

    def min_distances(self, small_cells: Int, max_distance: float = np.inf) -> Float:
        """[n] No more than the distances, rad, of what lies in small cells from here; infinite beyond `most`."""
        # Both small cells are as wide as that; a chord is no longer than its arc.
        slack = 2.0 * np.radians(sky.cell_radius(_BORDER_ORDER))
        distances, _ = self.border.query(_directions(small_cells), distance_upper_bound=max_distance + slack)
        inside = np.isin(sky.parent(small_cells, _BORDER_ORDER, GENERATION_ORDER), self.cells)
        return np.where(inside, 0.0, distances - slack)

    def is_near(self, ra: Float, dec: Float, angle: float) -> Bool:
        """[n] Whichever places lie within an angle, rad, and some farther ones; ra, dec deg."""
        small_cells, inverse = np.unique(sky.cell_at(ra, dec, _BORDER_ORDER), return_inverse=True)
        return np.asarray((self.min_distances(small_cells, angle) <= angle)[inverse])

    def min_distance(self, order: int, cell: int) -> float:
        """No more than the distance, rad, of a nested cell from here, and hardly less; order <= 8."""
        if (order, cell) not in self.distances:
            fine = order + _BORDER_ORDER - GENERATION_ORDER
            distances, _ = self.border.query(_directions(sky.border_cells(order, cell, fine), fine))
            slack = np.radians(sky.cell_radius(fine) + sky.cell_radius(_BORDER_ORDER))
            holds = np.any(sky.parent(self.cells, GENERATION_ORDER, order) == cell)
            self.distances[order, cell] = 0.0 if holds else float(distances.min()) - slack
        return self.distances[order, cell]

    def nearest(self, cell: int) -> int:
        """Of the cells, that whose centre is nearest to a cell that touches one of them."""
        neighbours = np.intersect1d(_adjacent_cells(cell), self.cells)
        separations = sky.separation(
            *sky.cell_centre(GENERATION_ORDER, cell), *sky.cell_centres(GENERATION_ORDER, neighbours)
        )
        return int(neighbours[np.argmin(separations)])


def _directions(cells: Int, order: int = _BORDER_ORDER) -> Float:
    return sky.unit_vectors(*sky.cell_centres(order, cells))


@dataclass(frozen=True, slots=True, eq=False)
class _SkyModel:
    """What galaxies are drawn from (of `draw`)."""

    universe: GalaxyModel
    cells: CellCache
    dust: Float32


def draw(requested: Sequence[int], universe: GalaxyModel, cells: CellCache, dust: Float32) -> pa.Table:
    """Table `galaxies` of generation cells, sorted by _healpix_29.

    wanted : nested indices at order 8
    cells  : what has been drawn of the universe's population
    dust   : float32[pixel] mag, map of the Milky Way's A(V) (truesky.catalogue.dust_map)
    Errors : BadInput where light is deflected farther than is allowed for
    """
    region = _RequestedCells.from_cells(requested)
    tables = [GALAXIES.empty()]
    done, sky_model = set(region.cells.tolist()), _SkyModel(universe, cells, dust)
    for cell in region.cells.tolist():
        tables.append(_rows_inside(region, galaxies.draw(cell, universe, cells, dust)))
        if isinstance(universe.lens, Planes):
            # While their neighbours are still kept.
            for other in _adjacent_cells(cell):
                if other not in done and region.nearest(other) == cell:
                    done.add(other)
                    tables.append(_rows_inside(region, _from_outside(other, region, sky_model)))
    outer_cells = (
        {outer_cell for done_cell in done for outer_cell in _adjacent_cells(done_cell)} - done
        if isinstance(universe.lens, Planes)
        else set()
    )
    while outer_cells:
        # Nothing comes from so far, but where cells are narrow or light is bent most.
        done |= outer_cells
        reaching = [
            cell
            for cell in sorted(outer_cells)
            if _max_deflection(sky_model, cell) > region.min_distance(GENERATION_ORDER, cell)
        ]
        tables += [_rows_inside(region, _from_outside(cell, region, sky_model)) for cell in reaching]
        outer_cells = {outer_cell for cell in reaching for outer_cell in _adjacent_cells(cell)} - done
    return sort_rows(pa.concat_tables(tables))


def _adjacent_cells(cell: int) -> list[int]:
    """The generation cells that touch one."""
    neighbours: list[int] = sky.margin_cells(GENERATION_ORDER, cell, GENERATION_ORDER).tolist()
    return neighbours


def _rows_inside(region: _RequestedCells, rows: pa.Table) -> pa.Table:
    return rows.filter(pa.array(region.contains(rows["_healpix_29"].to_numpy())))


def _max_deflection(sky_model: _SkyModel, cell: int) -> float:
    """How far light of a cell is bent at most, rad."""
    planes = sky_model.universe.lens
    assert isinstance(planes, Planes)
    return lensing.max_deflection(planes, GENERATION_ORDER, cell) + _MAX_HALO_DEFLECTION


def _from_outside(cell: int, region: _RequestedCells, sky_model: _SkyModel) -> pa.Table:
    """Galaxies of a cell outside that may be seen inside."""
    universe, cells = sky_model.universe, sky_model.cells
    max_deflection = _max_deflection(sky_model, cell)
    lens = halo_lensing.lens_of_cell(
        universe.lens, cells, cell, lambda *place: region.min_distance(*place) - max_deflection
    )
    assert isinstance(lens, Neighbourhood)
    if lens.max_deflection > _MAX_HALO_DEFLECTION:
        deflection_arcsec, allowed_arcsec = (
            np.degrees(angle) * 3600.0 for angle in (lens.max_deflection, _MAX_HALO_DEFLECTION)
        )
        raise BadInput(
            f"table galaxies: halos may deflect light by {deflection_arcsec:.0f} arcsec, "
            f"{allowed_arcsec:.0f} are allowed for"
        )
    max_deflection += lens.max_deflection - _MAX_HALO_DEFLECTION
    # Satellites of others land too far away.
    members = population.members(
        cells, cell, lambda *place: region.min_distance(*place) <= max_deflection + halos.reach(place[0])
    )
    members = members.select(region.is_near(members.ra, members.dec, max_deflection))
    deflection = lensing.interpolate(lens.box, members.ra, members.dec, members.chi)[3:]
    members = members.select(
        region.is_near(*lensing.displace(members.ra, members.dec, *deflection), lens.max_deflection)
    )
    index = halo_lensing.columns(lens, members.ra, members.dec, members.chi)["_healpix_29"]
    members = members.select(region.contains(index))
    return galaxies.draw_members(
        cell,
        universe,
        members,
        lens,
        sky_model.dust,
        position_filter=lambda ra, dec: region.is_near(ra, dec, max_deflection),
    )
