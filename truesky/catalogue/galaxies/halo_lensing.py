"""Lensing by halos, besides that by the matter of the box: what `galaxies` has of both.

around   the halos that reach into one generation cell
columns  observed positions, convergence and shear of sources of that cell
images   convergence, shear and deflection by halos, where the images are

Matter of the box bends the light of a halo as well as that of what lies behind it, by 20" to 40" less: distances
between the two are taken between the directions in which the box alone shows them. From there one Newton step leads to
where the halos show the source, theta = beta + alpha(theta), and everything is summed again there.
Error: 0.5" of the lens equation for 99 % of the sources (tests); what halos do to each other's light, about kappa^2, is
       left out
Ref: Bartelmann & Schneider 2001, Phys. Rep. 340, 291, sections 3.1 and 4.3
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from lake_schema import sky
from lake_schema.arrays import Array, Float, Int
from lake_schema.errors import BadInput
from lake_schema.ids import GENERATION_ORDER
from truesky.catalogue.galaxies import lensing
from truesky.catalogue.galaxies.lensing import Lens, Planes
from truesky.catalogue.halos import lens_halos
from truesky.catalogue.halos.halos import LEVELS, Halos
from truesky.catalogue.halos.lens_halos import Settings
from truesky.catalogue.halos.population import Cells, Population
from truesky.fluxes import cosmology, sources

# Sources of a cell of this order have the same halos to look through.
_PIECE = 11
# Rows of what is kept of halos: direction (3), those of halo_lensing_sums from the distance on, log10 of the mass.
_CHI, _CIRCLE, _MASS = 3, 7, 9
# Cells of halos that are kept: a cell's neighbourhood and that of the cells about it.
_KEPT = 1024
# How far all other halos but the strongest bend light together, rad.
_OTHERS = float(np.radians(45.0 / 3600.0))
# The grid goes this far beyond a cell, rad: no source is shown farther from where it is.
_BEYOND = np.radians(7.0 / 60.0)
# (order, cell) -> rad.
Away = Callable[[int, int], float]


@dataclass(frozen=True, slots=True, eq=False)
class Neighbourhood:
    """What lenses the sources of one cell: the box, and halos in the tangent plane of the cell's centre.

    frame  : [3, 3] east, north and direction of the centre;  halos : [8, h] as halo_lensing_sums wants them
    planes : [p] 1 / distance, h/Mpc;  smooth : [p, side, side, 5], what halos do to nodes of a grid in the plane
    farthest : how far halos bend light at most, rad
    """

    box: Planes
    settings: Settings
    frame: Float
    halos: Float
    planes: Float
    smooth: Float
    farthest: float


def around(lens: Lens, cells: Cells, cell: int, away: Away | None = None) -> Lens | Neighbourhood:
    """The halos that reach into a generation cell, by distance, those of one distance by mass and identifier.

    lens  : the maps; where there is one shear for all, it stays so
    cells : what has been drawn of the universe's population: what halos do is kept there
    cell  : nested index at order 8
    away  : how far the sources that matter are at least from a cell of an order, rad; None: all of the cell's matter
    """
    if not isinstance(lens, Planes):
        return lens
    chosen = lens_halos.settings()
    centre = sky.cell_centre(GENERATION_ORDER, cell)
    frame = _frames(*np.atleast_2d(centre).T)[0]
    radius = sky.cell_radius(GENERATION_ORDER) + chosen.strip / 60.0
    every = _near(chosen, cell, centre, radius)
    every = every if away is None else _reaching(chosen, every, away)
    parts = [_lenses(chosen, lens, cells, *place) for place in every]
    halos, own = np.concatenate([part[0] for part in parts], 1), np.concatenate([part[1] for part in parts])
    # A chord is no longer than its arc.
    chord = np.sum((halos[:3] - frame[2][:, None]) ** 2, 0)
    kept = chord <= (np.maximum(halos[_CHI + 2], halos[_CIRCLE]) + np.radians(radius)) ** 2
    halos, own = halos[:, kept], own[kept]
    halos = halos[:, np.lexsort((own, halos[_MASS], halos[_CHI]))]
    table = np.concatenate([_stereographic(frame, halos[:3].T), halos[_CHI:_MASS]])
    return Neighbourhood(lens, chosen, frame, table, *_grid(chosen, table), _farthest(table))


def columns(lens: Lens | Neighbourhood, ra: Float, dec: Float, chi: Float) -> dict[str, Array]:
    """Observed and true positions, and lensing, of sources as columns of table `galaxies`.

    ra, dec : float[n] deg, true;  chi : float[n] Mpc/h
    lens    : halos and maps, maps alone, or one shear for all
    """
    if not isinstance(lens, Neighbourhood):
        return lensing.columns(lens, ra, dec, chi)
    box = lensing.at(lens.box, ra, dec, chi)
    seen = lensing.displaced(ra, dec, *box[3:])
    found = images(lens, *seen, chi)
    _refuse_beyond(lens, found[3:])
    kappa, gamma1, gamma2 = box[:3] + found[:3]
    shear = {"kappa": kappa, "gamma1": gamma1, "gamma2": gamma2}
    return {**lensing.places(lensing.displaced(*seen, *found[3:]), (ra, dec)), **shear}


def images(lens: Neighbourhood, ra: Float, dec: Float, chi: Float) -> Float:
    """[5, n] kappa, gamma1, gamma2, deflection east, north (rad) by halos, at the images of sources.

    Of each source alone, whichever others it comes with.
    ra, dec : float[n] deg, as the box alone shows the sources;  chi : float[n] Mpc/h
    lens    : of the cell that the sources are in, before anything bends their light
    """
    cell = sky.cell_of(ra, dec, _PIECE)
    row = np.lexsort((-chi, cell))
    cell, own = cell[row], _frames(ra[row], dec[row])
    place, near = _stereographic(lens.frame, own[:, 2]), 1.0 / np.maximum(chi[row], 1e-9)
    found = _summed(lens, place, near, cell)
    again = _worth(lens.settings, found)
    found[:, again] = _summed(lens, place[:, again] + _newton(found[:, again]), near[again], cell[again])
    out = np.empty_like(found)
    out[:, row] = _turned(found, lens.frame, own)
    return out


def _refuse_beyond(lens: Neighbourhood, bent: Float) -> None:
    """Refuse what would be seen in a cell that does not look for it."""
    most = float(np.hypot(*bent).max(initial=0.0))
    if most > lens.farthest:
        found, expected = (np.degrees(angle) * 3600.0 for angle in (most, lens.farthest))
        raise BadInput(f"table galaxies: halos deflect light by {found:.0f} arcsec, {expected:.0f} are allowed for")


# ------------------------------------------------------------------------------------------------ halos


def _near(chosen: Settings, cell: int, centre: tuple[float, float], radius: float) -> list[tuple[int, int, float]]:
    """(order, cell, least mass) of cells whose halos may reach into the generation cell, of some heavy ones only."""
    close = set(sky.cells_in_cone(*centre, radius + chosen.wide / 60.0, GENERATION_ORDER).tolist())
    every = sky.cells_in_cone(*centre, radius + chosen.reach / 60.0, GENERATION_ORDER).tolist()
    found = [(GENERATION_ORDER, place, chosen.lowest if place in close else chosen.heavy) for place in every]
    for order in LEVELS[1:]:
        own = cell >> 2 * (GENERATION_ORDER - order)
        found += [(order, place, chosen.lowest) for place in (own, *sky.margin_cells(order, own, order).tolist())]
    return found


def _reaching(chosen: Settings, every: list[tuple[int, int, float]], away: Away) -> list[tuple[int, int, float]]:
    """Those of `_near` whose halos may reach nodes about the sources."""
    beyond = np.radians((chosen.strip + 2.0 * chosen.step) / 60.0)
    wide, found = np.radians(chosen.wide / 60.0), []
    for order, cell, least in every:
        distance = away(order, cell) - beyond
        if distance <= lens_halos.farthest(chosen, order):
            light = least if order != GENERATION_ORDER or distance <= wide else chosen.heavy
            found.append((order, cell, light))
    return found


def _lenses(chosen: Settings, box: Planes, cells: Cells, order: int, cell: int, least: float) -> tuple[Float, Int]:
    """([10, h], identifiers[h]) of halos above a mass that a cell of a level draws, where the box shows them."""
    kept, which, every = cells.lenses, (order, cell, least), (order, cell, chosen.lowest)
    if which not in kept:
        far = chosen.far if least == chosen.lowest else min(chosen.far, chosen.far_of_wide)
        if every in kept:
            table, source = kept[every]
            some = (table[_MASS] >= least) & (table[_CHI] < far)
            kept[which] = table[:, some], source[some]
        else:
            own = cells.population
            kept[which] = _drawn(chosen, box, own, lens_halos.draw(own, least, far, order, cell), order)
        if len(kept) > _KEPT:
            kept.popitem(last=False)
    kept.move_to_end(which)
    return kept[which]


def _drawn(chosen: Settings, box: Planes, own: Population, hosts: Halos, order: int) -> tuple[Float, Int]:
    """What `_lenses` has of halos of a level."""
    ra, dec = sky.positions(hosts.index)
    bent = lensing.at(box, ra, dec, hosts.chi)[3:]
    direction = _frames(*lensing.displaced(ra, dec, *bent))[:, 2]
    z = own.halos.distances.redshift(hosts.chi)
    size = lens_halos.sizes(own.masses, chosen, order, z, hosts.chi, hosts.log_mass)
    return np.concatenate([direction.T, hosts.chi[None], size, hosts.log_mass[None]]), hosts.id


def _farthest(halos: Float) -> float:
    """The strongest of the halos bends light by its own, infinitely far behind it; all others together by less."""
    # Its compiler takes a second to import.
    from truesky.catalogue.halos import halo_lensing_sums as sums

    amplitude, size = halos[sums.AMPLITUDE], halos[sums.SIZE]
    if not amplitude.size:
        return _OTHERS
    own = amplitude / size * np.interp(halos[sums.CONCENTRATION], *_steepest())
    return float(own.max()) + _OTHERS


@lru_cache
def _steepest() -> tuple[Float, Float]:
    """Concentrations, and the most that is enclosed, over the radius, both in units of the halo's own."""
    from truesky.catalogue.halos import projected_nfw

    nodes, shares = np.geomspace(1.0, 100.0, 25), np.linspace(0.02, 0.99, 98)
    enclosed = [
        max(projected_nfw.profile(share * c, c)[1] / share for share in shares) / projected_nfw.total(c) for c in nodes
    ]
    return nodes, np.array(enclosed)


