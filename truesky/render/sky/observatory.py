"""What stands where above an observatory: airmass and zenith of a field, Sun and Moon, dark time.

Site           an observatory
aloft          airmass of a field, and where the zenith lies from it;  airmass : of an altitude
moon           place and phase of the Moon;  sun_altitude : of the Sun
next_dark      when a field can be observed next
"""

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
# Earth rotation angle, turns (IAU 2000): its zero moves with the equinox, as right ascensions of ICRS do not.
_TURN, _TURNS_A_DAY = 0.7790572732640, 1.00273781191135448
# Terms of the Moon's longitude and latitude, deg: amplitude, phase, rate a century (The Astronomical Almanac, low
# precision); its mean longitude; general precession a century.
_MOON_LONGITUDE = (
    (6.29, 135.0, 477198.87), (-1.27, 259.3, -413335.36), (0.66, 235.7, 890534.22), (0.21, 269.9, 954397.74),
    (-0.19, 357.5, 35999.05), (-0.11, 186.5, 966404.03),
)  # fmt: skip
_MOON_LATITUDE = (
    (5.13, 93.3, 483202.02), (0.28, 228.2, 960400.89), (-0.28, 318.3, 6003.15), (-0.17, 217.6, -407332.21),
)  # fmt: skip
_MOON_MEAN, _PRECESSION = (218.32, 481267.881), 1.39697
# The Moon's parallax, deg.
_PARALLAX = 0.95
# Surveys observe while the Sun is lower than this, and away from the Moon, deg; up to this airmass.
_TWILIGHT, _FROM_MOON, _MAX_AIRMASS = -15.0, 30.0, 2.0
# A date's airmass is not taken beyond: the field is then taken as at its highest, at no more than this.
HIGHEST_AIRMASS = 3.0
# Steps of a search, days, and how far it goes.
_STEP, _DAYS = 1.0 / 96.0, 400


@dataclass(frozen=True, slots=True)
class Site:
    """latitude, longitude : deg, north and east;  height : m."""

    latitude: float
    longitude: float
    height: float

    @classmethod
    def from_mission(cls, section: str, mission: MissionConfiguration) -> Site:
        """Of a ground camera's section of the mission database."""
        latitude, longitude = (mission.value(f"{section}.site.{key}", "deg") for key in ("latitude", "longitude"))
        return cls(latitude, longitude, mission.value(f"{section}.site.height", "m"))

    def altitude(self, ra: npt.ArrayLike, dec: npt.ArrayLike, mjd: npt.ArrayLike) -> Float:
        """deg [...] above the horizon, without refraction.  Error: 0.2 deg, of precession and nutation since 2000."""
        hour, dec, latitude = self._hour_angle(ra, mjd), np.radians(dec), np.radians(self.latitude)
        sine = np.sin(latitude) * np.sin(dec) + np.cos(latitude) * np.cos(dec) * np.cos(hour)
        return np.asarray(np.degrees(np.arcsin(np.clip(sine, -1.0, 1.0))))

    def zenith(self, ra: float, dec: float, mjd: float) -> float:
        """Position angle of the zenith from a field, north through east, deg: the parallactic angle."""
        hour, latitude, declination = float(self._hour_angle(ra, mjd)), np.radians(self.latitude), np.radians(dec)
        east = np.sin(hour) * np.cos(latitude)
        north = np.sin(latitude) * np.cos(declination) - np.cos(latitude) * np.sin(declination) * np.cos(hour)
        return float(np.degrees(np.arctan2(east, north)))

    def _hour_angle(self, ra: npt.ArrayLike, mjd: npt.ArrayLike) -> Float:
        turns = _TURN + _TURNS_A_DAY * (np.asarray(mjd, float) - _MJD_J2000)
        return np.asarray(2.0 * np.pi * (turns % 1.0) + np.radians(self.longitude - np.asarray(ra, float)))


def sun_altitude(mjd: npt.ArrayLike, site: Site) -> Float:
    """deg [...] above the horizon of a site."""
    sun = _sun_longitudes(np.asarray(mjd, float))
    return site.altitude(*equatorial(sun, np.zeros_like(sun)), mjd)


def airmass(altitude: npt.ArrayLike) -> Float:
    """Of an altitude of 0 deg or more.  Ref: Kasten & Young 1989, Appl. Opt. 28, 4735."""
    up = np.maximum(np.asarray(altitude, float), 0.0)
    return np.asarray(np.maximum(1.0 / (np.sin(np.radians(up)) + 0.50572 * (up + 6.07995) ** -1.6364), 1.0))


def airmass_and_zenith(ra: float, dec: float, mjd: float, site: Site) -> tuple[float, float]:
    """(airmass, position angle of the zenith in deg) of a field at a date.

    ra, dec, mjd : deg, and date;  site : of the observatory
    A field that is too low then, or not up, is taken as where it is highest: the date says no more than the order of
    exposures.
    """
    altitude = float(site.altitude(ra, dec, mjd))
    field_airmass = float(airmass(altitude))
    if altitude > 0.0 and field_airmass <= HIGHEST_AIRMASS:
        return field_airmass, site.zenith(ra, dec, mjd)
    highest = 90.0 - abs(dec - site.latitude)
    field_airmass = min(float(airmass(highest)), HIGHEST_AIRMASS) if highest > 0.0 else HIGHEST_AIRMASS
    return field_airmass, 0.0 if dec < site.latitude else 180.0


def moon_position(mjd: npt.ArrayLike) -> tuple[Float, Float, Float]:
    """(ra, dec, phase angle) of the Moon, deg [...]: 0 when full.  Error: 0.5 deg, seen from the Earth's centre."""
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
    """deg [...] above the horizon of a site, parallax taken off."""
    ra, dec, _ = moon_position(mjd)
    high = site.altitude(ra, dec, mjd)
    return np.asarray(high - _PARALLAX * np.cos(np.radians(high)))


def next_dark_time(ra: float, dec: float, start: float, site: Site) -> float:
    """MJD from `start` on when a field is up at night away from the Moon, to a quarter of an hour; `start` if never.

    ra, dec : deg;  site : of the observatory
    """
    if float(airmass(90.0 - abs(dec - site.latitude))) > _MAX_AIRMASS:
        return start
    # Most exposures follow one another in a night.
    if _is_dark(ra, dec, np.array([start]), site)[0]:
        return start
    for day in range(_DAYS):
        times: Float = start + day + _STEP * np.arange(float(round(1.0 / _STEP)))
        good = np.flatnonzero(_is_dark(ra, dec, times, site))
        if len(good):
            return float(times[good[0]])
    return start


def _sun_longitudes(mjd: Float) -> Float:
    """Ecliptic longitude, deg [...]."""
    return np.array([sun_longitude(float(t)) for t in mjd.ravel()]).reshape(mjd.shape)


def _is_dark(ra: float, dec: float, mjd: Float, site: Site) -> Bool:
    night = sun_altitude(mjd, site) < _TWILIGHT
    up = airmass(site.altitude(ra, dec, mjd)) <= _MAX_AIRMASS
    if not (night & up).any():
        return night & up
    moon_ra, moon_dec, _ = moon_position(mjd)
    away = separation(np.full(len(mjd), ra), np.full(len(mjd), dec), moon_ra, moon_dec) > _FROM_MOON
    return np.asarray(night & up & (away | (moon_altitude(mjd, site) < 0.0)))
