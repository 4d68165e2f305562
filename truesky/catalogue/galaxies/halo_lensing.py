"""Lensing of galaxies by halos and the matter around them, in addition to the large-scale matter of the simulated box.

Notes
-----
The lensing by the matter around halos (`fine_convergence`) is added to that by halos, on a grid. The matter is at its
true direction, without the deflection by the box. Interpolation between source planes lets matter between the planes
lens sources at the same distance: a source halfway in 1 / distance gets up to a quarter of the lensing by matter at its
own redshift that a source on the next plane gets.

The large-scale matter deflects the light of a halo as well as the light of a source behind the halo; the two
deflections differ by 20 to 40 arcsec. Distances between halos and sources on the sky are therefore measured between the
positions at which they are observed with the lensing by the box alone. Lensing by halos is summed at this position
beta. If it is not weak there, one Newton step of theta = beta + alpha(theta) leads to the image at theta, where the
lensing is summed again. Sources close to a caustic keep the lensing at beta.

The lens equation is solved to 0.5 arcsec for 99 % of the sources (tests). Terms of about kappa^2, in which halos lens
the light of other halos, are left out.

References
----------
Bartelmann & Schneider 2001, Phys. Rep. 340, 291, sections 3.1 and 4.3
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
from truesky.catalogue.halos.population import CellCache, Population
from truesky.catalogue.matter import fine_convergence
from truesky.catalogue.matter.fine_convergence import FineMatter
from truesky.fluxes import sources

# All sources in one HEALPix cell of this order are compared with the same halos.
_SOURCE_ORDER = 11
# Row numbers of the cached table of halos (10 rows). Rows 0 to 2 are the unit vector of the direction. Rows 3 to 8 are
# the rows CHI (comoving distance) to CONCENTRATION of halo_lensing_sums; row 7 (_CIRCLE) is the angle beyond which the
# halo does not lens, rad. Row 9 (_MASS) is log10 of the mass in Msun/h.
_CHI, _CIRCLE, _MASS = 3, 7, 9
# Largest number of HEALPix cells whose halos are cached. It is enough for all cells with halos that lens sources in an
# order-8 cell and its neighbours.
_MAX_CACHED_CELLS = 1024
# Upper limit of the deflection by all halos except the strongest one and by the matter around halos together, rad.
_OTHER_DEFLECTION = float(np.radians(45.0 / 3600.0))
# Angle (rad) by which the grid for the slowly varying part of the halos' lensing extends beyond the cell with the
# sources. It is larger than any deflection.
_GRID_MARGIN = np.radians(7.0 / 60.0)
# Function of the order and the nested index of a HEALPix cell. It returns a lower limit of the distance on the sky
# (rad) between this cell and the sources whose lensing is needed.
MinDistance = Callable[[int, int], float]


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """Lensing at the nodes of a square grid in the plane that touches the sphere at the centre of a cell.

    Attributes
    ----------
    step : float
        Distance between nodes, rad.
    table : float array, shape (p, side, side, 5)
        kappa, gamma1, gamma2, deflection to the east and north (rad) for sources on each of p planes, by y and x.
    """

    step: float
    table: Float


@dataclass(frozen=True, slots=True, eq=False)
class Neighbourhood:
    """All matter that lenses the sources in one order-8 cell: maps of the box, halos, and the matter around them.

    Halos are projected on the plane that touches the sphere at the centre of the cell.

    Attributes
    ----------
    box : Planes
        Lensing maps of the simulated matter.
    settings : Settings
        Masses, distances and angles to which halos are used.
    frame : float array, shape (3, 3)
        Unit vectors at the centre of the cell: to the east, to the north and to the centre.
    halos : float array, shape (8, h)
        Position, distance and profile of each halo, in the rows that halo_lensing_sums defines.
    planes : float array, shape (p,)
        Inverse comoving distances of the sources of `smooth` and `matter`, ascending from 0, h/Mpc.
    smooth : Grid
        Part of the halos' lensing that varies slowly.
    matter : Grid or None
        Lensing by the matter that follows the structure below the cells of the box; None if there is no such structure.
    max_deflection : float
        Upper limit of the deflection by halos and the matter around them, rad.
    """

    box: Planes
    settings: Settings
    frame: Float
    halos: Float
    planes: Float
    smooth: Grid
    matter: Grid | None
    max_deflection: float


def lens_of_cell(
    lens: Lens, cells: CellCache, cell: int, min_distance: MinDistance | None = None
) -> Lens | Neighbourhood:
    """Collect the halos that lens sources in a generation cell (HEALPix cell of order 8).

    Parameters
    ----------
    lens : Lens
        Lensing maps of the simulated matter, or a uniform shear.
    cells : CellCache
        Cache of the halos that are already drawn; the tables of their lensing are cached in it too.
    cell : int
        Nested index of the order-8 cell with the true positions of the sources.
    min_distance : callable, optional
        Function of (order, cell) that returns a lower limit (rad) of the distance between a HEALPix cell and the
        sources that matter. Halos in cells that are too far away are left out. None to use all halos that can lens a
        source in the cell.

    Returns
    -------
    Lens or Neighbourhood
        The maps with the halos, which are sorted by comoving distance, then by mass and identifier. A uniform shear is
        returned unchanged.
    """
    if not isinstance(lens, Planes):
        return lens
    settings = lens_halos.settings()
    centre = sky.cell_centre(GENERATION_ORDER, cell)
    frame = _frames(*np.atleast_2d(centre).T)[0]
    radius = sky.cell_radius(GENERATION_ORDER) + settings.strip / 60.0
    halo_cells = _cells_with_halos(settings, cell, centre, radius)
    halo_cells = halo_cells if min_distance is None else _select_reaching(settings, halo_cells, min_distance)
    parts = [_cached_lenses(settings, lens, cells, *place) for place in halo_cells]
    halos, identifiers = np.concatenate([part[0] for part in parts], 1), np.concatenate([part[1] for part in parts])
    # A chord is never longer than its arc, so comparing chords with angles never excludes a halo that lenses a source.
    squared_chord = np.sum((halos[:3] - frame[2][:, None]) ** 2, 0)
    reaching = squared_chord <= (np.maximum(halos[_CHI + 2], halos[_CIRCLE]) + np.radians(radius)) ** 2
    halos, identifiers = halos[:, reaching], identifiers[reaching]
    halos = halos[:, np.lexsort((identifiers, halos[_MASS], halos[_CHI]))]
    table = np.concatenate([_stereographic(frame, halos[:3].T), halos[_CHI:_MASS]])
    planes = np.append(0.0, 1.0 / cells.population.cosmology.comoving_distance(np.array(settings.planes))[::-1])
    grids = _smooth_lensing(settings, table, planes), _matter_lensing(settings, cells, planes, frame)
    return Neighbourhood(lens, settings, frame, table, planes, *grids, _max_deflection(table))


def columns(lens: Lens | Neighbourhood, ra: Float, dec: Float, chi: Float) -> dict[str, Array]:
    """Return positions and lensing of sources as columns of table `galaxies`.

    Parameters
    ----------
    lens : Lens or Neighbourhood
        Maps with halos, maps alone, or a uniform shear.
    ra, dec : float array, shape (n,)
        True positions, deg.
    chi : float array, shape (n,)
        Comoving distance, Mpc/h.

    Returns
    -------
    dict of str to array, shape (n,)
        Columns by name: ra, dec and _healpix_29 of the observed positions, ra_true, dec_true, kappa, gamma1 and gamma2.

    Raises
    ------
    BadInput
        If halos deflect a source by more than `lens.max_deflection`.
    """
    if not isinstance(lens, Neighbourhood):
        return lensing.columns(lens, ra, dec, chi)
    box_terms = lensing.interpolate(lens.box, ra, dec, chi)
    box_position = lensing.displace(ra, dec, *box_terms[3:])
    halo_terms = lensing_at_images(lens, *box_position, chi)
    _refuse_large_deflection(lens, halo_terms[3:])
    kappa, gamma1, gamma2 = box_terms[:3] + halo_terms[:3]
    shear = {"kappa": kappa, "gamma1": gamma1, "gamma2": gamma2}
    return {**lensing.position_columns(lensing.displace(*box_position, *halo_terms[3:]), (ra, dec)), **shear}


def lensing_at_images(lens: Neighbourhood, ra: Float, dec: Float, chi: Float) -> Float:
    """Return the lensing by halos at the images of sources.

    It is computed at the given position instead of the image if it is very weak, or if the source is close to a
    caustic.

    Parameters
    ----------
    lens : Neighbourhood
        Halos that lens the sources in the cell with their true positions.
    ra, dec : float array, shape (n,)
        Positions at which the sources are observed with the lensing by the maps alone, deg.
    chi : float array, shape (n,)
        Comoving distance, Mpc/h.

    Returns
    -------
    float array, shape (5, n)
        kappa, gamma1, gamma2, deflection to the east and north (rad) of each source. It does not depend on the other
        sources.
    """
    cell = sky.cell_at(ra, dec, _SOURCE_ORDER)
    row = np.lexsort((-chi, cell))
    cell, frames = cell[row], _frames(ra[row], dec[row])
    place, inverse_distance = _stereographic(lens.frame, frames[:, 2]), 1.0 / np.maximum(chi[row], 1e-9)
    terms = _sum_halos(lens, place, inverse_distance, cell)
    repeated = _rows_to_repeat(lens.settings, terms)
    terms[:, repeated] = _sum_halos(
        lens, place[:, repeated] + _newton_step(terms[:, repeated]), inverse_distance[repeated], cell[repeated]
    )
    out = np.empty_like(terms)
    out[:, row] = _rotate_to_sources(terms, lens.frame, frames)
    return out


def _refuse_large_deflection(lens: Neighbourhood, deflection: Float) -> None:
    """Raise BadInput if halos deflect a source by more than `lens.max_deflection`.

    Catalogues search for lensed sources only within this distance of a cell, so such a source could be missing.
    """
    largest = float(np.hypot(*deflection).max(initial=0.0))
    if largest > lens.max_deflection:
        largest_arcsec, allowed_arcsec = (np.degrees(angle) * 3600.0 for angle in (largest, lens.max_deflection))
        raise BadInput(
            f"table galaxies: halos and the matter around them deflect light by {largest_arcsec:.0f} arcsec, "
            f"at most {allowed_arcsec:.0f} are allowed"
        )


def _cells_with_halos(
    settings: Settings, cell: int, centre: tuple[float, float], radius: float
) -> list[tuple[int, int, float]]:
    """Return (order, nested index, log10 of the lowest mass in Msun/h) of cells whose halos may lens sources in `cell`.

    Halos that span large angles are drawn in larger cells (lower orders). In distant cells of order 8, only heavy halos
    are used. `centre` (ra, dec, deg) and `radius` (deg) are a circle around all sources.
    """
    close_cells = set(sky.cells_in_cone(*centre, radius + settings.wide / 60.0, GENERATION_ORDER).tolist())
    cells_in_reach = sky.cells_in_cone(*centre, radius + settings.reach / 60.0, GENERATION_ORDER).tolist()
    selected = [
        (GENERATION_ORDER, place, settings.lowest if place in close_cells else settings.heavy)
        for place in cells_in_reach
    ]
    for order in LEVELS[1:]:
        parent_cell = cell >> 2 * (GENERATION_ORDER - order)
        selected += [
            (order, place, settings.lowest)
            for place in (parent_cell, *sky.margin_cells(order, parent_cell, order).tolist())
        ]
    return selected


def _select_reaching(
    settings: Settings, candidates: list[tuple[int, int, float]], min_distance: MinDistance
) -> list[tuple[int, int, float]]:
    """Select the cells whose halos may lens the relevant sources or the grid nodes around these sources.

    `candidates` and the result contain (order, nested index, log10 of the lowest mass in Msun/h). `min_distance`
    returns a lower limit of the distance (rad) between a cell (order, nested index) and the relevant sources.
    """
    margin = np.radians((settings.strip + 2.0 * settings.step) / 60.0)
    wide, selected = np.radians(settings.wide / 60.0), []
    for order, cell, min_mass in candidates:
        distance = min_distance(order, cell) - margin
        if distance <= lens_halos.max_circle(settings, order):
            mass_limit = min_mass if order != GENERATION_ORDER or distance <= wide else settings.heavy
            selected.append((order, cell, mass_limit))
    return selected


def _cached_lenses(
    settings: Settings, box: Planes, cells: CellCache, order: int, cell: int, min_mass: float
) -> tuple[Float, Int]:
    """Return a table of the halos above log10 mass `min_mass` (Msun/h) in a HEALPix cell, and their identifiers.

    The table has the rows of `_lens_table`. It is cached in `cells`.
    """
    cache, key, full_key = cells.lenses, (order, cell, min_mass), (order, cell, settings.lowest)
    if key not in cache:
        max_distance = settings.max_distance(cells.population.cosmology)
        if min_mass != settings.lowest:
            max_distance = min(max_distance, settings.wide_distance)
        if full_key in cache:
            table, source = cache[full_key]
            selected = (table[_MASS] >= min_mass) & (table[_CHI] < max_distance)
            cache[key] = table[:, selected], source[selected]
        else:
            population = cells.population
            cache[key] = _lens_table(
                settings, box, population, lens_halos.draw(population, min_mass, max_distance, order, cell), order
            )
        if len(cache) > _MAX_CACHED_CELLS:
            cache.popitem(last=False)
    cache.move_to_end(key)
    return cache[key]


def _lens_table(settings: Settings, box: Planes, population: Population, hosts: Halos, order: int) -> tuple[Float, Int]:
    """Return the table, shape (10, h), and the identifiers of h halos that lens.

    The rows are: unit vector of the direction (3), comoving distance (Mpc/h), lensing strength, three angles (rad),
    concentration and log10 mass (Msun/h). The direction is where the halo is observed with the lensing by `box` alone.
    """
    ra, dec = sky.positions_of_indices(hosts.index)
    deflection = lensing.interpolate(box, ra, dec, hosts.chi)[3:]
    direction = _frames(*lensing.displace(ra, dec, *deflection))[:, 2]
    z = population.halos.distances.redshift(hosts.chi)
    size = lens_halos.sizes(population.masses, settings, order, z, hosts.chi, hosts.log_mass)
    return np.concatenate([direction.T, hosts.chi[None], size, hosts.log_mass[None]]), hosts.id


def _max_deflection(halos: Float) -> float:
    """Return an upper limit (rad) of the deflection by `halos`.

    It is the deflection by the strongest halo for sources at infinity, plus a fixed limit for all other halos together.
    """
    # Import here, because compiling takes a second.
    from truesky.catalogue.halos import halo_lensing_sums as sums

    amplitude, size = halos[sums.AMPLITUDE], halos[sums.SIZE]
    if not amplitude.size:
        return _OTHER_DEFLECTION
    deflection = amplitude / size * np.interp(halos[sums.CONCENTRATION], *_max_enclosed_ratio())
    return float(deflection.max()) + _OTHER_DEFLECTION


@lru_cache
def _max_enclosed_ratio() -> tuple[Float, Float]:
    """Return concentrations, and the largest ratio of projected mass to projected radius in a halo with each of them.

    The mass inside a circle is in units of the halo's mass, and the radius of the circle in units of R_200m.
    """
    from truesky.catalogue.halos import projected_nfw

    nodes, shares = np.geomspace(1.0, 100.0, 25), np.linspace(0.02, 0.99, 98)
    enclosed = [
        max(projected_nfw.profile(share * c, c)[1] / share for share in shares) / projected_nfw.total(c) for c in nodes
    ]
    return nodes, np.array(enclosed)


def _grid_radius(settings: Settings) -> float:
    """Return the radius (rad) of the circle around the centre of an order-8 cell in which lensing is interpolated."""
    return float(np.radians(sky.cell_radius(GENERATION_ORDER)) + _GRID_MARGIN + np.radians(settings.step / 60.0))


def _smooth_lensing(settings: Settings, halos: Float, planes: Float) -> Grid:
    """Return the slowly varying part of the lensing by halos around the centre of an order-8 cell.

    `planes`, shape (p,), are the inverse comoving distances of the sources, h/Mpc.
    """
    # Import here, because compiling takes a second.
    from truesky.catalogue.halos import halo_lensing_sums as sums

    step = np.radians(settings.step / 60.0)
    half = int(np.ceil(_grid_radius(settings) / step))
    side = 2 * half + 1
    axis = step * np.arange(-half, half + 1)
    y, x = np.meshgrid(axis, axis, indexing="ij")
    place = np.tile(np.stack([x.ravel(), y.ravel()]), planes.size)
    out = np.zeros((5, place.shape[1]))
    wide = np.ascontiguousarray(halos[:, halos[sums.WIDE] > halos[sums.CLOSE]])
    sums.add_smooth(place, np.repeat(planes, side * side), wide, out)
    return Grid(step, np.ascontiguousarray(out.T).reshape(planes.size, side, side, 5))


def _matter_lensing(settings: Settings, cells: CellCache, planes: Float, frame: Float) -> Grid | None:
    """Return the lensing by the matter that follows the structure below the cells of the box, around a cell's centre.

    `planes`, shape (p,), are the inverse comoving distances of the sources, h/Mpc. Return None if halos have no such
    structure, or if they are the user's.
    """
    model = cells.population.halos
    if model.fine is None or cells.population.light_cone is not None:
        return None
    if cells.matter is None:
        distance = settings.max_distance(cells.population.cosmology)
        points = fine_convergence.points(model.box, model.steps, model.fine, distance)
        cells.matter = FineMatter(model.box, model.replicas, model.fine, points, planes)
    return Grid(*fine_convergence.lensing_grid(cells.matter, frame, _grid_radius(settings)))


def _sum_halos(lens: Neighbourhood, place: Float, inverse_distance: Float, cell: Int) -> Float:
    """Return kappa, gamma1, gamma2 and deflection (rad) by all halos at places in the tangent plane, shape (5, n).

    Sources must be sorted by `cell` (order `_SOURCE_ORDER`), then by decreasing comoving distance.
    """
    from truesky.catalogue.halos import halo_lensing_sums as sums

    first = np.append(np.unique(cell, return_index=True)[1], cell.size)
    terms = np.zeros((5, cell.size))
    sums.add_halos(place, inverse_distance, first, lens.halos, terms)
    for grid in (lens.smooth, lens.matter):
        if grid is not None:
            sums.add_nodes(place, inverse_distance, lens.planes, grid.step, grid.table, terms)
    return terms


def _rows_to_repeat(settings: Settings, terms: Float) -> Int:
    """Return the rows of sources whose lensing must be summed again at their image.

    `terms` are kappa, gamma1, gamma2 and the deflection of all sources. The selected sources are lensed so strongly
    that the lensing changes between source and image, but they are not close to a caustic.
    """
    kappa, gamma1, gamma2 = terms[:3]
    strong = np.abs(kappa) + np.hypot(gamma1, gamma2) > settings.repeat_threshold
    weak = sources.determinant(kappa, gamma1, gamma2) >= settings.least_determinant
    return np.flatnonzero(strong & weak & (kappa < 1.0))


def _newton_step(terms: Float) -> Float:
    """Return the first Newton step from beta to the root theta of theta - alpha(theta) - beta, shape (2, n), rad.

    `terms` are kappa, gamma1, gamma2 and deflection alpha at theta = beta.
    """
    kappa, gamma1, gamma2, east, north = terms
    x = (1.0 - kappa + gamma1) * east + gamma2 * north
    y = gamma2 * east + (1.0 - kappa - gamma1) * north
    return np.asarray(np.stack([x, y]) / sources.determinant(kappa, gamma1, gamma2))


def _frames(ra: Float, dec: Float) -> Float:
    """Return the unit vectors to the east, to the north and to the position itself, shape (n, 3, 3).

    Positions are in deg.
    """
    lon, lat = np.radians(ra), np.radians(dec)
    sin, cos, up, flat = np.sin(lon), np.cos(lon), np.sin(lat), np.cos(lat)
    rows = (-sin, cos, np.zeros_like(lon)), (-up * cos, -up * sin, flat), (flat * cos, flat * sin, up)
    return np.stack([np.stack(row, -1) for row in rows], -2)


def _stereographic(frame: Float, direction: Float) -> Float:
    """Return the stereographic projection (x, y) in rad, shape (2, n), of unit vectors of shape (n, 3).

    `frame` has the unit vectors to the east, to the north and to the centre of the projection. The projection is
    conformal.
    """
    x, y, along = (np.sum(direction * axis, -1) for axis in frame)
    return np.asarray(np.stack([x, y]) * (2.0 / (1.0 + along)))


def _rotate_to_sources(terms: Float, frame: Float, frames: Float) -> Float:
    """Rotate shear and deflection from the axes of the tangent plane (`frame`) to east and north at each source.

    `terms`, shape (5, n), are kappa, gamma1, gamma2 and the deflection along both axes. `frame` has the unit vectors
    along the axes and to the centre of the plane. `frames` has the unit vectors to the east, to the north and to the
    source itself for each source, shape (n, 3, 3).
    """
    x, y = (np.sum(frames[:, 0] * frame[axis], -1) for axis in range(2))
    length = np.hypot(x, y)
    cos, sin = x / length, y / length
    kappa, gamma1, gamma2, east, north = terms
    double, twice = cos * cos - sin * sin, 2.0 * sin * cos
    shear = double * gamma1 + twice * gamma2, double * gamma2 - twice * gamma1
    return np.stack([kappa, *shear, cos * east + sin * north, cos * north - sin * east])
