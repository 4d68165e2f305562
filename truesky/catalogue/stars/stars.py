"""Stars of one generation cell: table `stars`, a pure function of (seed, cell, model).

model    the Milky Way or a catalogue of stars, L and T dwarfs, Tycho-2, the dust, the stellar library
numbers  how many stars to expect, without drawing them: what can not be drawn is refused
draw     numbers by distance and luminosity -> places -> dust on the way -> labels, spectra -> selection

Four lots make a cell: the model's stars, their companions, L and T dwarfs, and, where it is given, Tycho-2 instead of
the model's bright stars.
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
from lake_schema.tables.stars import STARS
from truesky.catalogue import dust_map, parameters
from truesky.catalogue.stars import bright_stars, brown_dwarfs, companions, from_catalogue, kinematics, milky_way
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

# A lot of stars of a cell: values by column, without identifiers.
Lot = dict[str, Any]
# Galactic l, b of a cell's centre, its area, deg2, and the faintest H.
CellView = tuple[float, float, float, float]

STAR = 5
BRIGHT, BROWN = 3, 4
_BROWN_DWARF = 3
# A generation cell is drawn whole: 2e6 stars take 1.6 GB, and fewer than the 22 bits of an id can number.
_MAX_STARS = 2e6
# Nearer to the Galactic plane than so many deg, and before the bulge (|l|, |b|), cells have a limit of their own.
PLANE, BULGE = 5.0, (20.0, 10.0)
# One AU, seen from a pc, deg.
_AU_PC = 1.0 / 3600.0


@dataclass(frozen=True, slots=True, eq=False)
class StarModel:
    """Everything that stars are drawn from, made once by `model`.

    limit, plane_limit : faintest H, Vega, with the Milky Way's extinction; of cells with their centre nearer to the
                         plane than PLANE, or inside BULGE; None = not to be drawn
    brightest  : brighter H are left out
    galaxy     : whose stars are drawn, unless there is a
    catalogue  : of other stars
    brown      : L and T dwarfs, None = none; bright : Tycho-2, None = the model's own bright stars
    h_over_v   : A(H) / A(V); types : of the stellar library's first templates; models : index of its first model
    v_minus_h  : [template] of the types and the models
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


def model(
    limit: float = 26.0,
    plane_limit: float | None = None,
    density: str = "juric",
    brown_dwarf_boost: float = 1.0,
    catalogue: StarCatalogue | None = None,
    bright: BrightStars | None = None,
    brightest: float = -math.inf,
) -> StarModel:
    """The embedded universe's stars with brightest <= H < limit (0.2 s).

    density           : one of milky_way.MODELS
    brown_dwarf_boost : how many times denser than in nature L and T dwarfs are, 0 = not at all
    limit, plane_limit : faintest H, mag, Vega, plane_limit in the Galactic plane; None: cells there are refused
    catalogue, bright  : external stars in place of the drawn ones, and of those that are bright
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
    """Stars to expect in order-8 cells, before their dust, float64[n] (20 us a cell).

    cells : int[n] nested
    Errors: BadInput where stars are not to be drawn, or are too many
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
            f"{np.sum(counts > _MAX_STARS)} of the area's cells hold more than {_MAX_STARS:.3g} stars, the one at l = "
            f"{lon[worst]:.1f}, b = {lat[worst]:.1f} {counts[worst]:.3g} to H = {limit[worst]:g}: ask for a brighter "
            f"{key}, or leave them out"
        )
    return counts


def _centres(cells: npt.ArrayLike) -> tuple[Float, Float]:
    """Galactic l[n], b[n] deg of order-8 cells."""
    return sky.galactic(*sky.cell_centres(GENERATION_ORDER, cells))


def _is_crowded(lon: npt.ArrayLike, lat: npt.ArrayLike) -> Bool:
    """Is a cell near the Galactic plane, or before the bulge?"""
    in_bulge_longitude = np.abs((np.asarray(lon) + 180.0) % 360.0 - 180.0) < BULGE[0]
    return np.asarray((np.abs(lat) < PLANE) | (in_bulge_longitude & (np.abs(lat) < BULGE[1])))


def _limits(lon: Float, lat: Float, universe: StarModel) -> Float:
    """Faintest H[n] of cells at Galactic coordinates."""
    in_plane = _is_crowded(lon, lat)
    if not in_plane.any():
        return np.full(lat.size, universe.limit)
    if universe.plane_limit is None:
        raise BadInput(
            f"{in_plane.sum()} of the area's cells lie within {PLANE:g} deg of the Galactic plane or {BULGE[1]:g} deg "
            "of the bulge, where stars are too many: move the area, or say with stars.plane_limit to which H they are "
            "to be drawn there"
        )
    return np.where(in_plane, universe.plane_limit, universe.limit)


