"""Draw a random population of small Solar System bodies, each of which leaves a straight trail in an exposure.

The density is highest near the ecliptic. Most bodies move along it at the pace of the main asteroid belt; a few are
fast and move in any direction. They have the colour of the Sun. The population is drawn separately for each day and
each order-5 HEALPix cell, so that all exposures of a day contain the same bodies. At midnight UTC it is replaced.
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

# Code of Solar System bodies in source identifiers (`lake_schema.ids.source_id`, argument `kind`).
KIND = 6
_DAY_S, _HOUR_S = 86400.0, 3600.0
# First part of the names of the parameters in the mission database that describe Solar System bodies.
_KEY = "env.solar_system"
# Band in which Solar System bodies have their magnitudes (I_E).
_BAND = "euclid_vis"
# Smallest cosine of the ecliptic latitude with which motion is converted to a change of longitude; it avoids a division
# by 0 at the poles.
_LEAST_COSINE = 1e-3


@dataclass(frozen=True, slots=True)
class Population:
    """n Solar System bodies on one day.

    Attributes
    ----------
    ids : int array, shape (n,)
        Source identifiers.
    lon, lat : float array, shape (n,)
        Ecliptic longitude and latitude at the time `hour`, deg.
    east, north : float array, shape (n,)
        Motion along ecliptic longitude (times the cosine of the latitude) and latitude, arcsec / h.
    mag : float array, shape (n,)
        AB magnitude in the Euclid band I_E.
    hour : float or float array, shape (n,)
        Time of the positions in hours after noon UTC of the day, for all or for each body.
    """

    ids: Int
    lon: Float
    lat: Float
    east: Float
    north: Float
    mag: Float
    hour: float | Float = 0.0

    def positions_after(self, hours: float | Float) -> tuple[Float, Float]:
        """Return the right ascensions and declinations of the bodies in degrees, `hours` hours after noon UTC."""
        across = np.maximum(np.cos(np.radians(self.lat)), _LEAST_COSINE)
        elapsed = (hours - self.hour) / 3600.0
        return equatorial(
            self.lon + self.east * elapsed / across, np.clip(self.lat + self.north * elapsed, -90.0, 90.0)
        )

    def take(self, selected: Bool | Int) -> Population:
        """Return the bodies that a mask selects, or the bodies with given indices in the order of the indices."""
        return Population(
            *(np.broadcast_to(getattr(self, field.name), self.ids.shape)[selected] for field in fields(Population))
        )


def empty_population(day: int) -> Population:
    """Return a population without bodies, so that none are drawn on any day; `day` (MJD) is not used."""
    empty = np.zeros(0)
    return Population(np.zeros(0, np.int64), empty, empty, empty, empty, empty)


def population(
    ra: float, dec: float, radius: float, day: int, mission: MissionConfiguration, seed: int, hours: float = 12.0
) -> Population:
    """Draw all bodies that may come within a radius of a position on a day.

    Parameters
    ----------
    ra, dec : float
        ICRS position in degrees.
    radius : float
        Radius in degrees.
    day : int
        MJD of the day.
    mission : MissionConfiguration
        Mission database, with density, magnitudes and motions of the bodies.
    seed : int
        Seed of the request. The same seed, day and position on the sky always give the same bodies.
    hours : float
        Largest time before or after noon UTC for which bodies are needed, h.

    Returns
    -------
    Population
        All these bodies, and others that stay farther away, with positions at noon UTC. Empty if the mission database
        has no faintest magnitude of bodies, or if its density of bodies is 0.
    """
    fastest = max(mission.value(f"{_KEY}.{key}", "arcsec / h") for key in ("rate_max", "fast_rate_max"))
    # Enlarge the radius by the largest distance that bodies move within `hours` of their positions at noon.
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
    """Return the number of bodies per square degree, down to the faintest magnitude, at ecliptic latitudes in deg."""
    value = {name: mission.value(f"{_KEY}.latitude_{name}", "deg") for name in ("zero", "scale", "cap")}
    fainter = mission.value(f"{_KEY}.faintest", "mag") - mission.value(f"{_KEY}.reference_magnitude", "mag")
    total = mission.value(f"{_KEY}.density", "deg-2") * 10.0 ** (_slope(mission) * fainter)
    height = np.minimum(np.abs(np.asarray(latitude, float)), value["cap"])
    return np.asarray(total * np.exp(-(height - value["zero"]) / value["scale"]))


def _slope(mission: MissionConfiguration) -> float:
    return mission.value(f"{_KEY}.counts_slope", "dex / mag")


def _draw_cell(cell: int, day: int, mission: MissionConfiguration, seed: int) -> tuple[Any, ...]:
    """Draw the Solar System bodies of a day (MJD) in an order-5 HEALPix cell.

    The result has one array per attribute of `Population`, in the same order and without `hour`. Positions are those at
    noon UTC.
    """
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
    # Speed of each body in arcsec / h from a random number `pace`: uniformly distributed in the logarithm for fast
    # bodies, uniformly in the speed for the others.
    rate = np.where(is_fast, usual * (fastest / usual) ** pace, slow + (usual - slow) * pace)
    turn = np.where(is_fast, 2.0 * np.pi * angle, 0.0)
    # `brightness` is a random number in [0, 1), so that the logarithm of 1 - `brightness` is finite.
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
    """Return the Solar System bodies whose trails come close to a detector during an exposure.

    Parameters
    ----------
    aim : Aim
        Exposure and detector.
    mission : MissionConfiguration
        Mission database, with the parameters of the random population and the spectrum of the Sun.
    seed : int
        Seed of the request, used to draw the random population.
    reach : float
        Largest distance of a trail from the centre of the detector, deg.
    shapes : Shapes
        Shapes of the galaxies to which the bodies will be appended; the bodies themselves are point sources.
    day_population : callable, optional
        Function (MJD of a day) -> bodies of this day, which replace the random population.

    Returns
    -------
    Sources
        The bodies in ascending order of identifiers, each with its trail in pixels.

    Notes
    -----
    A trail longer than twice `reach` is cut to this length about its closest point, with the corresponding part of the
    light.
    """
    exposure, system, band = aim.exposure, aim.wcs, aim.band
    start, seconds = exposure.mjd, exposure.exposure_time_s
    centre = aim.centre
    # Use the bodies of the UTC day on which the exposure begins, even if it ends after midnight.
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
    (photons,) = colours.spectrum_fractions(band, solar_irradiance(band.wavelength / 10.0, mission)[None])
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
    """Find bodies that come within `reach` deg of `centre` between their positions `begin` and `end` (ra, dec in deg).

    Return their indices, and two fractions of the exposure between which each trail is kept: 0 and 1, or a part of
    length 2 `reach` about the point closest to the centre.
    """
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
    """Return the flux f_nu of Solar System bodies in a band, for the colour of the Sun.

    Parameters
    ----------
    mag : float array, shape (n,)
        AB magnitudes in the Euclid band I_E.
    band : Passband
        Response of the band as a function of wavelength.
    mission : MissionConfiguration
        Mission database, with the spectrum of the Sun.

    Returns
    -------
    float array, shape (n,)
        Flux in microjansky.
    """
    band_flux, reference_flux = (_sun_flux(b, mission) for b in (band, passbands.load(_BAND)))
    return np.asarray(10.0 ** (0.4 * (units.AB_UJY - mag)) * band_flux / reference_flux)


def _sun_flux(band: Passband, mission: MissionConfiguration) -> float:
    wavelength = band.wavelength / 10.0
    return float(passbands.ab_flux(band, band.wavelength, solar_irradiance(wavelength, mission)))
