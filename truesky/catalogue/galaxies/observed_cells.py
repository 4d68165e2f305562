"""Draw the galaxies whose observed (lensed) positions are in requested generation cells (HEALPix cells of order 8).

All galaxies with true positions in the requested cells are drawn, and galaxies observed elsewhere are removed. Lensing
also moves galaxies from the surrounding cells into the requested cells. There, only a strip is searched, as wide as the
largest deflection. Lensing by the large-scale matter is computed first. Galaxies that are then close enough are also
lensed by halos. Galaxies observed inside the requested cells get colours, emission lines and shapes.

The properties of a galaxy depend only on the cell with its true position, so they are the same in every request. Each
galaxy has one observed position, so it is in exactly one file.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import pyarrow as pa
import scipy

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
from truesky.numerics import activity

# HEALPix order (cells 26 arcsec wide) in which distances from the borders of the requested cells are computed. Finer
# cells would cost more time than they save.
_BORDER_ORDER = 13
# Largest deflection by halos that is supported, rad: twice the deflection by a halo of 10^15.5 Msun/h.
_MAX_HALO_DEFLECTION = float(np.radians(2.5 / 60.0))


@dataclass(frozen=True, slots=True, eq=False)
class _RequestedCells:
    """The requested generation cells (HEALPix cells of order 8), with functions for distances from them.

    Attributes
    ----------
    cells : int array
        Nested indices, sorted.
    border : cKDTree
        Search tree of the directions of the small cells (order 13) along the borders of all cells.
    distances : dict
        Distances that `min_distance` has computed, by (order, cell).
    """

    cells: Int
    border: scipy.spatial.cKDTree
    distances: dict[tuple[int, int], float] = field(default_factory=dict)

    @classmethod
    def from_cells(cls, requested: Sequence[int]) -> _RequestedCells:
        cells = np.unique(np.asarray(requested, np.int64))
        borders = [sky.border_cells(GENERATION_ORDER, cell, _BORDER_ORDER) for cell in cells.tolist()]
        return cls(cells, scipy.spatial.cKDTree(_directions(np.concatenate([*borders, np.zeros(0, np.int64)]))))

    def contains(self, index: Int) -> Bool:
        """Return True for positions inside the requested cells; positions are nested indices of order-29 cells."""
        return np.isin(sky.parent(index, sky.MAX_ORDER, GENERATION_ORDER), self.cells)

    def min_distances(self, small_cells: Int, max_distance: float = np.inf) -> Float:
        """Return lower limits of the distances (rad) of order-13 cells from the requested cells.

        The distance is 0 for cells inside, and infinite for cells farther than `max_distance` (rad).
        """
        # Subtract the sizes of two small cells, because the tree contains only their centres. The tree measures chords,
        # which are never longer than the arcs.
        slack = 2.0 * np.radians(sky.cell_radius(_BORDER_ORDER))
        distances, _ = self.border.query(_directions(small_cells), distance_upper_bound=max_distance + slack)
        inside = np.isin(sky.parent(small_cells, _BORDER_ORDER, GENERATION_ORDER), self.cells)
        return np.where(inside, 0.0, distances - slack)

    def is_near(self, ra: Float, dec: Float, angle: float) -> Bool:
        """Return True for positions (deg) within an angle (rad) of the requested cells, and for some farther ones."""
        small_cells, inverse = np.unique(sky.cell_at(ra, dec, _BORDER_ORDER), return_inverse=True)
        return np.asarray((self.min_distances(small_cells, angle) <= angle)[inverse])

    def min_distance(self, order: int, cell: int) -> float:
        """Return a lower limit of the distance (rad) of a HEALPix cell of order 8 or less from the requested cells.

        It is smaller than the distance by about a tenth of the size of the cell at most, and 0 for a cell that contains
        a requested cell.
        """
        if (order, cell) not in self.distances:
            fine = order + _BORDER_ORDER - GENERATION_ORDER
            distances, _ = self.border.query(_directions(sky.border_cells(order, cell, fine), fine))
            slack = np.radians(sky.cell_radius(fine) + sky.cell_radius(_BORDER_ORDER))
            holds = np.any(sky.parent(self.cells, GENERATION_ORDER, order) == cell)
            self.distances[order, cell] = 0.0 if holds else float(distances.min()) - slack
        return self.distances[order, cell]

    def nearest(self, cell: int) -> int:
        """Return the requested cell whose centre is nearest to the centre of `cell`, among those that touch `cell`."""
        neighbours = np.intersect1d(_adjacent_cells(cell), self.cells)
        separations = sky.separation(
            *sky.cell_centre(GENERATION_ORDER, cell), *sky.cell_centres(GENERATION_ORDER, neighbours)
        )
        return int(neighbours[np.argmin(separations)])


def _directions(cells: Int, order: int = _BORDER_ORDER) -> Float:
    return sky.unit_vectors(*sky.cell_centres(order, cells))


@dataclass(frozen=True, slots=True, eq=False)
class _SkyModel:
    """Model of the galaxies, cache of halos that are already drawn, and map of the Milky Way's A(V), in one object."""

    universe: GalaxyModel
    cells: CellCache
    dust: Float32


