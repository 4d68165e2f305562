"""Stars of the Milky Way compared with observations in observed_stars.csv.

Every row of the list is from outside this project. Rows of confidence M are quoted from memory and do not count as
failures.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from lake_schema import sky
from lake_schema.arrays import Float, Float32
from truesky.catalogue.stars import isochrones, kinematics, milky_way, stars
from truesky.catalogue.stars.stellar_populations import DWARF, GIANT, WHITE_DWARF, build_tracks
from truesky.fluxes import passbands
from truesky.fluxes.libraries import model_stars, templates
from truesky.fluxes.libraries.vega import vega_magnitude
from truesky.randomness.rng import stream
from truesky.validation.checks import Check, read
from truesky.validation.model import star_counts

LIST = Path(__file__).with_name("observed_stars.csv")
_BULGE = ((1, -4), (10, -10))
# Mean mass, Msun.
_WHITE_DWARF_MASS = 0.6
_SUN_M_BOL = 4.74
# Distance (pc) at which Oort's constants are evaluated.
_OORT_DISTANCE = 50.0


def figures(universe: stars.StarModel, dust: Float32, step: int = 61) -> dict[str, float]:
    """Measure every figure of the list (takes 2 s).

    Parameters
    ----------
    universe : StarModel
        Model of the stars.
    dust : float32 array, shape (pixels,)
        Map of A(V), mag.
    step : int
        Step in the numbers of order-4 cells that sample the whole sky.

    Returns
    -------
    dict of str to float
        Figures by name.
    """
    limits = (15.0, 18.0, 20.0)
    pole = star_counts.count_brighter(universe, (0.0, 90.0), limits)
    return {
        **{f"pole_v{limit:g}": float(value) for limit, value in zip(limits, pole, strict=True)},
        "sky_v11": star_counts.count_whole_sky(universe, 11.0, dust, step),
        **local_densities(universe),
        **isochrone_points(),
        **colours(universe),
        **motions(),
        **bulge(universe.galaxy),
    }


def checks_by_group(values: Mapping[str, float]) -> dict[str, list[Check]]:
    """Check figures against every row of the list, by group."""
    groups: dict[str, list[Check]] = {}
    for check in read(LIST, values):
        groups.setdefault(check.group, []).append(check)
    return groups


def local_densities(universe: stars.StarModel) -> dict[str, float]:
    """Densities at the Sun in pc^-3, companions per star, and M_H of the red clump."""
    galaxy, pieces = universe.galaxy, universe.galaxy.pieces
    at_sun = np.arange(pieces.number.size) < galaxy.first[-1, 0]
    number, stage = pieces.number * at_sun, pieces.stage
    light = (pieces.log_mass.mean(0) < 0.0) & (stage != WHITE_DWARF)
    giants = stage == GIANT
    return {
        "systems_local": float(number[light].sum()),
        "companions_per_star": float(galaxy.companions[:-1].sum() / number[stage != WHITE_DWARF].sum()),
        "giants_local": float(number[giants].sum()),
        "giants_bright_local": float(number[giants & (star_counts.absolute_v(universe) < 1.0)].sum()),
        "white_dwarfs_local": float(number[stage == WHITE_DWARF].sum()),
        "clump_m_h": _clump_magnitude(galaxy),
    }


def _clump_magnitude(galaxy: milky_way.MilkyWay) -> float:
    """Most frequent M_H, between -3 and 0, of giants of the thin disc."""
    pieces, thin = galaxy.pieces, np.arange(galaxy.pieces.number.size) < galaxy.first[1, 0]
    edges = np.arange(-3.0, 0.01, 0.1)
    number, _ = np.histogram(pieces.m_h.mean(0), edges, weights=pieces.number * thin * (pieces.stage == GIANT))
    smooth = number + np.append(0.0, number[:-1]) + np.append(number[1:], 0.0)
    return float(edges[smooth.argmax()] + 0.05)


def isochrone_points() -> dict[str, float]:
    """Turn-off temperatures (K) and mass (Msun), M_bol of the tip, and M_H of the Sun from isochrones."""
    old = isochrones.isochrones([12.5, 10.0, 4.6], [-1.5, -0.5, 0.0])
    main = old.main_sequence + 4
    hot = old.log_teff[:, :main].argmax(1)
    tip = old.main_sequence - 1 + isochrones.FLASH
    sun = build_tracks(np.array([4.6]), np.zeros(1))
    return {
        "halo_turn_off_teff": float(10.0 ** old.log_teff[0, hot[0]]),
        "halo_turn_off_mass": float(old.mass[0, hot[0]]),
        "thick_turn_off_teff": float(10.0 ** old.log_teff[1, hot[1]]),
        "tip_m_bol": float(_SUN_M_BOL - 2.5 * old.log_l[0, tip]),
        "sun_m_h": float(np.interp(0.0, sun.log_mass[0, : sun.evolved], sun.m_h[0, : sun.evolved])),
    }


def colours(universe: stars.StarModel, area: float = 40.0) -> dict[str, float]:
    """Return statistics of g - r (SDSS) of stars with 18 < r < 19.5 in `area` deg2 at b = 60, without dust."""
    galaxy = universe.galaxy
    rngs = (stream(star_counts.SEED, "colours", name) for name in ("number", "labels"))
    drawn = milky_way.draw(galaxy, milky_way.expected_per_bin(galaxy, 90.0, 60.0, area, 21.0), *rngs)
    mixture = model_stars.mixture(universe.types, universe.models, drawn.teff, drawn.log_g, drawn.metallicity)
    library = templates.stellar_library()
    light = {}
    for name in ("sdss_g", "sdss_r", "twomass_h"):
        band = passbands.load(name)
        band_flux = library.flux[:, band.first : band.first + len(band.wavelength)].astype(float)
        each = band_flux @ passbands.weights(band)
        light[name] = (mixture.frac * each[mixture.sed]).sum(0)
    mag_h = drawn.m_h + 5.0 * np.log10(drawn.distance) - 5.0 + vega_magnitude(passbands.load("twomass_h"))
    mag_r = mag_h - 2.5 * np.log10(light["sdss_r"] / light["twomass_h"])
    color = -2.5 * np.log10(light["sdss_g"] / light["sdss_r"])
    selected = (mag_r > 18.0) & (mag_r < 19.5)
    halo = selected & (drawn.component == milky_way.HALO) & (color < 0.6)
    number, edges = np.histogram(color[halo], np.arange(0.0, 0.61, 0.04))
    dwarfs = selected & (drawn.component == milky_way.HALO) & (drawn.stage == DWARF)
    return {
        "gr_b60_below_0.5": float(np.mean(color[selected] < 0.5)),
        "gr_b60_mode": float(edges[number.argmax()] + 0.02),
        "gr_b60_edge": float(np.quantile(color[dwarfs], 0.05)),
    }


def motions() -> dict[str, float]:
    """Oort's constants (km/s/kpc) of the mean of the youngest stars, and lag and dispersion (km/s) of the halo."""
    lon = np.arange(0.0, 360.0, 5.0)
    zeros, young = np.zeros((3, lon.size)), np.full(lon.size, 0.1)
    mean = [_longitude_motion(lon, distance_pc, zeros, young) for distance_pc in (_OORT_DISTANCE, 0.5 * _OORT_DISTANCE)]
    rotation = 4.74047 * (2.0 * mean[0] - mean[1])
    rng, n = stream(star_counts.SEED, "motions"), 20_000
    ra, dec = sky.equatorial(np.array([0.0, 90.0]), np.array([0.0, 0.0]))
    halo = np.full(n, milky_way.HALO)
    speeds = [
        kinematics.velocities(
            np.full(n, ra[k]),
            np.full(n, dec[k]),
            np.full(n, 10.0),
            halo,
            np.full(n, np.nan),
            rng.standard_normal((3, n)),
        )[2]
        for k in range(2)
    ]
    return {
        "oort_a": float(2.0 * (rotation * np.cos(2.0 * np.radians(lon))).mean()),
        "oort_b": float(rotation.mean()),
        "sun_v_lag": float(-speeds[1].mean() - kinematics.sun_motion()[1]),
        "halo_dispersion": float(speeds[0].std()),
    }


