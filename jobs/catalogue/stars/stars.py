"""Stars of one generation cell: table `stars`, a pure function of (seed, cell, model).

model    the Milky Way or a catalogue of stars, L and T dwarfs, Tycho-2, the dust, the stellar library
numbers  how many stars to expect, without drawing them: what can not be drawn is refused
draw     numbers by distance and luminosity -> places -> dust on the way -> labels, spectra -> selection

Three lots make a cell: the model's stars, L and T dwarfs, and, where it is given, Tycho-2 instead of the model's bright
stars.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from jobs.catalogue import dust_map, parameters
from jobs.catalogue.stars import bright_stars, brown_dwarfs, from_catalogue, milky_way
from jobs.catalogue.stars.bright_stars import BrightStars
from jobs.catalogue.stars.brown_dwarfs import BrownDwarfs
from jobs.catalogue.stars.from_catalogue import StarCatalogue
from jobs.catalogue.stars.milky_way import MilkyWay
from jobs.fluxes.libraries import stellar
from jobs.fluxes.libraries.stellar import StellarTypes
from jobs.rng import stream
from lake_schema import ids, sky
from lake_schema.arrays import Bool, Float, Float32, Int
from lake_schema.errors import BadInput
from lake_schema.ids import GENERATION_ORDER
from lake_schema.tables.stars import STARS

# A lot of stars of a cell: values by column, without identifiers.
Lot = dict[str, Any]
# Galactic l, b of a cell's centre, its area, deg2, and the faintest H.
Where = tuple[float, float, float, float]

STAR = 5
BRIGHT, BROWN = 3, 4
_BROWN_DWARF = 3
# A generation cell is drawn whole: 3e6 stars take 1.1 GB, and fewer than the 22 bits of an id can number.
_MOST_STARS = 3e6
# Nearer to the Galactic plane, deg, cells are drawn to a limit of their own.
PLANE = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class StarModel:
    """Everything that stars are drawn from, made once by `model`.

    limit, plane_limit : faintest H, Vega, with the Milky Way's extinction; of cells with their centre nearer to the
                         plane than PLANE; None = not to be drawn
    brightest  : brighter H are left out
    galaxy     : whose stars are drawn, unless there is a
    catalogue  : of other stars
    brown      : L and T dwarfs, None = none; bright : Tycho-2, None = the model's own bright stars
    h_over_v   : A(H) / A(V); types : of the stellar library's first templates
    """

    limit: float
    plane_limit: float | None
    brightest: float
    galaxy: MilkyWay
    catalogue: StarCatalogue | None
    brown: BrownDwarfs | None
    bright: BrightStars | None
    layer: dust_map.Layer
    sin_b_min: float
    h_over_v: float
    types: StellarTypes


def model(
    limit: float = 26.0,
    plane_limit: float | None = None,
    density: str = "juric",
    brown_dwarf_boost: float = 1.0,
    catalogue: StarCatalogue | None = None,
    bright: BrightStars | None = None,
    brightest: float = -math.inf,
) -> StarModel:
    """The embedded universe's stars with brightest <= H < limit (70 ms).

    density           : one of milky_way.MODELS
    brown_dwarf_boost : how many times denser than in nature L and T dwarfs are, 0 = not at all
    limit, plane_limit : faintest H, mag, Vega, plane_limit in the Galactic plane; None: cells there are refused
    catalogue, bright  : external stars in place of the drawn ones, and of those that are bright
    """
    return StarModel(
        limit=limit,
        plane_limit=plane_limit,
        brightest=brightest,
        galaxy=milky_way.milky_way(density),
        catalogue=catalogue,
        brown=brown_dwarfs.brown_dwarfs(brown_dwarf_boost) if brown_dwarf_boost else None,
        bright=bright,
        layer=dust_map.layer(),
        sin_b_min=dust_map.cosecant().sin_b_min,
        h_over_v=float(parameters.section("milky_way.toml", "extinction")["h_over_v"]),
        types=stellar.types(),
    )


def numbers(cells: npt.ArrayLike, universe: StarModel) -> Float:
    """Stars to expect in order-8 cells, before their dust, float64[n] (20 us a cell).

    cells : int[n] nested
    Errors: BadInput where stars are not to be drawn, or are too many
    """
    lon, lat = _centres(cells)
    limit = _limits(lat, universe)
    where = (lon, lat, sky.cell_area(GENERATION_ORDER), limit)
    if universe.catalogue is None:
        found = milky_way.numbers(universe.galaxy, *where)
    else:
        found = from_catalogue.numbers(universe.catalogue, cells)
    if universe.brown is not None:
        found += brown_dwarfs.numbers(universe.brown, universe.galaxy, *where)
    if found.max(initial=0.0) > _MOST_STARS:
        worst = int(found.argmax())
        key = "universe.star_limit" if abs(lat[worst]) >= PLANE else "stars.plane_limit"
        raise BadInput(
            f"{np.sum(found > _MOST_STARS)} of the area's cells hold more than {_MOST_STARS:.3g} stars, the one at l = "
            f"{lon[worst]:.1f}, b = {lat[worst]:.1f} {found[worst]:.3g} to H = {limit[worst]:g}: ask for a brighter "
            f"{key}, or leave them out"
        )
    return found


def _centres(cells: npt.ArrayLike) -> tuple[Float, Float]:
    """Galactic l[n], b[n] deg of order-8 cells."""
    return sky.galactic(*sky.cell_centres(GENERATION_ORDER, cells))


def _limits(lat: Float, universe: StarModel) -> Float:
    """Faintest H[n] of cells at Galactic latitudes."""
    in_plane = np.abs(lat) < PLANE
    if not in_plane.any():
        return np.full(lat.size, universe.limit)
    if universe.plane_limit is None:
        raise BadInput(
            f"{in_plane.sum()} of the area's cells lie within {PLANE:g} deg of the Galactic plane, where stars are too "
            "many: move the area, or say with stars.plane_limit to which H they are to be drawn there"
        )
    return np.where(in_plane, universe.plane_limit, universe.limit)


def draw(cell: int, seed: int, universe: StarModel, dust: Float32) -> pa.Table:
    """Table `stars` of one order-8 cell, sorted by _healpix_29.

    dust : float32[pixel] mag, map of the Milky Way's A(V) to infinity (jobs.catalogue.dust_map)
    cell : nested index at order 8;  seed : of the request;  universe : of `model`
    Errors: BadInput as `numbers`
    Error: the density is that of the cell's centre: 2 % at its edges at |b| = 20 deg
    """
    lon, lat = _centres([cell])
    limit = float(_limits(lat, universe)[0])
    where = (float(lon[0]), float(lat[0]), sky.cell_area(GENERATION_ORDER), limit)
    if universe.catalogue is None:
        lots = [_drawn(cell, seed, universe, dust, where)]
    else:
        lots = [_given(cell, universe.catalogue, universe, dust)]
    if universe.brown is not None:
        lots.append(_brown(cell, seed, universe, universe.brown, dust, where))
    kept = [_selected(universe, lot, limit) for lot in lots]
    if universe.bright is not None:
        lots.append(_catalogued(cell, universe.bright, universe.types))
        kept.append((lots[-1]["mag_h"] < limit) & (lots[-1]["mag_h"] >= universe.brightest))
    first = np.cumsum([0, *(len(lot["ra"]) for lot in lots)])
    tables = [
        STARS.build(
            {"id": ids.source_id(STAR, cell, start + np.flatnonzero(keep)), **{k: v[keep] for k, v in lot.items()}}
        )
        for start, lot, keep in zip(first[:-1], lots, kept, strict=True)
    ]
    rows = pa.concat_tables(tables)
    return rows if len(lots) == 1 else rows.sort_by([("_healpix_29", "ascending"), ("id", "ascending")])


def _drawn(cell: int, seed: int, universe: StarModel, dust: Float32, where: Where) -> Lot:
    """Stars of the Milky Way's model."""
    galaxy = universe.galaxy
    stars = milky_way.draw(galaxy, milky_way.expected(galaxy, *where), stream(seed, "stars.luminosity", cell))
    metals = milky_way.metallicity(galaxy, stars.component, stream(seed, "stars.metallicity", cell))
    teff = milky_way.teff(galaxy, stars)
    return {
        **_placed(cell, universe, dust, stars.distance, stream(seed, "stars.position", cell)),
        "component": stars.component,
        "sed": nearest_template(universe.types.teff, teff),
        "mag_h": stars.m_h + _modulus(stars.distance),
        "abs_mag_h": stars.m_h,
        "teff": teff,
        "log_g": milky_way.log_g(galaxy, stars),
        "metallicity": metals,
        "density_boost": np.ones(teff.size),
        "stage": stars.stage,
    }


