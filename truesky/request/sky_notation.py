"""Read positions and dates of a request (a user's TOML file) that are not plain numbers.

A right ascension may be sexagesimal in hours ("03:32:28" or "3h32m28s"), and a declination sexagesimal in degrees
("-27:48:30" or "-27d48m30s"). A date may be an ISO date in UTC ("2027-01-01" or "2027-01-01T12:30:00"), which becomes
an MJD in UTC.
"""

from __future__ import annotations

import calendar
import math
import re
from collections.abc import Iterator
from datetime import UTC, date, datetime
from typing import Any

from lake_schema import arguments
from lake_schema.errors import BadInput, OutOfRange
from lake_schema.tables.exposures import GRISM_NAMES
from truesky.request.toml_values import Toml, checked_number, has_key, quote_value, required_value

# First and last date (MJD) that a request may contain: 1968 to 2132.
MJD_LIMITS = (40_000.0, 98_000.0)
# Limits of a right ascension and of a declination in degrees.
RA_LIMITS, DEC_LIMITS = (-360.0, 360.0), (-90.0, 90.0)
# Units in which a sexagesimal text is read.
_SEXAGESIMAL_UNITS = {"ra": "hourangle", "dec": "deg"}
_FORMS = {
    "ra": 'a number in degrees, or hours such as "03:32:28" or "3h32m28s"',
    "dec": 'a number in degrees, or degrees such as "-27:48:30" or "-27d48m30s"',
    "mjd": 'a number (MJD, UTC), or a date in UTC such as "2027-01-01" or "2027-01-01T12:30:00"',
}
# Text of at least two numbers with separators. A single number in quotes is not sexagesimal: its unit would be unclear.
_SEXAGESIMAL = re.compile(
    r"[+-]?\s*\d+\s*(?:[:hHdD°]|\s)\s*\d+(?:\s*(?:[:mM'′]|\s)\s*\d+(?:\.\d*)?)?\s*(?:[sS\"″]|[mM'′])?"
)
# Radius in degrees from which an area may have been meant in arcmin: larger than the fields of all cameras.
_LARGE_RADIUS = 5.0
# Midnight (UTC) at the start of MJD 0.
_MJD_0 = datetime(1858, 11, 17, tzinfo=UTC)
# The same as Julian date.
_JD_OF_MJD_0 = 2_400_000.5


def angle(value: object, path: str, axis: str, limits: tuple[float, float], ra: object = None) -> float:
    """Read a right ascension or a declination.

    Parameters
    ----------
    value : object
        Value in the request: a number in degrees, or a sexagesimal text.
    path : str
        Path of the key, for error messages.
    axis : str
        "ra" (texts are in hours) or "dec" (texts are in degrees).
    limits : (float, float)
        Smallest and largest angle in degrees.
    ra : object, optional
        Right ascension that belongs to a declination. If the declination is outside its limits, and this number is
        not, the message asks whether they are exchanged.

    Returns
    -------
    float
        The angle in degrees.

    Raises
    ------
    BadInput
        If the value is neither a number nor a sexagesimal text.
    OutOfRange
        If the angle is outside its limits.
    """
    if isinstance(value, str):
        return checked_number(_degrees(value, path, axis), f"{path} (deg)", *limits)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        arguments.refuse_coordinates(path, value)
        arguments.refuse_angle(path, value, "in degrees")
        raise BadInput(f"{path} must be {_FORMS[axis]}, got {quote_value(value)}")
    try:
        return checked_number(value, path, *limits)
    except OutOfRange as error:
        question = arguments.exchanged_question(ra, value)
        raise (error.with_question(question) if question else error) from None


def _degrees(text: str, path: str, axis: str) -> float:
    problem = BadInput(f"{path} = {quote_value(text)} must be {_FORMS[axis]}")
    if len(text) > 60 or not _SEXAGESIMAL.fullmatch(text.strip()):
        raise problem
    # Import here, because the import takes a second and most requests have only numbers.
    from astropy.coordinates import Angle

    try:
        degrees = float(Angle(text.strip(), unit=_SEXAGESIMAL_UNITS[axis]).deg)
    except ValueError:
        raise (_out_of_range(text, path, axis) or problem) from None
    return degrees


def _out_of_range(text: str, path: str, axis: str) -> BadInput | None:
    """Return an error about a sexagesimal text whose hours, minutes or seconds are out of range, else None."""
    first, *minutes = map(float, re.findall(r"\d+(?:\.\d*)?", text))
    value = f"{path} = {quote_value(text)}"
    if any(number >= 60.0 for number in minutes):
        return BadInput(f"{value}: minutes and seconds must be below 60")
    if axis == "ra" and first >= 24.0:
        degrees = first + sum(number / 60.0**power for power, number in enumerate(minutes, start=1))
        return BadInput(f"{value} must be from 0 to 24 hours; if it is in degrees, write the number {degrees:.7g}")
    return None