def _longitude_motion(lon: Float, distance_pc: float, deviates: Float, age: Float) -> Float:
    """Proper motion along Galactic longitude in the plane, mas/yr, from a small step in longitude."""
    ra, dec = sky.equatorial(lon, np.zeros(lon.size))
    distance, thin = np.full(lon.size, distance_pc), np.zeros(lon.size, np.int64)
    east, north, _ = kinematics.velocities(ra, dec, distance, thin, age, deviates)
    stepped = sky.equatorial(lon + 1e-3, np.zeros(lon.size))
    step = np.stack([((stepped[0] - ra + 180.0) % 360.0 - 180.0) * np.cos(np.radians(dec)), stepped[1] - dec])
    step /= np.hypot(*step)
    return np.asarray(east * step[0] + north * step[1])


def bulge(galaxy: milky_way.MilkyWay) -> dict[str, float]:
    """Mass of the bulge along lines of sight, Msun deg^-2."""
    pieces, inside = galaxy.pieces, np.arange(galaxy.pieces.number.size) >= galaxy.first[-1, 0]
    each = np.where(pieces.stage == WHITE_DWARF, _WHITE_DWARF_MASS, 10.0 ** pieces.log_mass.mean(0))
    mass = float((each * pieces.number * inside).sum() / galaxy.local[-1].sum())
    masses = {}
    for lon, lat in _BULGE:
        number = milky_way.expected_per_bin(galaxy, float(lon), float(lat), 1.0, 60.0)[-1].sum()
        masses[f"bulge_mass_{lon}_{lat}"] = mass * float(number)
    return masses
