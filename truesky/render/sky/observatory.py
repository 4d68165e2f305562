"""Compute airmass and direction of the zenith for a field, Sun and Moon positions, and dark time at an observatory."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Bool, Float
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.sky import separation
from lake_schema.sky.ecliptic import equatorial
from truesky.render.sky.diffuse_light import sun_longitude, sun_longitudes

# MJD of the epoch J2000.
_MJD_J2000 = 51544.5
# Earth rotation angle at J2000, in turns (IAU 2000).
_TURN = 0.7790572732640
# Rate of the Earth rotation angle, in turns per day.
_TURNS_A_DAY = 1.00273781191135448
# Terms of the Moon's ecliptic longitude (deg), a sin(p + r t) with t in Julian centuries since J2000: amplitude a
# (deg), phase p (deg) and rate r (deg per century) of each; low precision formula of The Astronomical Almanac.
_MOON_LONGITUDE = (
    (6.29, 135.0, 477198.87), (-1.27, 259.3, -413335.36), (0.66, 235.7, 890534.22), (0.21, 269.9, 954397.74),
    (-0.19, 357.5, 35999.05), (-0.11, 186.5, 966404.03),
)  # fmt: skip
# Terms of the Moon's ecliptic latitude (deg), a sin(p + r t) with t in Julian centuries since J2000: amplitude a (deg),
# phase p (deg) and rate r (deg per century) of each; low precision formula of The Astronomical Almanac.
_MOON_LATITUDE = (
    (5.13, 93.3, 483202.02), (0.28, 228.2, 960400.89), (-0.28, 318.3, 6003.15), (-0.17, 217.6, -407332.21),
)  # fmt: skip
# Mean longitude of the Moon at J2000 (deg) and its rate (deg per century).
_MOON_MEAN = (218.32, 481267.881)
# General precession in longitude, deg per century.
_PRECESSION = 1.39697
# Mean horizontal parallax of the Moon, deg: by how much it appears lower on the horizon than from the Earth's centre.
_PARALLAX = 0.95
# Largest altitude of the Sun (deg) at which a ground exposure is scheduled: the end of astronomical twilight.
_TWILIGHT = -18.0
# Altitude (deg) below which the Moon counts as set. It allows for the error of its position and for the time that an
# exposure takes.
_MOON_SET = -2.0
# Smallest distance from the Moon (deg) at which a ground exposure is scheduled while the Moon is up.
_FROM_MOON = 30.0
# Largest airmass at which a ground exposure is scheduled, and largest ratio of this airmass to that of the field on the
# meridian. The second limit keeps fields high.
_MAX_AIRMASS, _MAX_RELATIVE_AIRMASS = 2.0, 1.2
# Largest airmass with which an exposure is simulated. A field that is lower is simulated at its highest altitude.
HIGHEST_AIRMASS = 3.0
# Altitude (deg) at which the airmass is `HIGHEST_AIRMASS`.
LOWEST_ALTITUDE = 19.3168
# Step in days with which dark time is searched: a quarter of an hour.
_STEP = 1.0 / 96.0
# Number of days after the earliest date in which dark time is searched.
_DAYS = 400
# Number of days of which the transits are searched together.
_BLOCK = 25


@dataclass(frozen=True, slots=True)
class Site:
    """Position of an observatory on the Earth.

    Attributes
    ----------
    latitude, longitude : float
        Geographic latitude (deg north) and longitude (deg east).
    height : float
        Height above sea level in metres.
    """

    latitude: float
    longitude: float
    height: float

    @classmethod
    def from_mission(cls, section: str, mission: MissionConfiguration) -> Site:
        """Read the observatory of a ground camera from the mission database.

        `section` is the beginning of the camera's parameter names, such as "ext.decam".
        """
        latitude, longitude = (mission.value(f"{section}.site.{key}", "deg") for key in ("latitude", "longitude"))
        return cls(latitude, longitude, mission.value(f"{section}.site.height", "m"))

    def altitude(self, ra: npt.ArrayLike, dec: npt.ArrayLike, mjd: npt.ArrayLike) -> Float:
        """Return the altitude of positions above the horizon, without refraction.

        Parameters
        ----------
        ra, dec : array_like
            ICRS positions in degrees.
        mjd : array_like
            Dates (MJD). The three arguments are broadcast against one another.

        Returns
        -------
        float array, broadcast shape of the arguments
            Altitude in degrees, negative below the horizon. The error is at most 0.2 deg until 2035, and 0.6 deg for
            each century before or after 2000, because precession and nutation since 2000 are neglected.
        """
        hour, dec, latitude = self.hour_angle(ra, mjd), np.radians(dec), np.radians(self.latitude)
        sine = np.sin(latitude) * np.sin(dec) + np.cos(latitude) * np.cos(dec) * np.cos(hour)
        return np.asarray(np.degrees(np.arcsin(np.clip(sine, -1.0, 1.0))))

    def zenith(self, ra: float, dec: float, mjd: float) -> float:
        """Return the position angle of the zenith as seen from a field (the parallactic angle).

        Parameters
        ----------
        ra, dec : float
            ICRS position of the field in degrees.
        mjd : float
            Date (MJD).

        Returns
        -------
        float
            Angle in degrees from north through east, -180 to 180.
        """
        hour, latitude, declination = float(self.hour_angle(ra, mjd)), np.radians(self.latitude), np.radians(dec)
        east = np.sin(hour) * np.cos(latitude)
        north = np.sin(latitude) * np.cos(declination) - np.cos(latitude) * np.sin(declination) * np.cos(hour)
        return float(np.degrees(np.arctan2(east, north)))

    def azimuth(self, ra: float, dec: float, mjd: float) -> float:
        """Return the azimuth of a position.

        Parameters
        ----------
        ra, dec : float
            ICRS position in degrees.
        mjd : float
            Date (MJD).

        Returns
        -------
        float
            Angle in degrees from north through east, 0 to 360. Its error on the sky is the error of `altitude`.
        """
        hour, latitude, declination = float(self.hour_angle(ra, mjd)), np.radians(self.latitude), np.radians(dec)
        east = -np.cos(declination) * np.sin(hour)
        north = np.sin(declination) * np.cos(latitude) - np.cos(declination) * np.sin(latitude) * np.cos(hour)
        return float(np.degrees(np.arctan2(east, north)) % 360.0)

    def hour_angle(self, ra: npt.ArrayLike, mjd: npt.ArrayLike) -> Float:
        """Return the angle in radians by which a right ascension (deg) has passed the meridian, for dates (MJD)."""
        turns = _TURN + _TURNS_A_DAY * (np.asarray(mjd, float) - _MJD_J2000)
        return np.asarray(2.0 * np.pi * (turns % 1.0) + np.radians(self.longitude - np.asarray(ra, float)))


def sun_altitude(mjd: npt.ArrayLike, site: Site) -> Float:
    """Return the altitude of the Sun above the horizon of an observatory in degrees, for an array of dates (MJD)."""
    sun = sun_longitudes(np.asarray(mjd, float))
    return site.altitude(*equatorial(sun, np.zeros_like(sun)), mjd)


def sun_direction(mjd: float, site: Site) -> tuple[float, float]:
    """Return the altitude and the azimuth of the Sun in degrees at an observatory and a date (MJD)."""
    ra, dec = (float(x) for x in equatorial(sun_longitude(mjd), 0.0))
    return float(site.altitude(ra, dec, mjd)), site.azimuth(ra, dec, mjd)


def airmass(altitude: npt.ArrayLike) -> Float:
    """Return the airmass at altitudes in degrees. Below the horizon it is that of the horizon (about 38).

    References
    ----------
    Kasten & Young 1989, Appl. Opt. 28, 4735.
    """
    up = np.maximum(np.asarray(altitude, float), 0.0)
    return np.asarray(np.maximum(1.0 / (np.sin(np.radians(up)) + 0.50572 * (up + 6.07995) ** -1.6364), 1.0))


def airmass_and_zenith(ra: float, dec: float, mjd: float, site: Site) -> tuple[float, float]:
    """Return the airmass of a field and the position angle of the zenith at a date.

    Parameters
    ----------
    ra, dec : float
        ICRS position of the field in degrees.
    mjd : float
        Date (MJD).
    site : Site
        The observatory.

    Returns
    -------
    (float, float)
        Airmass, at most `HIGHEST_AIRMASS`; position angle of the zenith in degrees from north through east.

    Notes
    -----
    The date of a planned exposure may be nominal: it gives the place in a sequence, not a time at which the field is
    visible. If the field is below the horizon or its airmass exceeds `HIGHEST_AIRMASS`, the results are therefore the
    values at its highest altitude (on the meridian).
    """
    altitude = float(site.altitude(ra, dec, mjd))
    field_airmass = float(airmass(altitude))
    if altitude > 0.0 and field_airmass <= HIGHEST_AIRMASS:
        return field_airmass, site.zenith(ra, dec, mjd)
    highest = 90.0 - abs(dec - site.latitude)
    field_airmass = min(float(airmass(highest)), HIGHEST_AIRMASS) if highest > 0.0 else HIGHEST_AIRMASS
    return field_airmass, 0.0 if dec < site.latitude else 180.0


def altitude_and_azimuth(ra: float, dec: float, mjd: float, site: Site) -> tuple[float, float]:
    """Return the altitude and the azimuth of a field, in agreement with `airmass_and_zenith`.

    Parameters
    ----------
    ra, dec : float
        ICRS position of the field in degrees.
    mjd : float
        Date (MJD).
    site : Site
        The observatory.

    Returns
    -------
    (float, float)
        Altitude in degrees; azimuth in degrees from north through east. If the field is too low at this date, they are
        the values on the meridian, as for the airmass. The altitude is never below that of `HIGHEST_AIRMASS`.
    """
    altitude = float(site.altitude(ra, dec, mjd))
    if altitude > 0.0 and float(airmass(altitude)) <= HIGHEST_AIRMASS:
        return altitude, site.azimuth(ra, dec, mjd)
    return max(90.0 - abs(dec - site.latitude), LOWEST_ALTITUDE), 180.0 if dec < site.latitude else 0.0


def moon_position(mjd: npt.ArrayLike) -> tuple[Float, Float, Float]:
    """Return the right ascension, declination and phase angle of the Moon in degrees, for an array of dates (MJD).

    The phase angle is 0 at full moon and 180 at new moon. The position is geocentric and in ICRS, with an error of 0.5
    deg.
    """
    century = (np.asarray(mjd, float) - _MJD_J2000) / 36525.0

    def sum_series(terms: tuple[tuple[float, float, float], ...]) -> Float:
        total = sum(size * np.sin(np.radians(phase + rate * century)) for size, phase, rate in terms)
        return np.asarray(total, float)

    longitude = _MOON_MEAN[0] + _MOON_MEAN[1] * century + sum_series(_MOON_LONGITUDE) - _PRECESSION * century
    latitude = sum_series(_MOON_LATITUDE)
    sun = sun_longitudes(np.asarray(mjd, float))
    elongation = np.degrees(np.arccos(np.cos(np.radians(latitude)) * np.cos(np.radians(longitude - sun))))
    ra, dec = equatorial(longitude % 360.0, latitude)
    return ra, dec, 180.0 - elongation


def moon_altitude(mjd: npt.ArrayLike, site: Site) -> Float:
    """Return the altitude of the Moon above the horizon in degrees, corrected for parallax, for an array of MJD."""
    ra, dec, _ = moon_position(mjd)
    return _moon_altitude_at(ra, dec, mjd, site)


def _moon_altitude_at(ra: Float, dec: Float, mjd: npt.ArrayLike, site: Site) -> Float:
    """Return the altitude of the Moon, degrees, from its geocentric position."""
    high = site.altitude(ra, dec, mjd)
    return np.asarray(high - _PARALLAX * np.cos(np.radians(high)))


def moon_lit_fraction(mjd: npt.ArrayLike) -> Float:
    """Return the illuminated fraction of the Moon's disc, from 0 (new) to 1 (full), for an array of dates (MJD)."""
    return _lit_fraction(moon_position(mjd)[2])