def mjd(value: object, path: str) -> float:
    """Read a date: a number (MJD, UTC), an ISO date as text, or a date of TOML; without a time it begins at midnight.

    Parameters
    ----------
    value : object
        Value in the request. A time without a time zone is in UTC.
    path : str
        Path of the key, for error messages.

    Returns
    -------
    float
        MJD in UTC.

    Raises
    ------
    BadInput
        If the value is neither a number nor a date.
    OutOfRange
        If the date is before 1968 or after 2132.
    """
    if isinstance(value, str):
        text = value.strip()
        try:
            value = datetime.fromisoformat(text)
        except ValueError:
            problem = _no_such_day(text) or f" must be {_FORMS['mjd']}"
            raise BadInput(f"{path} = {quote_value(text)}{problem}") from None
    if isinstance(value, date):
        return checked_number(_mjd_of_date(value), path, *MJD_LIMITS)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise BadInput(f"{path} must be {_FORMS['mjd']}, got {quote_value(value)}")
    # Compare before the subtraction, which fails for huge whole numbers.
    if MJD_LIMITS[0] + _JD_OF_MJD_0 <= value <= MJD_LIMITS[1] + _JD_OF_MJD_0:
        raise BadInput(f"{path} = {value} is a Julian date: write the MJD {value - _JD_OF_MJD_0:.10g}")
    return checked_number(value, path, *MJD_LIMITS)


def _no_such_day(text: str) -> str:
    """Return the problem of a date whose month or day does not exist, or ""."""
    date_match = re.match(r"(\d{4})-(\d\d)-(\d\d)(?!\d)", text)
    if date_match is None or not (year := int(date_match[1])):
        return ""
    month, day = int(date_match[2]), int(date_match[3])
    if not 1 <= month <= 12:
        return " is not a date: the month must be from 01 to 12"
    if not 1 <= day <= (days := calendar.monthrange(year, month)[1]):
        return f": there is no such day, {calendar.month_name[month]} {year} has {days} days"
    return ""


def _mjd_of_date(value: date) -> float:
    moment = value if isinstance(value, datetime) else datetime(value.year, value.month, value.day)
    # `timedelta` counts days of 86,400 s, as MJD (UTC) does.
    elapsed = (moment if moment.tzinfo is not None else moment.replace(tzinfo=UTC)) - _MJD_0
    return elapsed.days + (elapsed.seconds + 1e-6 * elapsed.microseconds) / 86_400.0


def ra_of(table: Toml, path: str) -> float:
    """Return the right ascension of a required key in degrees, 0 to 360; raises BadInput if it is missing or wrong."""
    return angle(required_value(table, path, _FORMS["ra"]), path, "ra", RA_LIMITS) % 360.0


def dec_of(table: Toml, path: str) -> float:
    """Return the declination of a required key in degrees; raises BadInput if it is missing or wrong."""
    return angle(required_value(table, path, _FORMS["dec"]), path, "dec", DEC_LIMITS, table.get("ra"))


def optional_ra(table: Toml, path: str) -> float | None:
    """Return the right ascension of a key in degrees, 0 to 360; None if the key is missing. Raises BadInput."""
    return ra_of(table, path) if has_key(table, path) else None


def optional_dec(table: Toml, path: str) -> float | None:
    """Return the declination of a key in degrees, None if the key is missing. Raises BadInput if it is wrong."""
    return dec_of(table, path) if has_key(table, path) else None


def optional_mjd(table: Toml, path: str) -> float | None:
    """Return the date (MJD) of a key, None if the key is missing. Raises BadInput if it is wrong."""
    return mjd(required_value(table, path), path) if has_key(table, path) else None


def understood_values(table: Toml) -> Iterator[str]:
    """Yield one line for each value of a valid request that a user may have meant differently: how it is understood.

    These are positions and dates that are not numbers, radii of areas that may have been meant in arcmin, and grisms
    that are named in place of passbands.
    `table` is the parsed request. Lines are, for example, "pointing[0].mjd = '2027-01-01' is MJD 61406 (UTC)".
    """
    for key in ("area", "pointing", "observation"):
        yield from _understood(table.get(key), key, "")


def _understood(value: Any, path: str, axis: str) -> Iterator[str]:
    if isinstance(value, dict):
        for key, item in value.items():
            yield from _understood(item, f"{path}.{key}", key)
    elif isinstance(value, list):
        is_place = axis in ("polygon", "patches") and not any(isinstance(item, (list, dict)) for item in value)
        for i, item in enumerate(value):
            # The first numbers of a vertex or of a circle are its right ascension and its declination.
            inner = ("ra", "dec", "")[min(i, 2)] if is_place else axis
            yield from _understood(item, f"{path}[{i}]", inner)
    elif axis == "mjd" and isinstance(value, (str, date)):
        yield f"{path} = {value} is MJD {mjd(value, path):.10g} (UTC)"
    elif axis in _SEXAGESIMAL_UNITS and isinstance(value, str):
        degrees = angle(value, path, axis, (-math.inf, math.inf))
        yield f"{path} = {value} is {degrees:.10g} deg"
    elif axis == "band" and value in GRISM_NAMES:
        band, direction = GRISM_NAMES[value]
        yield f"{path} = {value} is {band} with grism_angle = {direction:g}, unless grism_angle is given"
    elif axis == "bands" and value in GRISM_NAMES:
        yield f"{path} = {value} is {GRISM_NAMES[value][0]}; the survey sets the angles of the spectra"
    elif axis == "radius" and value >= _LARGE_RADIUS:
        yield f"{path} = {value} is in degrees; for {value} arcmin write {value / 60.0:.4g}"