def _brown(cell: int, seed: int, universe: StarModel, dwarfs: BrownDwarfs, dust: Float32, where: Where) -> Lot:
    """L and T dwarfs."""
    found = brown_dwarfs.draw(dwarfs, universe.galaxy, *where, stream(seed, "brown_dwarfs.number", cell))
    n = found.template.size
    thin = np.full(n, milky_way.THIN)
    m_h = dwarfs.m_h[found.template]
    return {
        **_placed(cell, universe, dust, found.distance, stream(seed, "brown_dwarfs.position", cell)),
        "component": np.full(n, BROWN),
        "sed": dwarfs.first + found.template,
        "mag_h": m_h + _modulus(found.distance),
        "abs_mag_h": m_h,
        "teff": dwarfs.teff[found.template],
        "log_g": np.full(n, dwarfs.log_g),
        "metallicity": milky_way.metallicity(universe.galaxy, thin, stream(seed, "brown_dwarfs.metallicity", cell)),
        "density_boost": np.full(n, dwarfs.boost),
        "stage": np.full(n, _BROWN_DWARF),
    }


def _placed(cell: int, universe: StarModel, dust: Float32, distance: Float, rng: np.random.Generator) -> Lot:
    """Places uniform in a cell, ascending, and the dust on the way."""
    index, ra, dec = sky.random_in_cell(GENERATION_ORDER, cell, distance.size, rng)
    a_v = _extinction(universe, distance, dust, ra, dec)
    return {"_healpix_29": index, "ra": ra, "dec": dec, "distance": distance, "a_v": a_v}


