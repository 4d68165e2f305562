"""Stars of one generation cell: table `stars`, a pure function of (seed, cell, model).

model    the Milky Way, the layer of dust, the temperatures of the stellar library
numbers  how many stars to expect, without drawing them: what can not be drawn is refused
draw     numbers by distance and luminosity -> places -> dust on the way -> selection -> labels, spectra
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from jobs.catalogue import dust_map, milky_way, parameters
from jobs.catalogue.milky_way import MilkyWay, Sample
from jobs.fluxes import stellar
from jobs.rng import stream
from lake_schema import ids, sky
from lake_schema.errors import BadInput
from lake_schema.ids import GENERATION_ORDER
from lake_schema.tables.stars import STARS

Float = npt.NDArray[np.float64]
Int = npt.NDArray[np.int64]

STAR = 5
# A generation cell is drawn whole: 3e6 stars take 1.1 GB, and fewer than the 22 bits of an id can number.
_MOST_STARS = 3e6
# Nearer to the Galactic plane, deg, cells are drawn to a limit of their own.
PLANE = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class StarModel:
    """Everything that stars are drawn from, made once by `model`.

    limit, plane_limit : faintest H, Vega, with the Milky Way's extinction; of cells with their centre nearer to the
                         plane than PLANE; None = not to be drawn
    h_over_v : A(H) / A(V); teff : [template] K, of the stellar library
    """

    limit: float
    plane_limit: float | None
    galaxy: MilkyWay
    layer: dust_map.Layer
    sin_b_min: float
    h_over_v: float
    teff: Float


def model(limit: float = 26.0, plane_limit: float | None = None) -> StarModel:
    """The embedded universe's stars with H < limit (10 ms)."""
    return StarModel(
        limit=limit,
        plane_limit=plane_limit,
        galaxy=milky_way.milky_way(),
        layer=dust_map.layer(),
        sin_b_min=dust_map.cosecant().sin_b_min,
        h_over_v=float(parameters.section("milky_way.toml", "extinction")["h_over_v"]),
        teff=stellar.types().teff,
    )


def numbers(cells: npt.ArrayLike, universe: StarModel) -> Float:
    """Stars to expect in order-8 cells, before their dust, float64[n] (20 us a cell).

    Errors: BadInput where stars are not to be drawn, or are too many
    """
    lon, lat = _centres(cells)
    limit = _limits(lat, universe)
    found = milky_way.numbers(universe.galaxy, lon, lat, sky.cell_area(GENERATION_ORDER), limit)
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


def draw(cell: int, seed: int, universe: StarModel, dust: npt.NDArray[np.float32]) -> pa.Table:
    """Table `stars` of one order-8 cell, sorted by _healpix_29.

    dust : map of the Milky Way's A(V) to infinity (jobs.catalogue.dust_map)
    Errors: BadInput as `numbers`
    Error: the density is that of the cell's centre: 2 % at its edges at |b| = 20 deg
    """
    galaxy = universe.galaxy
    lon, lat = _centres([cell])
    limit = float(_limits(lat, universe)[0])
    mean = milky_way.expected(galaxy, float(lon[0]), float(lat[0]), sky.cell_area(GENERATION_ORDER), limit)
    stars = milky_way.draw(galaxy, mean, stream(seed, "stars.luminosity", cell))
    index, ra, dec = sky.random_in_cell(GENERATION_ORDER, cell, stars.m_h.size, stream(seed, "stars.position", cell))
    a_v = _extinction(universe, stars, dust, ra, dec)
    mag_h = stars.m_h + 5.0 * np.log10(stars.distance) - 5.0
    metals = milky_way.metallicity(galaxy, stars.component, stream(seed, "stars.metallicity", cell))
    teff = milky_way.teff(galaxy, stars, metals)
    columns = {
        "id": ids.source_id(STAR, cell, np.arange(index.size)),
        "ra": ra,
        "dec": dec,
        "_healpix_29": index,
        "component": stars.component,
        "sed": nearest_template(universe.teff, teff),
        "mag_h": mag_h,
        "abs_mag_h": stars.m_h,
        "distance": stars.distance,
        "teff": teff,
        "log_g": milky_way.log_g(galaxy, stars),
        "metallicity": metals,
        "a_v": a_v,
        "density_boost": np.ones(index.size),
    }
    keep = mag_h + universe.h_over_v * a_v < limit
    return STARS.build({name: values[keep] for name, values in columns.items()})


def nearest_template(library: Float, teff: Float) -> Int:
    """Index[n] of the library's star of nearest ln(Teff); library : [template] K in any order."""
    order = np.argsort(library)
    between = 0.5 * np.log(library[order][1:] * library[order][:-1])
    return np.asarray(order[np.searchsorted(between, np.log(teff))], np.int64)


def _extinction(universe: StarModel, stars: Sample, dust: npt.NDArray[np.float32], ra: Float, dec: Float) -> Float:
    _, lat = sky.galactic(ra, dec)
    return dust_map.a_v_at(dust_map.a_v(dust, ra, dec), stars.distance, lat, universe.layer, universe.sin_b_min)
