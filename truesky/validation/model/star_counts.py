"""Compare drawn stars and brown dwarfs with published counts of other codes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lake_schema import sky
from lake_schema.arrays import Float, Float32
from lake_schema.ids import GENERATION_ORDER
from truesky.catalogue import dust_map
from truesky.catalogue.stars import brown_dwarfs, milky_way, stars
from truesky.catalogue.stars.density_laws import density
from truesky.catalogue.stars.stellar_populations import BROWN_DWARF, WHITE_DWARF
from truesky.fluxes.libraries import brown_dwarfs as spectra_of_dwarfs
from truesky.fluxes.libraries import model_stars
from truesky.randomness.rng import stream

SEED = 7
AREA = sky.cell_area(GENERATION_ORDER)
# HEALPix order of the cells that sample the whole sky.
_SKY_ORDER = 4
# Northern latitude -> stars deg-2 to H = 18, 22, 26 (Vega). The counts are means over longitude without dust,
# companions and white dwarfs. The laws of density and mass are the same as here; above 0.55 Msun the tables are those
# of BaSTI (Pietrinferni et al. 2004).
COUNTS = {
    90: (1997, 10951, 36048),
    60: (2650, 14683, 46733),
    45: (3938, 22341, 66843),
    30: (7664, 46523, 123315),
    20: (15541, 104005, 247463),
}
LIMITS = (18.0, 22.0, 26.0)
# L dwarfs deg-2 to J = 22, 24, 26 (Vega), then T dwarfs.
DWARFS = {30: (62, 267, 458, 6, 60, 330), 60: (32, 81, 105, 5, 35, 116), 90: (25, 57, 69, 5, 29, 83)}
# Parallax error (mas) at G = 15, 17, 20: the law of PyGaia scaled to DR2, which publishes 0.04, 0.1, 0.7.
PARALLAX = {15.0: 0.037, 17.0: 0.098, 20.0: 0.765}


def cells_at_latitude(b: float, cells: int, south: bool = False) -> list[int]:
    """Return generation cells at Galactic latitude `b`, evenly distributed in longitude.

    Parameters
    ----------
    b : float
        Galactic latitude, deg.
    cells : int
        Number of positions; cells that contain several are returned once.
    south : bool
        If True, every other position lies at -b. The Sun is north of the plane, so there are more stars in the south.

    Returns
    -------
    list of int
        Generation cells, ascending.
    """
    lon = np.arange(cells) * 360.0 / cells
    # The parallel at a pole is too short, so the latitudes there differ.
    lat = np.minimum(b, 89.9 - 0.1 * np.arange(cells)) * np.where(south & (np.arange(cells) % 2 == 1), -1.0, 1.0)
    return sorted({int(cell) for cell in sky.cell_at(*sky.equatorial(lon, lat), GENERATION_ORDER)})


def counts(b: float, cells: int, universe: stars.StarModel, dust: Float32) -> Float:
    """Return the number of stars drawn per deg2 at a latitude, without companions, white dwarfs and brown dwarfs.

    Parameters
    ----------
    b : float
        Galactic latitude, deg.
    cells : int
        Number of cells to draw there.
    universe : StarModel
        Model of the stars.
    dust : float32 array, shape (pixels,)
        Map of A(V), mag.

    Returns
    -------
    float array, shape (limits,)
        Stars per deg2 brighter than each of LIMITS.
    """
    drawn, total = cells_at_latitude(b, cells), np.zeros(len(LIMITS))
    for cell in drawn:
        rows = stars.draw(cell, SEED, universe, dust)
        stage = rows["stage"].fill_null(0).to_numpy()
        selected = rows["companion_of"].is_null().to_numpy() & ~np.isin(stage, (WHITE_DWARF, BROWN_DWARF))
        h = rows["mag_h"].to_numpy()[selected]
        total += [np.sum(h < limit) for limit in LIMITS]
    return np.asarray(total / (len(drawn) * AREA))


def absolute_v(universe: stars.StarModel) -> Float:
    """Return M_V of each piece of an isochrone or white-dwarf track from which stars are drawn, at its middle."""
    galaxy, pieces = universe.galaxy, universe.galaxy.pieces
    metals = np.where(pieces.track < 0, 0.0, galaxy.tracks.metallicity[pieces.track])
    teff, log_g = 10.0 ** pieces.log_teff.mean(0), pieces.log_g.mean(0)
    mixture = model_stars.mixture(universe.types, universe.models, teff, log_g, metals)
    star_columns = {
        f"{name}_{k + 1}": values[k]
        for name, values in (("sed", mixture.sed), ("frac", mixture.frac))
        for k in range(4)
    }
    return stars.mag_v(
        universe, star_columns | {"sed": mixture.sed[0], "mag_h": pieces.m_h.mean(0), "a_v": np.zeros(teff.size)}
    )


def count_brighter(
    universe: stars.StarModel, place: tuple[float, float], limits: Sequence[float], a_v: Float | None = None
) -> Float:
    """Return the expected number per deg2 of single stars and primaries brighter than V (Vega).

    Parameters
    ----------
    universe : StarModel
        Model of the stars.
    place : tuple of float
        Galactic l and b, deg.
    limits : sequence of float
        V magnitudes.
    a_v : float array, shape (s,), optional
        Dust A(V) in front of each shell of distance, mag; None if there is no dust.

    Returns
    -------
    float array, shape (limits,)
        Stars per deg2.
    """
    galaxy = universe.galaxy
    m_v, owner = (
        absolute_v(universe),
        np.searchsorted(galaxy.first[:, 0], np.arange(galaxy.pieces.number.size), "right") - 1,
    )
    r, z, azimuth = milky_way.cylindrical(galaxy, *place, milky_way.shell_distances(galaxy))
    volume, total = milky_way.shell_volumes(galaxy, 1.0), np.zeros(len(limits))
    distance_modulus = 5.0 * np.log10(galaxy.distance) - 5.0 + (0.0 if a_v is None else np.append(a_v, a_v[-1]))
    for k, component in enumerate(galaxy.components):
        inside = np.append(0.0, np.cumsum(density(component.law, galaxy.sun, r, z, azimuth) * volume))
        in_component = owner == k
        for i, limit in enumerate(limits):
            total[i] += (
                galaxy.pieces.number[in_component] * np.interp(limit - m_v[in_component], distance_modulus, inside)
            ).sum()
    return total


def count_whole_sky(universe: stars.StarModel, limit: float, dust: Float32, step: int) -> float:
    """Return the expected number of single stars and primaries brighter than V on the whole sky, behind dust.

    Parameters
    ----------
    universe : StarModel
        Model of the stars.
    limit : float
        V magnitude (Vega).
    dust : float32 array, shape (pixels,)
        Map of A(V), mag.
    step : int
        Step in the numbers of order-4 cells that sample the sky.

    Returns
    -------
    float
        Number of stars.
    """
    cells, total = np.arange(step // 2, 12 << 2 * _SKY_ORDER, step), 0.0
    distance = milky_way.shell_distances(universe.galaxy)
    for ra, dec in zip(*sky.cell_centres(_SKY_ORDER, cells), strict=True):
        lon, lat = sky.galactic([ra], [dec])
        total_a_v = dust_map.a_v(dust, np.array([ra]), np.array([dec]))
        a_v = dust_map.a_v_at(total_a_v, distance, lat, universe.layer, universe.sin_b_min)
        total += float(count_brighter(universe, (float(lon[0]), float(lat[0])), [limit], a_v)[0])
    return total * sky.cell_area(_SKY_ORDER) * (12 << 2 * _SKY_ORDER) / cells.size


def dwarf_counts(b: float, area: float) -> Float:
    """Return L and T dwarfs per deg2 at a latitude, as in DWARFS, from one draw over `area` deg2 without dust."""
    galaxy, dwarfs, types = milky_way.milky_way(), brown_dwarfs.brown_dwarfs(1.0), spectra_of_dwarfs.templates()
    drawn = brown_dwarfs.draw(dwarfs, galaxy, 90.0, b, area, 28.0, stream(SEED, "benchmark", int(b)))
    j = types.abs_mag_j[drawn.template] + 5.0 * np.log10(drawn.distance) - 5.0
    is_t = types.subtype[drawn.template] >= 10
    total = [np.sum(~is_t & (j < m)) for m in (22, 24, 26)] + [np.sum(is_t & (j < m)) for m in (22, 24, 26)]
    return np.array(total) / area