def _given(cell: int, catalogue: StarCatalogue, universe: StarModel, dust: Float32) -> Lot:
    """Stars of an external catalogue; what it does not say is null, dust is ours."""
    values = from_catalogue.of_cell(catalogue, cell)
    n = len(values["ra"])
    unknown = bright_stars.unknown(n)
    lot: Lot = {name: values.get(name, unknown) for name in ("distance", "log_g", "metallicity", "stage")}
    far = np.full(n, np.inf)
    a_v = values.get("a_v")
    if a_v is None:
        a_v = _extinction(universe, values.get("distance", far), dust, values["ra"], values["dec"])
    known = "distance" in values
    return lot | {
        "_healpix_29": values["index"],
        "ra": values["ra"],
        "dec": values["dec"],
        "component": values.get("component", np.full(n, milky_way.THIN)),
        "sed": nearest_template(universe.types.teff, values["teff"]),
        "mag_h": values["mag_h"],
        "abs_mag_h": values["mag_h"] - _modulus(values["distance"]) if known else unknown,
        "teff": values["teff"],
        "a_v": a_v,
        "density_boost": np.ones(n),
    }


def _catalogued(cell: int, bright: BrightStars, types: StellarTypes) -> Lot:
    """Stars of Tycho-2, as they are seen: no extinction is put before them."""
    rows = bright_stars.of_cell(bright, cell)
    found = bright_stars.columns(bright, rows, types)
    n = len(found["sed"])
    return found | {
        "_healpix_29": bright.index[rows],
        "ra": bright.ra[rows],
        "dec": bright.dec[rows],
        "component": np.full(n, BRIGHT),
        "a_v": np.zeros(n),
        "density_boost": np.ones(n),
        "stage": bright_stars.unknown(n),
    }


def _selected(universe: StarModel, lot: Mapping[str, Any], limit: float) -> Bool:
    """[n] brighter than the limit, not too bright, and not where Tycho-2 has the stars."""
    mag = lot["mag_h"] + universe.h_over_v * lot["a_v"]
    seen = (mag < limit) & (mag >= universe.brightest)
    if universe.bright is None:
        return np.asarray(seen)
    return np.asarray(seen & (mag_v(universe.types, lot) >= universe.bright.hand_over))


def mag_v(types: StellarTypes, lot: Mapping[str, Any]) -> Float:
    """V[n] as observed, Vega; of L and T dwarfs fainter than can be seen."""
    colors = np.append(types.v_minus_h, np.inf)
    return np.asarray(lot["mag_h"] + colors[np.minimum(lot["sed"], len(types.names))] + lot["a_v"])


def _modulus(distance: Float) -> Float:
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
