"""Measure the quantities of the Milky Way model that observed_stars.csv lists with observed values.

Rows of this file with the confidence M are quoted from memory and do not count as failures.
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

# File with the observed values.
LIST = Path(__file__).with_name("observed_stars.csv")
# Galactic longitude and latitude (deg) of the lines of sight along which the mass of the bulge is measured.
_BULGE = ((1, -4), (10, -10))
# Mean mass of a white dwarf, Msun.
_WHITE_DWARF_MASS = 0.6
# Absolute bolometric magnitude of the Sun.
_SUN_M_BOL = 4.74
# Distance (pc) of the stars from whose mean motions Oort's constants are computed.
_OORT_DISTANCE = 50.0


def figures(universe: stars.StarModel, dust: Float32, step: int = 61) -> dict[str, float]:
    """Measure all quantities of observed_stars.csv in a model of the Milky Way (takes 2 s).

    Parameters
    ----------
    universe : StarModel
        Model of the stars.
    dust : float32 array, shape (pixels,)
        HEALPix map of the extinction A(V), mag.
    step : int
        For counts on the whole sky, every `step`-th HEALPix cell of order 4 is used.

    Returns
    -------
    dict of str to float
        Measured values by name.
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
    """Compare measured values (by name) with observed_stars.csv, and return the checks by the group in this file."""
    groups: dict[str, list[Check]] = {}
    for check in read(LIST, values):
        groups.setdefault(check.group, []).append(check)
    return groups


def local_densities(universe: stars.StarModel) -> dict[str, float]:
    """Return number densities of stars at the Sun (pc^-3), companions per star, and M_H (mag) of the red clump.

    The densities are of systems with a primary below 1 Msun, giants, giants with M_V < 1, and white dwarfs.
    """
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
    """Return the M_H (mag), between -3 and 0, at which giants of the thin disc are most frequent: the red clump.

    If the model divides the thin disc by age (Besancon), only its youngest part is used.
    """
    pieces, thin = galaxy.pieces, np.arange(galaxy.pieces.number.size) < galaxy.first[1, 0]
    edges = np.arange(-3.0, 0.01, 0.1)
    number, _ = np.histogram(pieces.m_h.mean(0), edges, weights=pieces.number * thin * (pieces.stage == GIANT))
    smooth = number + np.append(0.0, number[:-1]) + np.append(number[1:], 0.0)
    return float(edges[smooth.argmax()] + 0.05)


def isochrone_points() -> dict[str, float]:
    """Return properties of isochrones: turn-off temperatures (K) of halo and thick disc, and turn-off mass (Msun).

    The result also has M_bol of the tip of the red giant branch, and M_H of the Sun.
    """
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
    """Measure g - r (SDSS) of simulated stars with 18 < r < 19.5 in `area` deg2 at Galactic latitude 60, without dust.

    The statistics are the fraction bluer than 0.5, the most frequent colour of halo stars, and the colour of the blue
    edge (5th percentile) of halo dwarfs.
    """
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
    """Return Oort's constants A and B (km/s/kpc) of the youngest stars, and the kinematics of the halo.

    These are the lag of halo stars behind the local standard of rest, and the dispersion of their line-of-sight
    velocities towards the Galactic centre (km/s).
    """
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
    """Return the proper motion along Galactic longitude (mas/yr) of thin disc stars in the Galactic plane.

    `lon` are their longitudes in deg, `distance_pc` their distance in pc, and `age` their ages in Gyr. `deviates`,
    shape (3, n), are standard normal random numbers for their velocities; 0 gives the mean motion. The direction of
    longitude on the sky is found from a small step in longitude.
    """
    ra, dec = sky.equatorial(lon, np.zeros(lon.size))
    distance, thin = np.full(lon.size, distance_pc), np.zeros(lon.size, np.int64)
    east, north, _ = kinematics.velocities(ra, dec, distance, thin, age, deviates)
    stepped = sky.equatorial(lon + 1e-3, np.zeros(lon.size))
    step = np.stack([((stepped[0] - ra + 180.0) % 360.0 - 180.0) * np.cos(np.radians(dec)), stepped[1] - dec])
    step /= np.hypot(*step)
    return np.asarray(east * step[0] + north * step[1])


def bulge(galaxy: milky_way.MilkyWay) -> dict[str, float]:
    """Return the stellar mass of the bulge per deg^2 (Msun) along several lines of sight, by name."""
    pieces, inside = galaxy.pieces, np.arange(galaxy.pieces.number.size) >= galaxy.first[-1, 0]
    each = np.where(pieces.stage == WHITE_DWARF, _WHITE_DWARF_MASS, 10.0 ** pieces.log_mass.mean(0))
    mass = float((each * pieces.number * inside).sum() / galaxy.local[-1].sum())
    masses = {}
    for lon, lat in _BULGE:
        number = milky_way.expected_per_bin(galaxy, float(lon), float(lat), 1.0, 60.0)[-1].sum()
        masses[f"bulge_mass_{lon}_{lat}"] = mass * float(number)
    return masses
