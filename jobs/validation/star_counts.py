"""Stars and dwarfs drawn, against counts that other code published.

counts, dwarf_counts : a deg2 at a Galactic latitude, as in COUNTS and DWARFS;  around : the cells that are drawn
"""

from __future__ import annotations

import numpy as np
import pyarrow as pa

from jobs.catalogue.stars import brown_dwarfs, milky_way, stars
from jobs.fluxes.libraries import brown_dwarfs as spectra_of_dwarfs
from jobs.rng import stream
from lake_schema import sky
from lake_schema.arrays import Float, Float32
from lake_schema.ids import GENERATION_ORDER

SEED = 7
AREA = sky.cell_area(GENERATION_ORDER)
# Northern latitude -> stars deg-2 to I = 18, 20, 22, 24.5 and H = 18, 22, 26 (Vega), mean over longitude, without dust.
COUNTS = {
    90: (898, 2248, 5119, 12869, 2149, 10947, 36451),
    60: (1174, 2984, 6864, 17121, 2833, 14687, 47254),
    45: (1708, 4439, 10413, 25723, 4154, 22374, 67569),
    30: (3250, 8707, 21375, 52519, 7870, 46724, 124538),
    20: (6699, 18113, 46740, 116048, 15669, 104824, 249659),
}
LIMITS = {"I": (18.0, 20.0, 22.0, 24.5), "H": (18.0, 22.0, 26.0)}
# L, then T dwarfs deg-2 to J = 22, 24, 26 (Vega).
DWARFS = {30: (62, 267, 458, 6, 60, 330), 60: (32, 81, 105, 5, 35, 116), 90: (25, 57, 69, 5, 29, 83)}
# mas at G = 15, 17, 20: the law of PyGaia scaled to DR2, which publishes 0.04, 0.1, 0.7.
PARALLAX = {15.0: 0.037, 17.0: 0.098, 20.0: 0.765}


def around(b: float, cells: int, south: bool = False) -> list[int]:
    """Generation cells at Galactic latitude b, evenly in longitude; with `south`, every other one at -b.

    The Sun stands north of the plane, so that there are more stars in the south.
    """
    lon = np.arange(cells) * 360.0 / cells
    # At a pole the parallel is too short for them.
    lat = np.minimum(b, 89.9 - 0.1 * np.arange(cells)) * np.where(south & (np.arange(cells) % 2 == 1), -1.0, 1.0)
    return sorted({int(cell) for cell in sky.cell_of(*sky.equatorial(lon, lat), GENERATION_ORDER)})


def counts(b: float, cells: int, universe: stars.StarModel, dust: Float32) -> Float:
    """Stars drawn deg-2 at a latitude, as in COUNTS.

    b        : Galactic latitude, deg;  cells : that are drawn there
    universe : the model of stars;  dust : float32[pixel] map of A(V), mag
    """
    types, drawn = universe.types, around(b, cells)
    total = np.zeros(sum(map(len, LIMITS.values())))
    for cell in drawn:
        rows = stars.draw(cell, SEED, universe, dust)
        rows = rows.filter(pa.array(rows["component"].to_numpy() != stars.BROWN))
        h = rows["mag_h"].to_numpy().astype(float)
        mags = {"H": h, "I": h + (types.v_minus_h - types.color_vi)[rows["sed"].to_numpy()]}
        total += [np.sum(mags[band] < limit) for band, limits in LIMITS.items() for limit in limits]
    return np.asarray(total / (len(drawn) * AREA))


def dwarf_counts(b: float, area: float) -> Float:
    """L and T dwarfs drawn deg-2 at a latitude, as in DWARFS: one draw over so many deg2, without dust."""
    galaxy, dwarfs, types = milky_way.milky_way(), brown_dwarfs.brown_dwarfs(1.0), spectra_of_dwarfs.templates()
    found = brown_dwarfs.draw(dwarfs, galaxy, 90.0, b, area, 28.0, stream(SEED, "benchmark", int(b)))
    j = types.abs_mag_j[found.template] + 5.0 * np.log10(found.distance) - 5.0
    is_t = types.subtype[found.template] >= 10
    total = [np.sum(~is_t & (j < m)) for m in (22, 24, 26)] + [np.sum(is_t & (j < m)) for m in (22, 24, 26)]
    return np.array(total) / area
