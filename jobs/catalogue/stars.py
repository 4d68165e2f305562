"""Stars of one generation cell: table `stars`, a pure function of (seed, cell, model).

model   the Milky Way, the layer of dust, the temperatures of the stellar library
draw    numbers by distance and luminosity -> places -> dust on the way -> selection -> labels, spectra
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
# What fits the running number of an id (22 bits): exceeded in the plane, up to 30 deg from the centre.
_MOST_STARS = 4e6


@dataclass(frozen=True, slots=True, eq=False)
class StarModel:
    """Everything that stars are drawn from, made once by `model`.

    limit    : faintest H, Vega, with the Milky Way's extinction
    h_over_v : A(H) / A(V); teff : [template] K, of the stellar library
    """

    limit: float
    galaxy: MilkyWay
    layer: dust_map.Layer
    sin_b_min: float
    h_over_v: float
    teff: Float


def model(limit: float = 26.0) -> StarModel:
    """The embedded universe's stars with H < limit (10 ms)."""
    return StarModel(
        limit=limit,
        galaxy=milky_way.milky_way(),
        layer=dust_map.layer(),
        sin_b_min=dust_map.cosecant().sin_b_min,
        h_over_v=float(parameters.section("milky_way.toml", "extinction")["h_over_v"]),
        teff=stellar.types().teff,
    )


def draw(cell: int, seed: int, universe: StarModel, dust: npt.NDArray[np.float32]) -> pa.Table:
    """Table `stars` of one order-8 cell, sorted by _healpix_29.

    dust : map of the Milky Way's A(V) to infinity (jobs.catalogue.dust_map)
    Errors: BadInput where a cell holds more stars than can be numbered
    Error: the density is that of the cell's centre: 2 % at its edges at |b| = 20 deg
    """
    galaxy = universe.galaxy
    stars = _sample(cell, seed, universe)
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
    keep = mag_h + universe.h_over_v * a_v < universe.limit
    return STARS.build({name: values[keep] for name, values in columns.items()})


def nearest_template(library: Float, teff: Float) -> Int:
    """Index[n] of the library's star of nearest ln(Teff); library : [template] K in any order."""
    order = np.argsort(library)
    between = 0.5 * np.log(library[order][1:] * library[order][:-1])
    return np.asarray(order[np.searchsorted(between, np.log(teff))], np.int64)


def _sample(cell: int, seed: int, universe: StarModel) -> Sample:
    """Stars of a cell that are brighter than the limit but for extinction."""
    lon, lat = sky.galactic(*(np.array([angle]) for angle in sky.cell_centre(GENERATION_ORDER, cell)))
    area = sky.cell_area(GENERATION_ORDER)
    mean = milky_way.expected(universe.galaxy, float(lon[0]), float(lat[0]), area, universe.limit)
    if mean.sum() > _MOST_STARS:
        raise BadInput(
            f"cell {cell} (l = {lon[0]:.1f}, b = {lat[0]:.1f}) holds {mean.sum():.3g} stars brighter than "
            f"H = {universe.limit:g}, more than {_MOST_STARS:.3g}: ask for a brighter star_limit there"
        )
    return milky_way.draw(universe.galaxy, mean, stream(seed, "stars.luminosity", cell))


def _extinction(universe: StarModel, stars: Sample, dust: npt.NDArray[np.float32], ra: Float, dec: Float) -> Float:
    _, lat = sky.galactic(ra, dec)
    return dust_map.a_v_at(dust_map.a_v(dust, ra, dec), stars.distance, lat, universe.layer, universe.sin_b_min)