def draw(cell: int, seed: int, universe: StarModel, dust: Float32) -> pa.Table:
    """Table `stars` of one order-8 cell, sorted by _healpix_29.

    dust : float32[pixel] mag, map of the Milky Way's A(V) to infinity (truesky.catalogue.dust_map)
    cell : nested index at order 8;  seed : of the request;  universe : of `model`
    Errors: BadInput as `numbers`
    Error: the density is that of the cell's centre: 2 % at its edges at |b| = 20 deg
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
    tables = [
        STARS.build(
            {"id": ids.source_id(STAR, cell, start + np.flatnonzero(keep)), **{k: v[..., keep] for k, v in lot.items()}}
        )
        for start, lot, keep in zip(first[:-1], lots, selections, strict=True)
    ]
    rows = pa.concat_tables(tables)
    return rows if len(lots) == 1 else rows.sort_by([("_healpix_29", "ascending"), ("id", "ascending")])


def _draw_model_stars(cell: int, seed: int, universe: StarModel, dust: Float32, where: CellView) -> list[Lot]:
    """Stars of the Milky Way's model, and their companions."""
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
    offset = companions.projected_offsets(stars.mass[primary], secondaries.mass, rng)
    companion_lot = {name: values[primary] for name, values in (place | common).items()}
    companion_lot |= _companion_positions(cell, place, primary, offset)
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
    return [lot | {"companion_of": bright_stars.masked_column(stars.age.size)}, companion_lot]


def _spectrum_columns(
    universe: StarModel, m_h: Float, distance: Float, teff: Float, log_g: Float, metallicity: Float
) -> Lot:
    """Magnitudes, labels and what the spectra are mixed of; white dwarfs take the dwarfs of their temperature."""
    mixture = model_stars.mixture(universe.types, universe.models, teff, log_g, metallicity)
    lot: Lot = {
        "sed": mixture.sed[0],
        "mag_h": m_h + _distance_modulus(distance),
        "abs_mag_h": m_h,
        "teff": teff,
        "log_g": log_g,
    }
    for k in range(1, model_stars.MIXTURE_SIZE):
        # As they are stored: a crowded cell is large.
        lot |= {f"sed_{k + 1}": mixture.sed[k].astype(np.int16), f"frac_{k + 1}": mixture.frac[k].astype(np.float32)}
    return lot


def _motion_columns(place: Lot, component: Int, age: Float, deviates: Float) -> Lot:
    ra, dec, distance = (np.asarray(place[name], float) for name in ("ra", "dec", "distance"))
    motion = kinematics.velocities(ra, dec, distance, component, age, deviates)
    names = ("pm_ra", "pm_dec", "radial_velocity")
    return {name: np.ma.masked_invalid(v.astype(np.float32)) for name, v in zip(names, motion, strict=True)}


def _companion_positions(cell: int, place: Lot, primary: Int, offset: tuple[Float, Float]) -> Lot:
    """Where companions are: on the other side of their star where they would leave the cell, else on it."""
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
    """L and T dwarfs."""
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
    """Places uniform in a cell, ascending, and the dust on the way."""
    index, ra, dec = sky.random_in_cell(GENERATION_ORDER, cell, distance.size, rng)
    a_v = _extinction(universe, distance, dust, ra, dec)
    return {"_healpix_29": index, "ra": ra, "dec": dec, "distance": distance, "a_v": a_v}


def _stars_of_catalogue(cell: int, seed: int, catalogue: StarCatalogue, universe: StarModel, dust: Float32) -> Lot:
    """Stars of an external catalogue; what it does not say is null, dust and velocities are ours."""
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
    """Stars of Tycho-2, as they are seen: no extinction is put before them."""
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
    """[n] brighter than the limit, not too bright, and not where Tycho-2 has the stars."""
    mag = lot["mag_h"] + universe.h_over_v * lot["a_v"]
    is_visible = (mag < limit) & (mag >= universe.brightest)
    if universe.bright is None:
        return np.asarray(is_visible)
    return np.asarray(is_visible & (mag_v(universe, lot) >= universe.bright.hand_over))


def mag_v(universe: StarModel, lot: Mapping[str, Any]) -> Float:
    """V[n] as observed, Vega; of L and T dwarfs fainter than can be seen."""
    n, dwarfs = universe.types.teff.size, universe.v_minus_h
    light = np.zeros(universe.models + dwarfs.size - n)
    light[:n], light[universe.models :] = 10.0 ** (0.4 * dwarfs[:n]), 10.0 ** (0.4 * dwarfs[n:])
    # Light in H for as much in V; of L and T dwarfs there is none in V.
    light[n : universe.models] = np.inf
    light_v = _main_fraction(lot) * light[lot["sed"]]
    for k in range(2, model_stars.MIXTURE_SIZE + 1):
        if f"sed_{k}" in lot:
            light_v = light_v + lot[f"frac_{k}"] * light[lot[f"sed_{k}"]]
    return np.asarray(lot["mag_h"] + 2.5 * np.log10(light_v) + lot["a_v"])


def _main_fraction(lot: Mapping[str, Any]) -> Float:
    """Share of the template of each star's largest share."""
    other_fractions = [
        lot[name] for name in (f"frac_{k}" for k in range(2, model_stars.MIXTURE_SIZE + 1)) if name in lot
    ]
    return 1.0 - sum(other_fractions, np.zeros(len(lot["sed"])))


def _distance_modulus(distance: Float) -> Float:
    return np.asarray(5.0 * np.log10(distance) - 5.0)


def nearest_template(library: Float, teff: Float) -> Int:
    """Index[n] of the library's star of nearest ln(Teff); library : [template] K in any order.

    teff : float[n] K
    """
    order = np.argsort(library)
    between = 0.5 * np.log(library[order][1:] * library[order][:-1])
    return np.asarray(order[np.searchsorted(between, np.log(teff))], np.int64)


def _extinction(universe: StarModel, distance: Float, dust: Float32, ra: Float, dec: Float) -> Float:
    _, lat = sky.galactic(ra, dec)
    return dust_map.a_v_at(dust_map.a_v(dust, ra, dec), distance, lat, universe.layer, universe.sin_b_min)
