"""Count simulated stars and brown dwarfs per deg2, for a comparison with counts of other codes."""

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

# Seed of the random numbers with which stars are drawn.
SEED = 7
# Area of a generation cell (HEALPix cell in which stars are simulated as a whole), deg^2.
AREA = sky.cell_area(GENERATION_ORDER)
# HEALPix order of the cells at whose centres the stars of the whole sky are counted.
_SKY_ORDER = 4
# Reference counts by northern Galactic latitude (deg): stars per deg^2 brighter than each of LIMITS, as means over
# longitude without dust, companions and white dwarfs. They were computed with the density laws and the mass function of
# this simulator, but above 0.55 Msun with the isochrones of BaSTI (Pietrinferni et al. 2004).
COUNTS = {
    90: (1997, 10951, 36048),
    60: (2650, 14683, 46733),
    45: (3938, 22341, 66843),
    30: (7664, 46523, 123315),
    20: (15541, 104005, 247463),
}
# Magnitude limits in H (Vega) of the reference counts of stars.
LIMITS = (18.0, 22.0, 26.0)
# Reference counts of brown dwarfs by Galactic latitude (deg): L dwarfs per deg^2 brighter than J = 22, 24 and 26
# (Vega), then T dwarfs brighter than the same limits.
DWARFS = {30: (62, 267, 458, 6, 60, 330), 60: (32, 81, 105, 5, 35, 116), 90: (25, 57, 69, 5, 29, 83)}
# Expected parallax errors (mas) by G magnitude: the law of PyGaia scaled to Gaia DR2, which publishes 0.04, 0.1, 0.7.
PARALLAX = {15.0: 0.037, 17.0: 0.098, 20.0: 0.765}


def cells_at_latitude(b: float, cells: int, south: bool = False) -> list[int]:
    """Return generation cells (nested HEALPix cells of order 8) at Galactic latitude `b`, evenly spaced in longitude.

    Parameters
    ----------
    b : float
        Galactic latitude, deg.
    cells : int
        Number of positions. A cell that contains several positions is returned once.
    south : bool
        If True, every other position is at -b. The Sun is north of the Galactic plane, so there are more stars in the
        south.

    Returns
    -------
    list of int
        Numbers of the cells, ascending.
    """
    lon = np.arange(cells) * 360.0 / cells
    # Near a pole, use different latitudes: all longitudes would be in the same few cells.
    lat = np.minimum(b, 89.9 - 0.1 * np.arange(cells)) * np.where(south & (np.arange(cells) % 2 == 1), -1.0, 1.0)
    return sorted({int(cell) for cell in sky.cell_at(*sky.equatorial(lon, lat), GENERATION_ORDER)})


def counts(b: float, cells: int, universe: stars.StarModel, dust: Float32) -> Float:
    """Count simulated stars per deg2 at a Galactic latitude, without companions, white dwarfs and brown dwarfs.

    Parameters
    ----------
    b : float
        Galactic latitude, deg.
    cells : int
        Number of generation cells (nested HEALPix cells of order 8) in which stars are simulated.
    universe : StarModel
        Model of the stars.
    dust : float32 array, shape (pixels,)
        HEALPix map of the extinction A(V), mag.

    Returns
    -------
    float array, shape (3,)
        Stars per deg2 brighter than H = 18, 22 and 26 (Vega).
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
    """Return M_V (Vega) at the middle of each stretch of an isochrone or white dwarf sequence, shape (n,).

    Stars are drawn from these stretches, which are the `pieces` of the model.
    """
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
    """Return the expected number per deg2 of single stars and primaries of binaries brighter than limits in V.

    Parameters
    ----------
    universe : StarModel
        Model of the stars.
    place : tuple of float
        Galactic longitude and latitude of the line of sight, deg.
    limits : sequence of float
        Limits in V, Vega mag.
    a_v : float array, shape (s,), optional
        Extinction A(V) in front of each of the model's s shells of distance, mag; None for no dust.

    Returns
    -------
    float array, shape (limits,)
        Stars per deg2 brighter than each limit.
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
    """Return the expected number of stars on the whole sky brighter than a limit in V, with extinction by dust.

    Single stars and primaries of binaries are counted.

    Parameters
    ----------
    universe : StarModel
        Model of the stars.
    limit : float
        Limit in V, Vega mag.
    dust : float32 array, shape (pixels,)
        HEALPix map of the extinction A(V), mag.
    step : int
        Stars are counted at the centre of every `step`-th HEALPix cell of order 4.

    Returns
    -------
    float
        Number of stars on the whole sky.
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
    """Count simulated brown dwarfs per deg2 at Galactic latitude `b` (deg), without dust.

    The result has L dwarfs brighter than J = 22, 24 and 26 (Vega), then T dwarfs. They are simulated once, in an area
    of `area` deg2.
    """
    galaxy, dwarfs, types = milky_way.milky_way(), brown_dwarfs.brown_dwarfs(1.0), spectra_of_dwarfs.templates()
    drawn = brown_dwarfs.draw(dwarfs, galaxy, 90.0, b, area, 28.0, stream(SEED, "benchmark", int(b)))
    j = types.abs_mag_j[drawn.template] + 5.0 * np.log10(drawn.distance) - 5.0
    is_t = types.subtype[drawn.template] >= 10
    total = [np.sum(~is_t & (j < m)) for m in (22, 24, 26)] + [np.sum(is_t & (j < m)) for m in (22, 24, 26)]
    return np.array(total) / area
