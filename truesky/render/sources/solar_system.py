"""Solar System objects: an embedded population of small bodies, each a straight trail during an exposure.

The density is highest near the ecliptic. Most bodies move along it at the pace of the main belt; a few are fast and
move in any direction. They have the colour of the Sun. The population is drawn by day and order-5 cell, so that all
exposures of a day contain the same bodies. At midnight UTC another population begins.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from lake_schema import sky, units
from lake_schema.arrays import Bool, Float, Int
from lake_schema.ids import FILE_ORDER, GENERATION_ORDER, source_id
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.sky.ecliptic import ecliptic, equatorial
from truesky.fluxes import passbands
from truesky.fluxes.passbands import Passband
from truesky.randomness import rng
from truesky.render.camera import astrometry, pointing
from truesky.render.channels.aim import Aim
from truesky.render.sky.diffuse_light import solar_irradiance
from truesky.render.sources import colours
from truesky.render.sources.galaxy_shapes import Shapes
from truesky.render.sources.source_list import Sources

# Kind in an identifier; the member in it is the day.
KIND = 6
_DAY_S, _HOUR_S = 86400.0, 3600.0
_KEY = "env.solar_system"
# Band of the magnitudes.
_BAND = "euclid_vis"
# Smallest cosine of the latitude for motion along a circle of latitude.
_LEAST_COSINE = 1e-3


@dataclass(frozen=True, slots=True)
class Population:
    """n bodies on one day.

    Attributes
    ----------
    ids : int array, shape (n,)
        Identifiers.
    lon, lat : float array, shape (n,)
        Ecliptic positions, deg.
    east, north : float array, shape (n,)
        Motion in these directions, arcsec / h.
    mag : float array, shape (n,)
        I_E, AB.
    hour : float or float array, shape (n,)
        Time of the positions, hours after noon UTC.
    """

    ids: Int
    lon: Float
    lat: Float
    east: Float
    north: Float
    mag: Float
    hour: float | Float = 0.0

    def positions_after(self, hours: float | Float) -> tuple[Float, Float]:
        """Right ascensions and declinations [n], deg, at a number of hours after noon."""
        across = np.maximum(np.cos(np.radians(self.lat)), _LEAST_COSINE)
        elapsed = (hours - self.hour) / 3600.0
        return equatorial(
            self.lon + self.east * elapsed / across, np.clip(self.lat + self.north * elapsed, -90.0, 90.0)
        )

    def take(self, selected: Bool | Int) -> Population:
        """Return the selected bodies."""
        return Population(
            *(np.broadcast_to(getattr(self, field.name), self.ids.shape)[selected] for field in fields(Population))
        )


def empty_population(day: int) -> Population:
    """Population without bodies."""
    empty = np.zeros(0)
    return Population(np.zeros(0, np.int64), empty, empty, empty, empty, empty)


def population(
    ra: float, dec: float, radius: float, day: int, mission: MissionConfiguration, seed: int, hours: float = 12.0
) -> Population:
    """Bodies that are within a radius of a position at some time of a day.

    Parameters
    ----------
    ra, dec : float
        Position, deg.
    radius : float
        Radius, deg.
    day : int
        MJD.
    mission : MissionConfiguration
        Mission database.
    seed : int
        Seed of the request.
    hours : float
        Largest time before or after noon, h.

    Returns
    -------
    Population
        The bodies.
    """
    fastest = max(mission.value(f"{_KEY}.{key}", "arcsec / h") for key in ("rate_max", "fast_rate_max"))
    # Bodies may have moved by this distance from their positions at noon.
    reach = min(radius + hours * fastest / 3600.0, 180.0)
    # A mission database without a faintest magnitude has no Solar System objects.
    has_bodies = f"{_KEY}.faintest" in mission and mission.value(f"{_KEY}.density") > 0.0
    cells = sky.cells_in_cone(ra, dec, reach, FILE_ORDER).tolist() if has_bodies else []
    parts = [_draw_cell(cell, day, mission, seed) for cell in cells]
    if not parts:
        empty = np.zeros(0)
        return Population(np.zeros(0, np.int64), empty, empty, empty, empty, empty)
    return Population(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def density(latitude: npt.ArrayLike, mission: MissionConfiguration) -> Float:
    """Density of bodies down to the faintest magnitude at an ecliptic latitude in deg, deg-2."""
    value = {name: mission.value(f"{_KEY}.latitude_{name}", "deg") for name in ("zero", "scale", "cap")}
    fainter = mission.value(f"{_KEY}.faintest", "mag") - mission.value(f"{_KEY}.reference_magnitude", "mag")
    total = mission.value(f"{_KEY}.density", "deg-2") * 10.0 ** (_slope(mission) * fainter)
    height = np.minimum(np.abs(np.asarray(latitude, float)), value["cap"])
    return np.asarray(total * np.exp(-(height - value["zero"]) / value["scale"]))


def _slope(mission: MissionConfiguration) -> float:
    return mission.value(f"{_KEY}.counts_slope", "dex / mag")


def _draw_cell(cell: int, day: int, mission: MissionConfiguration, seed: int) -> tuple[Any, ...]:
    """Draw the columns of `Population`, without hours, for an order-5 cell."""
    generator = rng.stream(seed, "solar_system", day, cell)
    centre = ecliptic(*sky.cell_centre(FILE_ORDER, cell))[1]
    max_density = float(density(max(abs(float(centre)) - sky.cell_radius(FILE_ORDER), 0.0), mission))
    count = int(generator.poisson(max_density * sky.cell_area(FILE_ORDER)))
    _, ra, dec = sky.random_in_cell(FILE_ORDER, cell, count, generator)
    lon, lat = ecliptic(ra, dec)
    chosen, brightness, fast, pace, angle = generator.random((5, count))
    accepted = np.flatnonzero(chosen * max_density < density(lat, mission))
    lon, lat, brightness, fast, pace, angle = (x[accepted] for x in (lon, lat, brightness, fast, pace, angle))
    slow, usual, fastest = (
        mission.value(f"{_KEY}.{key}", "arcsec / h") for key in ("rate_min", "rate_max", "fast_rate_max")
    )
    is_fast = fast < mission.value(f"{_KEY}.fast_fraction", "")
    # The rates of fast bodies are uniform in the logarithm.
    rate = np.where(is_fast, usual * (fastest / usual) ** pace, slow + (usual - slow) * pace)
    turn = np.where(is_fast, 2.0 * np.pi * angle, 0.0)
    # 1 - u lies in (0, 1].
    mag = mission.value(f"{_KEY}.faintest", "mag") + np.log10(1.0 - brightness) / _slope(mission)
    sub_cells = 4 ** (GENERATION_ORDER - FILE_ORDER)
    ids = source_id(KIND, cell * sub_cells, np.arange(len(accepted)), day)
    return ids, lon, lat, rate * np.cos(turn), rate * np.sin(turn), mag


def trailed_sources(
    aim: Aim,
    mission: MissionConfiguration,
    seed: int,
    reach: float,
    shapes: Shapes,
    day_population: Callable[[int], Population] | None = None,
) -> Sources:
    """Bodies whose trails come close to a detector during an exposure, as sources in ascending order of identifiers.

    Parameters
    ----------
    aim : Aim
        Exposure and detector.
    mission : MissionConfiguration
        Mission database.
    seed : int
        Seed of the request.
    reach : float
        Largest distance from the detector's centre, deg.
    shapes : Shapes
        Shapes of the other sources in the same list.
    day_population : callable, optional
        (MJD) -> bodies of a day, to replace the embedded population.

    Returns
    -------
    Sources
        The bodies.

    Notes
    -----
    A trail longer than twice `reach` is cut to this length about its closest point, with the corresponding part of the
    light.
    """
    exposure, system, band = aim.exposure, aim.wcs, aim.band
    start, seconds = exposure.mjd, exposure.exposure_time_s
    centre = astrometry.centre(aim.detector, system)
    # An exposure belongs to the day on which it begins.
    day = int(np.floor(start))
    start_hours = 24.0 * (start - day - 0.5)
    end_hours = max(12.0, start_hours + seconds / _HOUR_S)
    candidates = day_population(day) if day_population else population(*centre, reach, day, mission, seed, end_hours)
    indices, first, last = _bodies_in_reach(
        candidates.positions_after(start_hours),
        candidates.positions_after(start_hours + seconds / _HOUR_S),
        centre,
        reach,
    )
    order = np.argsort(candidates.ids[indices])
    indices, first, last = indices[order], first[order], last[order]
    bodies = candidates.take(indices)
    begin, middle, end = (
        astrometry.pixel_of_sky(system, *bodies.positions_after(start_hours + part * seconds / _HOUR_S))
        for part in (first, 0.5 * (first + last), last)
    )
    photons = colours.spectrum_fractions(band, solar_irradiance(band.wavelength / 10.0, mission))
    return Sources(
        bodies.ids,
        *middle,
        astrometry.jacobian(system, *middle),
        aim.electrons_per_microjansky * flux(bodies.mag, band, mission) * (last - first),
        np.full(len(indices), -1),
        shapes,
        np.tile(photons, (len(indices), 1)),
        trail=np.stack(end, axis=1) - np.stack(begin, axis=1),
    )


def _bodies_in_reach(
    begin: tuple[Float, Float], end: tuple[Float, Float], centre: tuple[float, float], reach: float
) -> tuple[Int, Float, Float]:
    """Indices of bodies that come within `reach` deg of a centre, and the fractions between which trails are kept."""
    there, start, stop = (pointing.basis(*place)[2] for place in (np.reshape(centre, (2, 1)), begin, end))
    way = stop - start
    length = np.sqrt(np.sum(way**2, axis=0))
    nearest = np.sum((there - start) * way, axis=0) / np.maximum(length, 1e-30) ** 2
    place = start + np.clip(nearest, 0.0, 1.0) * way
    distance = np.sqrt(np.sum((place / np.sqrt(np.sum(place**2, axis=0)) - there) ** 2, axis=0))
    radius = 2.0 * np.sin(0.5 * np.radians(min(reach, 180.0)))
    indices = np.flatnonzero(distance <= radius)
    length, nearest, distance = length[indices], nearest[indices], distance[indices]
    half = np.where(length > 2.0 * radius, radius / np.maximum(length, 1e-30), np.inf)
    return indices, np.maximum(nearest - half, 0.0), np.minimum(nearest + half, 1.0)


def flux(mag: Float, band: Passband, mission: MissionConfiguration) -> Float:
    """Flux f_nu of bodies in a band.

    Parameters
    ----------
    mag : float array, shape (n,)
        Magnitudes in I_E, AB.
    band : Passband
        The passband.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    float array, shape (n,)
        Flux, microjansky.
    """
    band_flux, reference_flux = (_sun_flux(b, mission) for b in (band, passbands.load(_BAND)))
    return np.asarray(10.0 ** (0.4 * (units.AB_UJY - mag)) * band_flux / reference_flux)


def _sun_flux(band: Passband, mission: MissionConfiguration) -> float:
    wavelength = band.wavelength / 10.0
    return float(passbands.ab_flux(band, band.wavelength, solar_irradiance(wavelength, mission)))
