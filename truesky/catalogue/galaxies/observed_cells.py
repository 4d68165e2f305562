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
from truesky.catalogue.cells import in_order
from truesky.catalogue.galaxies import galaxies, halo_lensing, lensing
from truesky.catalogue.galaxies.galaxies import GalaxyModel
from truesky.catalogue.galaxies.halo_lensing import Neighbourhood
from truesky.catalogue.galaxies.lensing import Planes
from truesky.catalogue.halos import halos, population
from truesky.catalogue.halos.population import Cells

# Distances are told of cells of this order, 26" wide: finer ones would cost more than they spare.
_FINE = 13
# Largest deflection by halos that is allowed for, rad: twice that of a halo of 10^15.5 Msun/h.
_MOST = float(np.radians(2.5 / 60.0))


@dataclass(frozen=True, slots=True, eq=False)
class _Wanted:
    """Generation cells, ascending, and directions of small cells along their borders.

    known : distances told, by (order, cell)
    """

    cells: Int
    border: cKDTree
    known: dict[tuple[int, int], float] = field(default_factory=dict)

    @classmethod
    def of(cls, wanted: Sequence[int]) -> _Wanted:
        cells = np.unique(np.asarray(wanted, np.int64))
        every = [sky.border_cells(GENERATION_ORDER, cell, _FINE) for cell in cells.tolist()]
        return cls(cells, cKDTree(_directions(np.concatenate([*every, np.zeros(0, np.int64)]))))

    def hold(self, index: Int) -> Bool:
        """[n] Which order-29 places lie inside."""
        return np.isin(sky.parent(index, sky.DEEPEST, GENERATION_ORDER), self.cells)

    def away(self, small: Int, most: float = np.inf) -> Float:
        """[n] No more than the distances, rad, of what lies in small cells from here; infinite beyond `most`."""
        # Both small cells are as wide as that; a chord is no longer than its arc.
        slack = 2.0 * np.radians(sky.cell_radius(_FINE))
        found, _ = self.border.query(_directions(small), distance_upper_bound=most + slack)
        inside = np.isin(sky.parent(small, _FINE, GENERATION_ORDER), self.cells)
        return np.where(inside, 0.0, found - slack)

    def near(self, ra: Float, dec: Float, angle: float) -> Bool:
        """[n] Whichever places lie within an angle, rad, and some farther ones; ra, dec deg."""
        small, which = np.unique(sky.cell_of(ra, dec, _FINE), return_inverse=True)
        return np.asarray((self.away(small, angle) <= angle)[which])

    def away_of(self, order: int, cell: int) -> float:
        """No more than the distance, rad, of a nested cell from here, and hardly less; order <= 8."""
        if (order, cell) not in self.known:
            fine = order + _FINE - GENERATION_ORDER
            found, _ = self.border.query(_directions(sky.border_cells(order, cell, fine), fine))
            slack = np.radians(sky.cell_radius(fine) + sky.cell_radius(_FINE))
            holds = np.any(sky.parent(self.cells, GENERATION_ORDER, order) == cell)
            self.known[order, cell] = 0.0 if holds else float(found.min()) - slack
        return self.known[order, cell]

    def nearest(self, cell: int) -> int:
        """Of the cells, that whose centre is nearest to a cell that touches one of them."""
        near = np.intersect1d(_about(cell), self.cells)
        apart = sky.separation(*sky.cell_centre(GENERATION_ORDER, cell), *sky.cell_centres(GENERATION_ORDER, near))
        return int(near[np.argmin(apart)])


def _directions(cells: Int, order: int = _FINE) -> Float:
    return sky.unit_vectors(*sky.cell_centres(order, cells))


@dataclass(frozen=True, slots=True, eq=False)
class _Sky:
    """What galaxies are drawn from (of `draw`)."""

    universe: GalaxyModel
    cells: Cells
    dust: Float32


def draw(wanted: Sequence[int], universe: GalaxyModel, cells: Cells, dust: Float32) -> pa.Table:
    """Table `galaxies` of generation cells, sorted by _healpix_29.

    wanted : nested indices at order 8
    cells  : what has been drawn of the universe's population
    dust   : float32[pixel] mag, map of the Milky Way's A(V) (truesky.catalogue.dust_map)
    Errors : BadInput where light is deflected farther than is allowed for
    """
    own = _Wanted.of(wanted)
    found = [GALAXIES.empty()]
    done, own_sky = set(own.cells.tolist()), _Sky(universe, cells, dust)
    for cell in own.cells.tolist():
        found.append(_kept(own, galaxies.draw(cell, universe, cells, dust)))
        if isinstance(universe.lens, Planes):
            # While their neighbours are still kept.
            for other in _about(cell):
                if other not in done and own.nearest(other) == cell:
                    done.add(other)
                    found.append(_kept(own, _from_outside(other, own, own_sky)))
    beyond = {far for near in done for far in _about(near)} - done if isinstance(universe.lens, Planes) else set()
    while beyond:
        # Nothing comes from so far, but where cells are narrow or light is bent most.
        done |= beyond
        near = [cell for cell in sorted(beyond) if _reach(own_sky, cell) > own.away_of(GENERATION_ORDER, cell)]
        found += [_kept(own, _from_outside(cell, own, own_sky)) for cell in near]
        beyond = {far for cell in near for far in _about(cell)} - done
    return in_order(pa.concat_tables(found))


def _about(cell: int) -> list[int]:
    """The generation cells that touch one."""
    found: list[int] = sky.margin_cells(GENERATION_ORDER, cell, GENERATION_ORDER).tolist()
    return found


def _kept(own: _Wanted, rows: pa.Table) -> pa.Table:
    return rows.filter(pa.array(own.hold(rows["_healpix_29"].to_numpy())))


def _reach(sky_: _Sky, cell: int) -> float:
    """How far light of a cell is bent at most, rad."""
    planes = sky_.universe.lens
    assert isinstance(planes, Planes)
    return lensing.farthest(planes, GENERATION_ORDER, cell) + _MOST


def _from_outside(cell: int, own: _Wanted, sky_: _Sky) -> pa.Table:
    """Galaxies of a cell outside that may be seen inside."""
    universe, cells = sky_.universe, sky_.cells
    farthest = _reach(sky_, cell)
    lens = halo_lensing.around(universe.lens, cells, cell, lambda *place: own.away_of(*place) - farthest)
    assert isinstance(lens, Neighbourhood)
    if lens.farthest > _MOST:
        found, allowed = (np.degrees(angle) * 3600.0 for angle in (lens.farthest, _MOST))
        raise BadInput(f"table galaxies: halos may deflect light by {found:.0f} arcsec, {allowed:.0f} are allowed for")
    farthest += lens.farthest - _MOST
    # Satellites of others land too far away.
    members = population.members(cells, cell, lambda *place: own.away_of(*place) <= farthest + halos.reach(place[0]))
    members = members.part(own.near(members.ra, members.dec, farthest))
    bent = lensing.at(lens.box, members.ra, members.dec, members.chi)[3:]
    members = members.part(own.near(*lensing.displaced(members.ra, members.dec, *bent), lens.farthest))
    index = halo_lensing.columns(lens, members.ra, members.dec, members.chi)["_healpix_29"]
    members = members.part(own.hold(index))
    return galaxies.of_members(
        cell, universe, members, lens, sky_.dust, near=lambda ra, dec: own.near(ra, dec, farthest)
    )
