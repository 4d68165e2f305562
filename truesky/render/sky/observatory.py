"""Airmass and zenith of fields, positions of the Sun and the Moon, and dark time at an observatory."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Bool, Float
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.sky import separation
from lake_schema.sky.ecliptic import equatorial
from truesky.render.sky.diffuse_light import sun_longitude

_MJD_J2000 = 51544.5
# Earth rotation angle, turns (IAU 2000). Its origin moves with the equinox, unlike right ascensions in ICRS.
_TURN, _TURNS_A_DAY = 0.7790572732640, 1.00273781191135448
# Terms of the Moon's longitude and latitude, deg: amplitude, phase, rate per century (The Astronomical Almanac, low
# precision); its mean longitude and rate; general precession per century.
_MOON_LONGITUDE = (
    (6.29, 135.0, 477198.87), (-1.27, 259.3, -413335.36), (0.66, 235.7, 890534.22), (0.21, 269.9, 954397.74),
    (-0.19, 357.5, 35999.05), (-0.11, 186.5, 966404.03),
)  # fmt: skip
_MOON_LATITUDE = (
    (5.13, 93.3, 483202.02), (0.28, 228.2, 960400.89), (-0.28, 318.3, 6003.15), (-0.17, 217.6, -407332.21),
)  # fmt: skip
_MOON_MEAN, _PRECESSION = (218.32, 481267.881), 1.39697
# Parallax of the Moon, deg.
_PARALLAX = 0.95
# Limits of observations: largest altitude of the Sun and smallest distance from the Moon, deg; largest airmass.
_TWILIGHT, _FROM_MOON, _MAX_AIRMASS = -15.0, 30.0, 2.0
# Largest airmass of a field. Beyond it, the highest altitude of the field is used, with at most this airmass.
HIGHEST_AIRMASS = 3.0
# Step and length of the search for dark time, days.
_STEP, _DAYS = 1.0 / 96.0, 400


@dataclass(frozen=True, slots=True)
class Site:
    """Position of an observatory.

    Attributes
    ----------
    latitude, longitude : float
        Geographic position, deg north and east.
    height : float
        Height, m.
    """

    latitude: float
    longitude: float
    height: float

    @classmethod
    def from_mission(cls, section: str, mission: MissionConfiguration) -> Site:
        """Read the site of a ground camera from its section of the mission database."""
        latitude, longitude = (mission.value(f"{section}.site.{key}", "deg") for key in ("latitude", "longitude"))
        return cls(latitude, longitude, mission.value(f"{section}.site.height", "m"))

    def altitude(self, ra: npt.ArrayLike, dec: npt.ArrayLike, mjd: npt.ArrayLike) -> Float:
        """Altitude above the horizon without refraction.

        Parameters
        ----------
        ra, dec : array_like
            Positions, deg.
        mjd : array_like
            Dates.

        Returns
        -------
        float array
            Altitude, deg, to 0.2 deg because precession and nutation since 2000 are neglected.
        """
        hour, dec, latitude = self._hour_angle(ra, mjd), np.radians(dec), np.radians(self.latitude)
        sine = np.sin(latitude) * np.sin(dec) + np.cos(latitude) * np.cos(dec) * np.cos(hour)
        return np.asarray(np.degrees(np.arcsin(np.clip(sine, -1.0, 1.0))))

    def zenith(self, ra: float, dec: float, mjd: float) -> float:
        """Parallactic angle: position angle of the zenith from a field.

        Parameters
        ----------
        ra, dec : float
            Position of the field, deg.
        mjd : float
            Date.

        Returns
        -------
        float
            Angle, deg from north through east.
        """
        hour, latitude, declination = float(self._hour_angle(ra, mjd)), np.radians(self.latitude), np.radians(dec)
        east = np.sin(hour) * np.cos(latitude)
        north = np.sin(latitude) * np.cos(declination) - np.cos(latitude) * np.sin(declination) * np.cos(hour)
        return float(np.degrees(np.arctan2(east, north)))

    def _hour_angle(self, ra: npt.ArrayLike, mjd: npt.ArrayLike) -> Float:
        turns = _TURN + _TURNS_A_DAY * (np.asarray(mjd, float) - _MJD_J2000)
        return np.asarray(2.0 * np.pi * (turns % 1.0) + np.radians(self.longitude - np.asarray(ra, float)))


def sun_altitude(mjd: npt.ArrayLike, site: Site) -> Float:
    """Altitude of the Sun above the horizon of a site, deg."""
    sun = _sun_longitudes(np.asarray(mjd, float))
    return site.altitude(*equatorial(sun, np.zeros_like(sun)), mjd)


def airmass(altitude: npt.ArrayLike) -> Float:
    """Airmass at an altitude in deg; altitudes below 0 are set to 0.

    References
    ----------
    Kasten & Young 1989, Appl. Opt. 28, 4735.
    """
    up = np.maximum(np.asarray(altitude, float), 0.0)
    return np.asarray(np.maximum(1.0 / (np.sin(np.radians(up)) + 0.50572 * (up + 6.07995) ** -1.6364), 1.0))


def airmass_and_zenith(ra: float, dec: float, mjd: float, site: Site) -> tuple[float, float]:
    """Airmass of a field, and position angle of the zenith, at a date.

    Parameters
    ----------
    ra, dec : float
        Position of the field, deg.
    mjd : float
        Date.
    site : Site
        The observatory.

    Returns
    -------
    (float, float)
        Airmass, and position angle in deg from north through east.

    Notes
    -----
    If the field is below the horizon or too low, its highest altitude is used, since dates of a plan may define only
    the order of exposures.
    """
    altitude = float(site.altitude(ra, dec, mjd))
    field_airmass = float(airmass(altitude))
    if altitude > 0.0 and field_airmass <= HIGHEST_AIRMASS:
        return field_airmass, site.zenith(ra, dec, mjd)
    highest = 90.0 - abs(dec - site.latitude)
    field_airmass = min(float(airmass(highest)), HIGHEST_AIRMASS) if highest > 0.0 else HIGHEST_AIRMASS
    return field_airmass, 0.0 if dec < site.latitude else 180.0


def moon_position(mjd: npt.ArrayLike) -> tuple[Float, Float, Float]:
    """Right ascension, declination and phase angle of the Moon, deg; the phase angle is 0 at full moon.

    The position is geocentric, with an error of 0.5 deg.
    """
    century = (np.asarray(mjd, float) - _MJD_J2000) / 36525.0

    def sum_series(terms: tuple[tuple[float, float, float], ...]) -> Float:
        total = sum(size * np.sin(np.radians(phase + rate * century)) for size, phase, rate in terms)
        return np.asarray(total, float)

    longitude = _MOON_MEAN[0] + _MOON_MEAN[1] * century + sum_series(_MOON_LONGITUDE) - _PRECESSION * century
    latitude = sum_series(_MOON_LATITUDE)
    sun = _sun_longitudes(np.asarray(mjd, float))
    elongation = np.degrees(np.arccos(np.cos(np.radians(latitude)) * np.cos(np.radians(longitude - sun))))
    ra, dec = equatorial(longitude % 360.0, latitude)
    return ra, dec, 180.0 - elongation


def moon_altitude(mjd: npt.ArrayLike, site: Site) -> Float:
    """Altitude of the Moon above the horizon of a site, corrected for parallax, deg."""
    ra, dec, _ = moon_position(mjd)
    high = site.altitude(ra, dec, mjd)
    return np.asarray(high - _PARALLAX * np.cos(np.radians(high)))


def next_dark_time(ra: float, dec: float, start: float, site: Site) -> float:
    """First date at which a field is high enough at night and away from the Moon.

    Parameters
    ----------
    ra, dec : float
        Position of the field, deg.
    start : float
        Earliest date, MJD.
    site : Site
        The observatory.

    Returns
    -------
    float
        MJD, to a quarter of an hour; `start` if there is no such date.
    """
    if float(airmass(90.0 - abs(dec - site.latitude))) > _MAX_AIRMASS:
        return start
    # Most exposures directly follow another one in the same night.
    if _is_dark(ra, dec, np.array([start]), site)[0]:
        return start
    for day in range(_DAYS):
        times: Float = start + day + _STEP * np.arange(float(round(1.0 / _STEP)))
        good = np.flatnonzero(_is_dark(ra, dec, times, site))
        if len(good):
            return float(times[good[0]])
    return start


def _sun_longitudes(mjd: Float) -> Float:
    """Ecliptic longitudes of the Sun, deg."""
    return np.array([sun_longitude(float(t)) for t in mjd.ravel()]).reshape(mjd.shape)


def _is_dark(ra: float, dec: float, mjd: Float, site: Site) -> Bool:
    night = sun_altitude(mjd, site) < _TWILIGHT
    up = airmass(site.altitude(ra, dec, mjd)) <= _MAX_AIRMASS
    if not (night & up).any():
        return night & up
    moon_ra, moon_dec, _ = moon_position(mjd)
    away = separation(np.full(len(mjd), ra), np.full(len(mjd), dec), moon_ra, moon_dec) > _FROM_MOON
    return np.asarray(night & up & (away | (moon_altitude(mjd, site) < 0.0)))