def draw(requested: Sequence[int], universe: GalaxyModel, cells: CellCache, dust: Float32) -> pa.Table:
    """Return the rows of table `galaxies` whose observed (lensed) positions are in generation cells.

    Parameters
    ----------
    requested : sequence of int
        Nested indices of order-8 cells.
    universe : GalaxyModel
        Model of the galaxies.
    cells : CellCache
        Cache of the halos and galaxies that are already drawn, by HEALPix cell.
    dust : float32 array, shape (pixels,)
        Map of the Milky Way's A(V), mag (truesky.catalogue.dust_map).

    Returns
    -------
    Table
        Rows of table `galaxies`, sorted by _healpix_29 (the order-29 cell of the observed position).

    Raises
    ------
    BadInput
        If halos may deflect the light of sources in the cells around the requested ones by more than 2.5 arcmin, or if
        they deflect a source by more than the upper limit that is computed for its cell.
    """
    region = _RequestedCells.from_cells(requested)
    tables = [GALAXIES.empty()]
    done, sky_model = set(region.cells.tolist()), _SkyModel(universe, cells, dust)
    for cell in activity.track(region.cells.tolist(), "galaxies, cell"):
        tables.append(_rows_inside(region, galaxies.draw(cell, universe, cells, dust)))
        if isinstance(universe.lens, Planes):
            # Draw the cells next to this one now, because the halos that they need are still in the cache.
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
        # Continue with cells farther out. Their galaxies are observed in the requested cells only if the cells between
        # them are narrow or the deflections are large.
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
    """Return the nested indices of the order-8 cells that touch an order-8 cell."""
    neighbours: list[int] = sky.margin_cells(GENERATION_ORDER, cell, GENERATION_ORDER).tolist()
    return neighbours


def _rows_inside(region: _RequestedCells, rows: pa.Table) -> pa.Table:
    return rows.filter(pa.array(region.contains(rows["_healpix_29"].to_numpy())))


def _max_deflection(sky_model: _SkyModel, cell: int) -> float:
    """Return an upper limit of the deflection (rad) of sources in an order-8 cell, by maps and halos together."""
    planes = sky_model.universe.lens
    assert isinstance(planes, Planes)
    return lensing.max_deflection(planes, GENERATION_ORDER, cell) + _MAX_HALO_DEFLECTION


def _from_outside(cell: int, region: _RequestedCells, sky_model: _SkyModel) -> pa.Table:
    """Return the rows of table `galaxies` from an unrequested order-8 cell that may be observed in the requested cells.

    Galaxies in halos are returned only if they are observed in the requested cells. Quasars and galaxies beyond z = 6
    may be observed elsewhere; the caller removes them.
    """
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
    # Leave out the satellites of halos that are too far from the requested cells.
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