def _lit_fraction(phase_angle: Float) -> Float:
    return np.asarray(0.5 * (1.0 + np.cos(np.radians(phase_angle))))


def next_dark_time(ra: float, dec: float, start: float, site: Site, max_moon: float) -> float:
    """Return the first date at which a field is high in a dark sky.

    Parameters
    ----------
    ra, dec : float
        ICRS position of the field in degrees.
    start : float
        Earliest date (MJD).
    site : Site
        The observatory.
    max_moon : float
        Largest illuminated fraction of the Moon while it is above the horizon and more than 30 deg away. With 0 the
        Moon is always below the horizon.

    Returns
    -------
    float
        MJD, found in steps of a quarter of an hour; `start` if there is no such date within 400 days. The Sun is more
        than 18 deg below the horizon. The airmass is at most 1.2 times that on the meridian, and at most 2. A field
        with a higher airmass on the meridian is too low at all times; its date is in the first dark time.
    """
    # Test `start` before the search: most exposures directly follow another one in the same night.
    if _is_observable(ra, dec, np.array([start]), site, max_moon)[0]:
        return start
    for day in range(_DAYS):
        times: Float = start + day + _STEP * np.arange(float(round(1.0 / _STEP)))
        good = np.flatnonzero(_is_observable(ra, dec, times, site, max_moon))
        if len(good):
            return float(times[good[0]])
    return start


