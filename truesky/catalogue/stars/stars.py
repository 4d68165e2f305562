"""Draw the rows of table `stars` in one generation cell (HEALPix cell of order 8).

The rows depend only on the seed, the cell and the model. A cell contains up to four groups of stars: stars drawn from a
model of the Milky Way (or a user's catalogue), their companions in binaries, L and T dwarfs, and stars of the Tycho-2
catalogue. Tycho-2, if it is given, replaces the drawn bright stars. Numbers by distance and luminosity are drawn first,
then positions, extinction and spectra. Then the stars within the magnitude limits are selected.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from lake_schema import ids, sky
from lake_schema.arrays import Bool, Float, Float32, Int
from lake_schema.errors import BadInput
from lake_schema.ids import GENERATION_ORDER
from lake_schema.tables import stars as declarations
from truesky.catalogue import dust_map, parameters
from truesky.catalogue.stars import (
    bright_stars,
    brown_dwarfs,
    companions,
    from_catalogue,
    kinematics,
    milky_way,
    variables,
)
from truesky.catalogue.stars.bright_stars import BrightStars
from truesky.catalogue.stars.brown_dwarfs import BrownDwarfs
from truesky.catalogue.stars.from_catalogue import StarCatalogue
from truesky.catalogue.stars.milky_way import MilkyWay
from truesky.fluxes import passbands
from truesky.fluxes.calibration import STAR_BAND
from truesky.fluxes.libraries import model_stars, stellar, templates
from truesky.fluxes.libraries.stellar import StellarTypes
from truesky.fluxes.libraries.vega import vega_magnitude
from truesky.randomness.rng import stream

# A group of stars in a cell: arrays by column of table `stars`, without identifiers.
Lot = dict[str, Any]
# Galactic longitude and latitude of a cell's centre (deg), its area (deg2), and the faintest H magnitude (Vega).
CellView = tuple[float, float, float, float]

STAR = 5
BRIGHT, BROWN = 3, 4
_BROWN_DWARF = 3
# Largest number of stars in an order-8 cell, which is always drawn as a whole: 2e6 stars take 1.6 GB of memory, and can
# be numbered with the 22 bits that an identifier has for this number.
_MAX_STARS = 2e6
# Largest |b| (deg) of the Galactic plane, in which the magnitude limit `plane_limit` applies.
PLANE = 5.0
# Largest |l| and |b| (deg) of the region of the bulge, in which the magnitude limit of the Galactic plane applies.
BULGE = (20.0, 10.0)
# Angle of one AU at a distance of one pc, deg.
_AU_PC = 1.0 / 3600.0


@dataclass(frozen=True, slots=True, eq=False)
class StarModel:
    """Model from which stars are drawn, made once by `model`.

    Attributes
    ----------
    limit : float
        Faintest observed H magnitude (Vega), that is with the Milky Way's extinction.
    plane_limit : float or None
        Faintest H of cells whose centre is in the Galactic plane (PLANE) or the bulge (BULGE). None if such cells
        raise an error.
    brightest : float
        Brightest H; brighter stars are left out.
    galaxy : MilkyWay
        Model of the Milky Way from which stars are drawn if there is no user's catalogue.
    catalogue : StarCatalogue or None
        The user's catalogue, which replaces the drawn stars.
    brown_dwarfs : BrownDwarfs or None
        L and T dwarfs; None without them.
    bright : BrightStars or None
        Bright stars of Tycho-2, which replace the drawn bright stars; None to keep the drawn ones.
    layer : Layer
        Scale height of the dust layer.
    sin_b_min : float
        Lower limit of |sin b| in the law of the dust, b being the Galactic latitude.
    h_over_v : float
        Extinction ratio A(H) / A(V).
    types : StellarTypes
        Properties of the stellar types, whose spectra are the first templates of the library.
    models : int
        Index of the first template of the library that is a synthetic spectrum of a model atmosphere.
    v_minus_h : float array
        V - H (Vega) of the stellar types, then of the model atmospheres, mag.
    variables : bool
        True if the rows have the columns of variable stars.
    """

    limit: float
    plane_limit: float | None
    brightest: float
    galaxy: MilkyWay
    catalogue: StarCatalogue | None
    brown_dwarfs: BrownDwarfs | None
    bright: BrightStars | None
    layer: dust_map.Layer
    sin_b_min: float
    h_over_v: float
    types: StellarTypes
    models: int
    v_minus_h: Float
    variables: bool = False


def model(
    limit: float = 26.0,
    plane_limit: float | None = None,
    density: str = "juric",
    brown_dwarf_boost: float = 1.0,
    catalogue: StarCatalogue | None = None,
    bright: BrightStars | None = None,
    brightest: float = -math.inf,
) -> StarModel:
    """Return the model of the stars with observed H magnitudes brightest <= H < limit; it takes 0.2 s.

    Parameters
    ----------
    limit : float
        Faintest observed H magnitude (Vega).
    plane_limit : float, optional
        Faintest H in the Galactic plane and the bulge; None to raise an error for cells there.
    density : str
        Model of the Milky Way, "juric" or "besancon".
    brown_dwarf_boost : float
        Ratio of the drawn to the natural number density of L and T dwarfs; 0 for no dwarfs.
    catalogue : StarCatalogue, optional
        The user's catalogue, which replaces the drawn stars; None to draw stars.
    bright : BrightStars, optional
        Tycho-2 stars, which replace the drawn bright stars; None to keep the drawn ones.
    brightest : float
        Brightest observed H magnitude (Vega).

    Returns
    -------
    StarModel
        The model.
    """
    types, vega = stellar.types(), [vega_magnitude(passbands.load(band)) for band in ("bessell_v", STAR_BAND)]
    return StarModel(
        limit=limit,
        plane_limit=plane_limit,
        brightest=brightest,
        galaxy=milky_way.milky_way(density),
        catalogue=catalogue,
        brown_dwarfs=brown_dwarfs.brown_dwarfs(brown_dwarf_boost) if brown_dwarf_boost else None,
        bright=bright,
        layer=dust_map.layer(),
        sin_b_min=dust_map.cosecant().sin_b_min,
        h_over_v=float(parameters.section("milky_way.toml", "extinction")["h_over_v"]),
        types=types,
        models=templates.first_model(),
        v_minus_h=model_stars.v_minus_h(types, (vega[0], vega[1])),
    )


def expected_counts(cells: npt.ArrayLike, universe: StarModel) -> Float:
    """Return the expected number of stars in order-8 cells (nested indices), without extinction (20 us per cell).

    Raises BadInput if a cell is in the Galactic plane or the bulge and the model has no limit for them, or if a cell
    has more than 2e6 stars.
    """
    lon, lat = _centres(cells)
    limit = _limits(lon, lat, universe)
    where = (lon, lat, sky.cell_area(GENERATION_ORDER), limit)
    if universe.catalogue is None:
        counts = milky_way.expected_counts(universe.galaxy, *where)
    else:
        counts = from_catalogue.star_counts(universe.catalogue, cells)
    if universe.brown_dwarfs is not None:
        counts += brown_dwarfs.expected_counts(universe.brown_dwarfs, universe.galaxy, *where)
    if counts.max(initial=0.0) > _MAX_STARS:
        worst = int(counts.argmax())
        key = "stars.plane_limit" if _is_crowded(lon[worst], lat[worst]) else "universe.star_limit"
        raise BadInput(
            f"{np.sum(counts > _MAX_STARS)} of the area's cells contain more than {_MAX_STARS:.3g} stars; the cell at "
            f"l = {lon[worst]:.1f}, b = {lat[worst]:.1f} has {counts[worst]:.3g} to H = {limit[worst]:g}: set a "
            f"brighter {key}, or move the area"
        )
    return counts


def _centres(cells: npt.ArrayLike) -> tuple[Float, Float]:
    """Return the Galactic longitude and latitude (deg) of the centres of order-8 cells (nested indices)."""
    return sky.galactic(*sky.cell_centres(GENERATION_ORDER, cells))


def _is_crowded(lon: npt.ArrayLike, lat: npt.ArrayLike) -> Bool:
    """Return True for Galactic positions (deg) in the plane (PLANE) or in the region of the bulge (BULGE)."""
    in_bulge_longitude = np.abs((np.asarray(lon) + 180.0) % 360.0 - 180.0) < BULGE[0]
    return np.asarray((np.abs(lat) < PLANE) | (in_bulge_longitude & (np.abs(lat) < BULGE[1])))


def _limits(lon: Float, lat: Float, universe: StarModel) -> Float:
    """Return the faintest H magnitude (Vega) in cells with these Galactic coordinates (deg).

    Raises BadInput if a cell is in the Galactic plane or the bulge, and the model has no limit for them.
    """
    in_plane = _is_crowded(lon, lat)
    if not in_plane.any():
        return np.full(lat.size, universe.limit)
    if universe.plane_limit is None:
        raise BadInput(
            f"{in_plane.sum()} of the area's cells lie within {PLANE:g} deg of the Galactic plane or {BULGE[1]:g} deg "
            "of the bulge, where there are too many stars: move the area, or set stars.plane_limit to the faintest H "
            "of these cells"
        )
    return np.where(in_plane, universe.plane_limit, universe.limit)


def draw(cell: int, seed: int, universe: StarModel, dust: Float32) -> pa.Table:
    """Draw the rows of table `stars` in one order-8 cell.

    Parameters
    ----------
    cell : int
        Nested index of the order-8 cell.
    seed : int
        Seed of the request.
    universe : StarModel
        Model of the stars.
    dust : float32 array, shape (pixels,)
        Map of the Milky Way's A(V) to infinity, mag (truesky.catalogue.dust_map).

    Returns
    -------
    Table
        Rows of table `stars`, sorted by _healpix_29 (the order-29 cell of the position).

    Raises
    ------
    BadInput
        If the cell is in the Galactic plane or the bulge, and the model has no magnitude limit for them.

    Notes
    -----
    The density of stars at the centre of the cell is used for the whole cell. The error at its edges is 2 % at
    |b| = 20 deg.
    """
    lon, lat = _centres([cell])
    limit = float(_limits(lon, lat, universe)[0])
    where = (float(lon[0]), float(lat[0]), sky.cell_area(GENERATION_ORDER), limit)
    if universe.catalogue is None:
        lots = _draw_model_stars(cell, seed, universe, dust, where)
    else:
        lots = [_stars_of_catalogue(cell, seed, universe.catalogue, universe, dust)]
    if universe.brown_dwarfs is not None:
        lots.append(_draw_brown_dwarfs(cell, seed, universe, universe.brown_dwarfs, dust, where))
    selections = [_is_selected(universe, lot, limit) for lot in lots]
    if universe.bright is not None:
        lots.append(_tycho_stars(cell, universe.bright, universe.types))
        selections.append((lots[-1]["mag_h"] < limit) & (lots[-1]["mag_h"] >= universe.brightest))
    first = np.cumsum([0, *(len(lot["ra"]) for lot in lots)])
    table = declarations.stars(universe.variables)
    tables = [
        table.build(
            {"id": ids.source_id(STAR, cell, start + np.flatnonzero(keep)), **{k: v[..., keep] for k, v in lot.items()}}
        )
        for start, lot, keep in zip(first[:-1], lots, selections, strict=True)
    ]
    rows = pa.concat_tables(tables)
    return rows if len(lots) == 1 else rows.sort_by([("_healpix_29", "ascending"), ("id", "ascending")])


def _draw_model_stars(cell: int, seed: int, universe: StarModel, dust: Float32, where: CellView) -> list[Lot]:
    """Draw stars from the model of the Milky Way, and their companions; return both groups before any selection."""
    galaxy = universe.galaxy
    rngs = (stream(seed, f"stars.{quantity}", cell) for quantity in ("luminosity", "metallicity"))
    stars = milky_way.draw(galaxy, milky_way.expected_per_bin(galaxy, *where), *rngs)
    place = _draw_positions(cell, universe, dust, stars.distance, stream(seed, "stars.position", cell))
    deviates = stream(seed, "stars.velocity", cell).standard_normal((3, stars.distance.size))
    common = {
        "component": stars.component,
        "metallicity": stars.metallicity,
        "age": np.ma.masked_invalid(stars.age),
        "density_boost": np.ones(stars.age.size),
        **_motion_columns(place, stars.component, stars.age, deviates),
    }
    primary_columns = {"stage": stars.stage, "mass": np.ma.masked_invalid(stars.mass)}
    lot = (
        place
        | common
        | primary_columns
        | _spectrum_columns(universe, stars.m_h, stars.distance, stars.teff, stars.log_g, stars.metallicity)
    )
    rng = stream(seed, "stars.companions", cell)
    secondaries = companions.draw(galaxy.tracks, stars.track, stars.mass, rng)
    primary = secondaries.primary
    axis, *offset = companions.draw_orbits(stars.mass[primary], secondaries.mass, rng)
    companion_lot = {name: values[primary] for name, values in (place | common).items()}
    companion_lot |= _companion_positions(cell, place, primary, (offset[0], offset[1]))
    companion_lot |= _spectrum_columns(
        universe,
        secondaries.m_h,
        stars.distance[primary],
        secondaries.teff,
        secondaries.log_g,
        stars.metallicity[primary],
    )
    companion_lot |= {
        "stage": np.zeros(primary.size, np.int64),
        "mass": secondaries.mass,
        "companion_of": ids.source_id(STAR, cell, primary),
    }
    if universe.variables:
        light_curves = variables.columns(lot, companion_lot, (primary, axis), cell, seed)
        lot, companion_lot = lot | light_curves[0], companion_lot | light_curves[1]
    return [lot | {"companion_of": bright_stars.masked_column(stars.age.size)}, companion_lot]


def _spectrum_columns(
    universe: StarModel, m_h: Float, distance: Float, teff: Float, log_g: Float, metallicity: Float
) -> Lot:
    """Return columns of table `stars`: H magnitudes, temperature, surface gravity, and the mixture of template spectra.

    White dwarfs get the spectra of main-sequence stars with their temperature.
    """
    mixture = model_stars.mixture(universe.types, universe.models, teff, log_g, metallicity)
    lot: Lot = {
        "sed": mixture.sed[0],
        "mag_h": m_h + _distance_modulus(distance),
        "abs_mag_h": m_h,
        "teff": teff,
        "log_g": log_g,
    }
    for k in range(1, model_stars.MIXTURE_SIZE):
        # Use the small data types of the table now, because a crowded cell takes much memory.
        lot |= {f"sed_{k + 1}": mixture.sed[k].astype(np.int16), f"frac_{k + 1}": mixture.frac[k].astype(np.float32)}
    return lot


def _motion_columns(place: Lot, component: Int, age: Float, deviates: Float) -> Lot:
    ra, dec, distance = (np.asarray(place[name], float) for name in ("ra", "dec", "distance"))
    motion = kinematics.velocities(ra, dec, distance, component, age, deviates)
    names = ("pm_ra", "pm_dec", "radial_velocity")
    return {name: np.ma.masked_invalid(v.astype(np.float32)) for name, v in zip(names, motion, strict=True)}


def _companion_positions(cell: int, place: Lot, primary: Int, offset: tuple[Float, Float]) -> Lot:
    """Return the positions of companions with given offsets (east, north, AU) from their primary stars.

    A companion that would be outside the order-8 cell is placed on the other side of its star. If that position is also
    outside, the companion gets the position of the star.
    """
    ra, dec, index = (place[name][primary].copy() for name in ("ra", "dec", "_healpix_29"))
    east, north = (np.radians(_AU_PC * axis / place["distance"][primary]) for axis in offset)
    remaining = np.arange(primary.size)
    for side in (1.0, -1.0):
        positions = sky.offset_positions(
            place["ra"][primary[remaining]],
            place["dec"][primary[remaining]],
            side * east[remaining],
            side * north[remaining],
        )
        indices = sky.healpix_29(*positions)
        inside = indices >> 2 * (sky.MAX_ORDER - GENERATION_ORDER) == cell
        chosen = remaining[inside]
        ra[chosen], dec[chosen], index[chosen] = positions[0][inside], positions[1][inside], indices[inside]
        remaining = remaining[~inside]
    return {"ra": ra, "dec": dec, "_healpix_29": index}


def _draw_brown_dwarfs(
    cell: int, seed: int, universe: StarModel, dwarfs: BrownDwarfs, dust: Float32, where: CellView
) -> Lot:
    """Draw the L and T dwarfs in a cell, before the selection by observed magnitude."""
    dwarf_sample = brown_dwarfs.draw(dwarfs, universe.galaxy, *where, stream(seed, "brown_dwarfs.number", cell))
    n = dwarf_sample.template.size
    m_h = dwarfs.m_h[dwarf_sample.template]
    place = _draw_positions(cell, universe, dust, dwarf_sample.distance, stream(seed, "brown_dwarfs.position", cell))
    deviates = stream(seed, "brown_dwarfs.velocity", cell).standard_normal((3, n))
    rng, metals = stream(seed, "brown_dwarfs.metallicity", cell), dwarfs.metallicity
    return {
        **place,
        **_motion_columns(place, np.full(n, BROWN), np.full(n, np.nan), deviates),
        "component": np.full(n, BROWN),
        "sed": dwarfs.first_template + dwarf_sample.template,
        "mag_h": m_h + _distance_modulus(dwarf_sample.distance),
        "abs_mag_h": m_h,
        "teff": dwarfs.teff[dwarf_sample.template],
        "log_g": np.full(n, dwarfs.log_g),
        "metallicity": np.clip(rng.normal(*metals, n), *universe.galaxy.limits),
        "density_boost": np.full(n, dwarfs.boost),
        "stage": np.full(n, _BROWN_DWARF),
    }


def _draw_positions(cell: int, universe: StarModel, dust: Float32, distance: Float, rng: np.random.Generator) -> Lot:
    """Draw uniform positions in an order-8 cell for stars with distances (pc), and compute their extinction A(V)."""
    index, ra, dec = sky.random_in_cell(GENERATION_ORDER, cell, distance.size, rng)
    a_v = _extinction(universe, distance, dust, ra, dec)
    return {"_healpix_29": index, "ra": ra, "dec": dec, "distance": distance, "a_v": a_v}


def _stars_of_catalogue(cell: int, seed: int, catalogue: StarCatalogue, universe: StarModel, dust: Float32) -> Lot:
    """Return the stars of the user's catalogue in a cell, as columns of table `stars`.

    Extinctions that the catalogue does not contain are computed from the dust map. Velocities are drawn if the
    catalogue has distances. Stars without a population belong to the thin disc. Other missing values are null.
    """
    values = from_catalogue.stars_of_cell(catalogue, cell)
    n = len(values["ra"])
    unknown = bright_stars.masked_column(n)
    lot: Lot = {name: values.get(name, unknown) for name in ("distance", "log_g", "metallicity", "stage")}
    infinity = np.full(n, np.inf)
    a_v = values.get("a_v")
    if a_v is None:
        a_v = _extinction(universe, values.get("distance", infinity), dust, values["ra"], values["dec"])
    has_distance = "distance" in values
    component = values.get("component", np.full(n, milky_way.THIN))
    if has_distance:
        deviates = stream(seed, "stars.velocity", cell).standard_normal((3, n))
        lot |= _motion_columns(values, component, np.full(n, np.nan), deviates)
    return lot | {
        "_healpix_29": values["index"],
        "ra": values["ra"],
        "dec": values["dec"],
        "component": component,
        "sed": nearest_template(universe.types.teff, values["teff"]),
        "mag_h": values["mag_h"],
        "abs_mag_h": values["mag_h"] - _distance_modulus(values["distance"]) if has_distance else unknown,
        "teff": values["teff"],
        "a_v": a_v,
        "density_boost": np.ones(n),
    }


def _tycho_stars(cell: int, bright: BrightStars, types: StellarTypes) -> Lot:
    """Return the Tycho-2 stars in a cell; their magnitudes are observed ones, so their extinction is set to 0."""
    rows = bright_stars.rows_of_cell(bright, cell)
    columns = bright_stars.columns(bright, rows, types)
    n = len(columns["sed"])
    return columns | {
        "_healpix_29": bright.index[rows],
        "ra": bright.ra[rows],
        "dec": bright.dec[rows],
        "component": np.full(n, BRIGHT),
        "a_v": np.zeros(n),
        "density_boost": np.ones(n),
        "stage": bright_stars.masked_column(n),
    }


def _is_selected(universe: StarModel, lot: Mapping[str, Any], limit: float) -> Bool:
    """Return True for stars within the limits of the observed H magnitude that Tycho-2 stars do not replace.

    Tycho-2, if it is given, replaces the stars with an observed V magnitude brighter than its limit.
    """
    mag = lot["mag_h"] + universe.h_over_v * lot["a_v"]
    is_visible = (mag < limit) & (mag >= universe.brightest)
    if universe.bright is None:
        return np.asarray(is_visible)
    return np.asarray(is_visible & (mag_v(universe, lot) >= universe.bright.hand_over))


def mag_v(universe: StarModel, lot: Mapping[str, Any]) -> Float:
    """Return the observed V magnitude (Vega, with extinction) of stars; it is infinite for L and T dwarfs."""
    n, dwarfs = universe.types.teff.size, universe.v_minus_h
    light = np.zeros(universe.models + dwarfs.size - n)
    light[:n], light[universe.models :] = 10.0 ** (0.4 * dwarfs[:n]), 10.0 ** (0.4 * dwarfs[n:])
    # `light` is the flux in H relative to V of each template. L and T dwarfs have no flux in V.
    light[n : universe.models] = np.inf
    light_v = _main_fraction(lot) * light[lot["sed"]]
    for k in range(2, model_stars.MIXTURE_SIZE + 1):
        if f"sed_{k}" in lot:
            light_v = light_v + lot[f"frac_{k}"] * light[lot[f"sed_{k}"]]
    return np.asarray(lot["mag_h"] + 2.5 * np.log10(light_v) + lot["a_v"])


def _main_fraction(lot: Mapping[str, Any]) -> Float:
    """Return the flux fraction of the first template of each star: 1 minus the fractions of its other templates."""
    other_fractions = [
        lot[name] for name in (f"frac_{k}" for k in range(2, model_stars.MIXTURE_SIZE + 1)) if name in lot
    ]
    return 1.0 - sum(other_fractions, np.zeros(len(lot["sed"])))


def _distance_modulus(distance: Float) -> Float:
    return np.asarray(5.0 * np.log10(distance) - 5.0)


def nearest_template(library: Float, teff: Float) -> Int:
    """Return the index of the temperature in `library` (K, in any order) that is nearest to each `teff` in ln(Teff)."""
    order = np.argsort(library)
    between = 0.5 * np.log(library[order][1:] * library[order][:-1])
    return np.asarray(order[np.searchsorted(between, np.log(teff))], np.int64)


def _extinction(universe: StarModel, distance: Float, dust: Float32, ra: Float, dec: Float) -> Float:
    _, lat = sky.galactic(ra, dec)
    return dust_map.a_v_at(dust_map.a_v(dust, ra, dec), distance, lat, universe.layer, universe.sin_b_min)