def _grid(chosen: Settings, halos: Float) -> tuple[Float, Float]:
    """(planes[p], smooth[p, side, side, 5]) of the halos that reach into a cell."""
    # Its compiler takes a second to import.
    from truesky.catalogue.halos import halo_lensing_sums as sums

    step = np.radians(chosen.step / 60.0)
    half = int(np.ceil((np.radians(sky.cell_radius(GENERATION_ORDER)) + _BEYOND) / step)) + 1
    side = 2 * half + 1
    near = np.append(0.0, 1.0 / cosmology.comoving_distance(np.array(chosen.planes))[::-1])
    at = step * np.arange(-half, half + 1)
    y, x = np.meshgrid(at, at, indexing="ij")
    place = np.tile(np.stack([x.ravel(), y.ravel()]), near.size)
    out = np.zeros((5, place.shape[1]))
    wide = np.ascontiguousarray(halos[:, halos[sums.WIDE] > halos[sums.CLOSE]])
    sums.add_smooth(place, np.repeat(near, side * side), wide, out)
    return near, np.ascontiguousarray(out.T).reshape(near.size, side, side, 5)


# ------------------------------------------------------------------------------------------------ sources


def _summed(lens: Neighbourhood, place: Float, near: Float, cell: Int) -> Float:
    """[5, n] in the tangent plane; sources by cell, in each the farthest first."""
    from truesky.catalogue.halos import halo_lensing_sums as sums

    first = np.append(np.unique(cell, return_index=True)[1], cell.size)
    found = np.zeros((5, cell.size))
    sums.add_halos(place, near, first, lens.halos, found)
    sums.add_nodes(place, near, lens.planes, np.radians(lens.settings.step / 60.0), lens.smooth, found)
    return found