def next_dark_transit(ra: float, dec: float, start: float, site: Site, max_moon: float) -> float:
    """Return the first date at which a field crosses the meridian in the dark, where it is highest.

    Parameters
    ----------
    ra, dec : float
        ICRS position of the field in degrees.
    start : float
        Earliest date (MJD).
    site : Site
        The observatory.
    max_moon : float
        Largest illuminated fraction of the Moon while it is above the horizon, as in `next_dark_time`.

    Returns
    -------
    float
        MJD of the transit. For an hour before and after it, the Sun is more than 18 deg below the horizon, and the Moon
        is below the horizon, or faint and more than 30 deg away. `start` if there is no such date within 400 days. The
        field may be low, or never rise.
    """
    first = (-float(site.hour_angle(ra, start)) / (2.0 * np.pi)) % 1.0
    transits = start + (first + np.arange(float(_DAYS))) / _TURNS_A_DAY
    # A table may have thousands of fields without a date, and most find one within a few months.
    for block in np.array_split(transits, _DAYS // _BLOCK):
        hours_around = [_is_dark(ra, dec, block + hours / 24.0, site, max_moon) for hours in (-1.0, 0.0, 1.0)]
        is_dark = np.all(hours_around, axis=0)
        if is_dark.any():
            return float(block[np.argmax(is_dark)])
    return start


def _is_observable(ra: float, dec: float, mjd: Float, site: Site, max_moon: float) -> Bool:
    lowest = float(airmass(90.0 - abs(dec - site.latitude)))
    if lowest > _MAX_AIRMASS:
        return _is_dark(ra, dec, mjd, site, max_moon)
    is_high = airmass(site.altitude(ra, dec, mjd)) <= min(_MAX_AIRMASS, _MAX_RELATIVE_AIRMASS * lowest)
    return np.asarray(is_high & _is_dark(ra, dec, mjd, site, max_moon)) if is_high.any() else is_high


def _is_dark(ra: float, dec: float, mjd: Float, site: Site, max_moon: float) -> Bool:
    night = sun_altitude(mjd, site) < _TWILIGHT
    if not night.any():
        return night
    moon_ra, moon_dec, phase_angle = moon_position(mjd)
    away = separation(np.full(len(mjd), ra), np.full(len(mjd), dec), moon_ra, moon_dec) > _FROM_MOON
    is_faint = away & (_lit_fraction(phase_angle) <= max_moon)
    return np.asarray(night & (is_faint | (_moon_altitude_at(moon_ra, moon_dec, mjd, site) < _MOON_SET)))
