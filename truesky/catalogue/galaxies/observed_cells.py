"""Galaxies whose observed positions are in requested generation cells.

All galaxies with true positions in the requested cells are drawn, and galaxies observed elsewhere are removed. In the
surrounding cells only a strip is searched, as wide as the largest deflection there. Candidates that the box moves close
enough are followed through the halos; those observed inside get colours, lines and shapes.

A galaxy depends only on the cell with its true position, so that it is the same in every request. It is observed at one
position, so that it is in exactly one file.
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

# Order of the cells for which distances are computed (26 arcsec wide); finer cells would cost more time than they save.
_BORDER_ORDER = 13
# Largest deflection by halos that is supported, rad: twice the deflection of a halo of 10^15.5 Msun/h.
_MAX_HALO_DEFLECTION = float(np.radians(2.5 / 60.0))


@dataclass(frozen=True, slots=True, eq=False)
class _RequestedCells:
    """Sorted generation cells, a tree of small cells along their borders, and known distances by (order, cell)."""

    cells: Int
    border: cKDTree
    distances: dict[tuple[int, int], float] = field(default_factory=dict)

    @classmethod
    def from_cells(cls, requested: Sequence[int]) -> _RequestedCells:
        cells = np.unique(np.asarray(requested, np.int64))
        borders = [sky.border_cells(GENERATION_ORDER, cell, _BORDER_ORDER) for cell in cells.tolist()]
        return cls(cells, cKDTree(_directions(np.concatenate([*borders, np.zeros(0, np.int64)]))))

    def contains(self, index: Int) -> Bool:
        """Return True for order-29 cells inside the requested cells."""
        return np.isin(sky.parent(index, sky.MAX_ORDER, GENERATION_ORDER), self.cells)

    def min_distances(self, small_cells: Int, max_distance: float = np.inf) -> Float:
        """Return lower limits of the distances of small cells in rad, infinite beyond `max_distance`."""
        # Allow for the sizes of both small cells; a chord is never longer than its arc.
        slack = 2.0 * np.radians(sky.cell_radius(_BORDER_ORDER))
        distances, _ = self.border.query(_directions(small_cells), distance_upper_bound=max_distance + slack)
        inside = np.isin(sky.parent(small_cells, _BORDER_ORDER, GENERATION_ORDER), self.cells)
        return np.where(inside, 0.0, distances - slack)

    def is_near(self, ra: Float, dec: Float, angle: float) -> Bool:
        """Return True for all positions (deg) within an angle (rad), and for some farther ones."""
        small_cells, inverse = np.unique(sky.cell_at(ra, dec, _BORDER_ORDER), return_inverse=True)
        return np.asarray((self.min_distances(small_cells, angle) <= angle)[inverse])

    def min_distance(self, order: int, cell: int) -> float:
        """Return a tight lower limit of the distance of a nested cell of order <= 8 in rad."""
        if (order, cell) not in self.distances:
            fine = order + _BORDER_ORDER - GENERATION_ORDER
            distances, _ = self.border.query(_directions(sky.border_cells(order, cell, fine), fine))
            slack = np.radians(sky.cell_radius(fine) + sky.cell_radius(_BORDER_ORDER))
            holds = np.any(sky.parent(self.cells, GENERATION_ORDER, order) == cell)
            self.distances[order, cell] = 0.0 if holds else float(distances.min()) - slack
        return self.distances[order, cell]

    def nearest(self, cell: int) -> int:
        """Among the requested cells that touch `cell`, return the one with the nearest centre."""
        neighbours = np.intersect1d(_adjacent_cells(cell), self.cells)
        separations = sky.separation(
            *sky.cell_centre(GENERATION_ORDER, cell), *sky.cell_centres(GENERATION_ORDER, neighbours)
        )
        return int(neighbours[np.argmin(separations)])


def _directions(cells: Int, order: int = _BORDER_ORDER) -> Float:
    return sky.unit_vectors(*sky.cell_centres(order, cells))


@dataclass(frozen=True, slots=True, eq=False)
class _SkyModel:
    """Arguments of `draw` from which galaxies are drawn."""

    universe: GalaxyModel
    cells: CellCache
    dust: Float32


def draw(requested: Sequence[int], universe: GalaxyModel, cells: CellCache, dust: Float32) -> pa.Table:
    """Return table `galaxies` of generation cells, selected by observed position.

    Parameters
    ----------
    requested : sequence of int
        Nested indices of order-8 cells.
    universe : GalaxyModel
        The model.
    cells : CellCache
        Cache of the drawn halos and members.
    dust : float32 array, shape (pixels,)
        Map of the Milky Way's A(V), mag (truesky.catalogue.dust_map).

    Returns
    -------
    Table
        Rows of table `galaxies`, sorted by _healpix_29.

    Raises
    ------
    BadInput
        If light is deflected farther than supported.
    """
    region = _RequestedCells.from_cells(requested)
    tables = [GALAXIES.empty()]
    done, sky_model = set(region.cells.tolist()), _SkyModel(universe, cells, dust)
    for cell in region.cells.tolist():
        tables.append(_rows_inside(region, galaxies.draw(cell, universe, cells, dust)))
        if isinstance(universe.lens, Planes):
            # Draw adjacent cells now, while their neighbours are cached.
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
        # Galaxies come from farther away only if cells are narrow or deflections are large.
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
    """Generation cells that touch a cell."""
    neighbours: list[int] = sky.margin_cells(GENERATION_ORDER, cell, GENERATION_ORDER).tolist()
    return neighbours


def _rows_inside(region: _RequestedCells, rows: pa.Table) -> pa.Table:
    return rows.filter(pa.array(region.contains(rows["_healpix_29"].to_numpy())))


def _max_deflection(sky_model: _SkyModel, cell: int) -> float:
    """Largest deflection of light from a cell, rad."""
    planes = sky_model.universe.lens
    assert isinstance(planes, Planes)
    return lensing.max_deflection(planes, GENERATION_ORDER, cell) + _MAX_HALO_DEFLECTION


def _from_outside(cell: int, region: _RequestedCells, sky_model: _SkyModel) -> pa.Table:
    """Galaxies with true positions in an outer cell that may be observed in the requested cells."""
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
            f"at most {allowed_arcsec:.0f} are allowed"
        )
    max_deflection += lens.max_deflection - _MAX_HALO_DEFLECTION
    # Satellites of more distant halos are too far away.
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