def _worth(chosen: Settings, found: Float) -> Int:
    """Rows of what is summed again where its image is: neither hardly lensed nor near a caustic."""
    kappa, gamma1, gamma2 = found[:3]
    strong = np.abs(kappa) + np.hypot(gamma1, gamma2) > chosen.again
    weak = sources.determinant(kappa, gamma1, gamma2) >= chosen.least_determinant
    return np.flatnonzero(strong & weak & (kappa < 1.0))


def _newton(found: Float) -> Float:
    """[2, n] rad, the step from theta = beta to the root of theta - alpha(theta) - beta."""
    kappa, gamma1, gamma2, east, north = found
    x = (1.0 - kappa + gamma1) * east + gamma2 * north
    y = gamma2 * east + (1.0 - kappa - gamma1) * north
    return np.asarray(np.stack([x, y]) / sources.determinant(kappa, gamma1, gamma2))


def _frames(ra: Float, dec: Float) -> Float:
    """[n, 3, 3] east, north and direction of places; ra, dec deg."""
    lon, lat = np.radians(ra), np.radians(dec)
    sin, cos, up, flat = np.sin(lon), np.cos(lon), np.sin(lat), np.cos(lat)
    rows = (-sin, cos, np.zeros_like(lon)), (-up * cos, -up * sin, flat), (flat * cos, flat * sin, up)
    return np.stack([np.stack(row, -1) for row in rows], -2)


def _stereographic(frame: Float, direction: Float) -> Float:
    """[2, n] rad, of directions [n, 3] about the centre of a frame: shapes stay as they are."""
    x, y, along = (np.sum(direction * axis, -1) for axis in frame)
    return np.asarray(np.stack([x, y]) * (2.0 / (1.0 + along)))


def _turned(found: Float, frame: Float, own: Float) -> Float:
    """From the frame of the plane to the sources' own east and north."""
    x, y = (np.sum(own[:, 0] * frame[axis], -1) for axis in range(2))
    length = np.hypot(x, y)
    cos, sin = x / length, y / length
    kappa, gamma1, gamma2, east, north = found
    double, twice = cos * cos - sin * sin, 2.0 * sin * cos
    shear = double * gamma1 + twice * gamma2, double * gamma2 - twice * gamma1
    return np.stack([kappa, *shear, cos * east + sin * north, cos * north - sin * east])
