"""Angle between pointings of Euclid and the Sun, and the dates at which a pointing is allowed.

References
----------
Scaramella et al. 2022, section 4.1.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import numpy as np

from lake_schema import sky
from lake_schema.arrays import Float
from lake_schema.errors import BadInput
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.sky.ecliptic import equatorial
from truesky.numerics import matrices
from truesky.render.camera import pointing
from truesky.render.sky.diffuse_light import sun_longitude

# Tolerance of the limits, deg; the low-precision position of the Sun has an error of 0.02 deg.
_TOLERANCE = 0.05
# Length, step and accuracy of the search for allowed dates, days. A year contains all seasons, and the shortest lasts
# two weeks.
_SPAN, _STEP, _EXACT = 400.0, 1.0, 1e-3
# Calendar date of MJD 0.
_FIRST_DAY = np.datetime64("1858-11-17")


def sun_vector(mjd: float) -> Float:
    """Unit vector from the Earth to the Sun, ICRS, with an error of 0.02 deg."""
    return sky.unit_vectors(*equatorial(sun_longitude(mjd), 0.0))


def solar_aspect(ra: float, dec: float, mjd: float) -> float:
    """Angle between a pointing and the Sun.

    Parameters
    ----------
    ra, dec : float
        Pointing, deg.
    mjd : float
        Date.

    Returns
    -------
    float
        Angle, deg.
    """
    return float(np.degrees(np.arccos(np.clip(matrices.matmul(sky.unit_vectors(ra, dec), sun_vector(mjd)), -1.0, 1.0))))


def position_angle(ra: float, dec: float, mjd: float) -> float:
    """Position angle of the focal plane's y axis, with the sunshield towards the Sun.

    Parameters
    ----------
    ra, dec : float
        Pointing, deg.
    mjd : float
        Date.

    Returns
    -------
    float
        Angle, deg from north through east. The axis is perpendicular to the direction of the Sun, z x p.

    Raises
    ------
    BadInput
        If the pointing is parallel to the direction of the Sun.
    """
    p, s = sky.unit_vectors(ra, dec), sun_vector(mjd)
    towards = s - matrices.matmul(s, p) * p
    if matrices.matmul(towards, towards) < 1e-12:
        problem = "is parallel to the direction of the Sun, where no position angle is defined"
        raise BadInput(f"the pointing at ra {ra:g}, dec {dec:g} on MJD {mjd:g} {problem}")
    y = np.cross(towards, p)
    east, north, _ = pointing.basis(ra, dec)
    return float(np.degrees(np.arctan2(matrices.matmul(y, east), matrices.matmul(y, north))))


def limits(mission: MissionConfiguration) -> tuple[float, float]:
    """Smallest and largest angle from the Sun at which Euclid observes, deg."""
    return mission.value("svm.solar_aspect_min", "deg"), mission.value("svm.solar_aspect_max", "deg")


def is_allowed(ra: float, dec: float, mjd: float, mission: MissionConfiguration) -> bool:
    """Return True if the sunshield allows a pointing.

    Parameters
    ----------
    ra, dec : float
        Pointing, deg.
    mjd : float
        Date.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    bool
        True if the angle from the Sun is within the limits.
    """
    lowest, highest = limits(mission)
    return lowest - _TOLERANCE <= solar_aspect(ra, dec, mjd) <= highest + _TOLERANCE


def allowed_intervals(
    ra: float, dec: float, start: float, mission: MissionConfiguration
) -> Iterator[tuple[float, float]]:
    """Yield the intervals within 400 days in which a position is visible.

    Parameters
    ----------
    ra, dec : float
        Position, deg.
    start : float
        Earliest date, MJD.
    mission : MissionConfiguration
        Mission database.

    Yields
    ------
    (float, float)
        First and last MJD, to 0.001 d.
    """
    lowest, highest = limits(mission)
    days, suns = _sun_directions(start)
    aspect = np.degrees(np.arccos(np.clip(matrices.matmul(suns, sky.unit_vectors(ra, dec)), -1.0, 1.0)))
    free = ((lowest - _TOLERANCE <= aspect) & (aspect <= highest + _TOLERANCE)).tolist()
    first = start if free[0] else None
    for day, next_day, was_free, is_free in zip(days[:-1], days[1:], free[:-1], free[1:], strict=True):
        if is_free and not was_free:
            first = _edge(ra, dec, float(day), float(next_day), mission)
        elif was_free and not is_free and first is not None:
            yield first, _edge(ra, dec, float(next_day), float(day), mission)
            first = None
    if first is not None:
        yield first, float(days[-1])


@lru_cache(maxsize=8)
def _sun_directions(start: float) -> tuple[Float, Float]:
    """Dates [n], MJD, from `start`, and directions of the Sun [n, 3] at these dates."""
    days = start + np.arange(0.0, _SPAN + _STEP, _STEP)
    return days, np.stack([sun_vector(float(day)) for day in days])


def _edge(ra: float, dec: float, forbidden: float, free: float, mission: MissionConfiguration) -> float:
    """Allowed date next to the limit between an allowed and a forbidden date."""
    while abs(free - forbidden) > _EXACT:
        middle = 0.5 * (free + forbidden)
        forbidden, free = (forbidden, middle) if is_allowed(ra, dec, middle, mission) else (middle, free)
    return free


def next_allowed(ra: float, dec: float, start: float, mission: MissionConfiguration) -> float:
    """First date at which a position is visible.

    Parameters
    ----------
    ra, dec : float
        Position, deg.
    start : float
        Earliest date, MJD.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    float
        MJD.

    Raises
    ------
    BadInput
        If the position is not visible within 400 days.
    """
    if is_allowed(ra, dec, start, mission):
        return start
    for first, _ in allowed_intervals(ra, dec, start, mission):
        return first
    lowest, highest = limits(mission)
    raise BadInput(f"ra {ra:g}, dec {dec:g} is {lowest:g} to {highest:g} deg from the Sun on no day of the next year")


def check_aspect(ra: float, dec: float, mjd: float, mission: MissionConfiguration, where: str) -> None:
    """Refuse a pointing that the sunshield forbids.

    Parameters
    ----------
    ra, dec : float
        Pointing, deg.
    mjd : float
        Date.
    mission : MissionConfiguration
        Mission database.
    where : str
        Place in the user's input, for the message.

    Raises
    ------
    BadInput
        If the pointing is not allowed; the message contains the next allowed dates.
    """
    if is_allowed(ra, dec, mjd, mission):
        return
    lowest, highest = limits(mission)
    angle = solar_aspect(ra, dec, mjd)
    stretches = [
        f"{_date(first, 'up')} to {_date(last, 'down')}" for first, last in allowed_intervals(ra, dec, mjd, mission)
    ]
    when = f"next allowed: MJD {', '.join(stretches[:2])}" if stretches else "no day of the next year is allowed"
    raise BadInput(
        f"{where}: the pointing is {angle:.1f} deg from the Sun on MJD {mjd:g}, but {lowest:g} to {highest:g} deg is "
        f"allowed; {when}"
    )


def _date(mjd: float, towards: str) -> str:
    """Text of a date inside an interval: the first date is rounded up, the last one down."""
    tenth = (np.ceil if towards == "up" else np.floor)(mjd * 10.0) / 10.0
    return f"{tenth:.1f} ({_FIRST_DAY + int(tenth)})"
