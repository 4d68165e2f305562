"""Compute the angle between a pointing of Euclid and the Sun, and the dates at which the pointing is allowed.

The sunshield protects the telescope only within a range of this angle.

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

# Angle in deg by which the allowed range of the angle from the Sun is widened at both ends, because the approximate
# position of the Sun has an error of 0.02 deg.
_TOLERANCE = 0.05
# Dates at which Euclid may observe a position are searched within this number of days. It exceeds a year, which has all
# seasons of visibility.
_SPAN = 400.0
# Step in days of the search for dates at which Euclid may observe a position. The shortest season of visibility is two
# weeks.
_STEP = 1.0
# Largest error in days of the first and last date of a season in which Euclid may observe a position.
_EXACT = 1e-3
# Calendar date of MJD 0, to write dates in messages.
_FIRST_DAY = np.datetime64("1858-11-17")


def sun_vector(mjd: float) -> Float:
    """Return the unit vector from the Earth to the Sun in ICRS, shape (3,), with an error of 0.02 deg."""
    return sky.unit_vectors(*equatorial(sun_longitude(mjd), 0.0))


def solar_aspect(ra: float, dec: float, mjd: float) -> float:
    """Return the angle between a pointing and the Sun.

    Parameters
    ----------
    ra, dec : float
        ICRS pointing in degrees.
    mjd : float
        Date (MJD).

    Returns
    -------
    float
        Angle in degrees, 0 to 180.
    """
    return float(np.degrees(np.arccos(np.clip(matrices.matmul(sky.unit_vectors(ra, dec), sun_vector(mjd)), -1.0, 1.0))))


def position_angle(ra: float, dec: float, mjd: float) -> float:
    """Return the position angle of Euclid's focal plane if the sunshield faces the Sun.

    Parameters
    ----------
    ra, dec : float
        ICRS pointing in degrees.
    mjd : float
        Date (MJD).

    Returns
    -------
    float
        Position angle of the y axis in degrees from north through east, -180 to 180. The y axis is perpendicular to
        the pointing and to the direction of the Sun.

    Raises
    ------
    BadInput
        If the pointing is towards the Sun or opposite to it, where no position angle is defined.
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
    """Return the smallest and the largest angle from the Sun at which Euclid may observe, in degrees."""
    return mission.value("svm.solar_aspect_min", "deg"), mission.value("svm.solar_aspect_max", "deg")


def is_allowed(ra: float, dec: float, mjd: float, mission: MissionConfiguration) -> bool:
    """Return True if Euclid may observe a pointing at a date without exposing the telescope to the Sun.

    Parameters
    ----------
    ra, dec : float
        ICRS pointing in degrees.
    mjd : float
        Date (MJD).
    mission : MissionConfiguration
        Mission database, with the limits on the angle from the Sun.

    Returns
    -------
    bool
        True if the angle from the Sun is within the limits, or at most 0.05 deg outside.
    """
    lowest, highest = limits(mission)
    return lowest - _TOLERANCE <= solar_aspect(ra, dec, mjd) <= highest + _TOLERANCE


def allowed_intervals(
    ra: float, dec: float, start: float, mission: MissionConfiguration
) -> Iterator[tuple[float, float]]:
    """Yield the intervals of dates, within 400 days, in which Euclid may observe a position.

    Parameters
    ----------
    ra, dec : float
        ICRS position in degrees.
    start : float
        Earliest date (MJD).
    mission : MissionConfiguration
        Mission database, with the limits on the angle from the Sun.

    Yields
    ------
    (float, float)
        First and last MJD of an interval, to 0.001 d; nothing if the position is never visible. The first interval
        begins at `start` if the position is visible then.
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
    """Return the daily dates (MJD) for 400 days from `start`, shape (n,), and the directions of the Sun, shape (n, 3).

    Directions are unit vectors in ICRS.
    """
    days = start + np.arange(0.0, _SPAN + _STEP, _STEP)
    return days, np.stack([sun_vector(float(day)) for day in days])


def _edge(ra: float, dec: float, forbidden: float, free: float, mission: MissionConfiguration) -> float:
    """Return the end of an interval in which a position is visible, by bisection between two dates (MJD).

    The position is visible at `free` and not at `forbidden`, in either order of time. The result is a visible date.
    """
    while abs(free - forbidden) > _EXACT:
        middle = 0.5 * (free + forbidden)
        forbidden, free = (forbidden, middle) if is_allowed(ra, dec, middle, mission) else (middle, free)
    return free


def next_allowed(ra: float, dec: float, start: float, mission: MissionConfiguration) -> float:
    """Return the first date at which Euclid may observe a position.

    Parameters
    ----------
    ra, dec : float
        ICRS position in degrees.
    start : float
        Earliest date (MJD).
    mission : MissionConfiguration
        Mission database, with the limits on the angle from the Sun.

    Returns
    -------
    float
        MJD; `start` if the position is visible then.

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
    """Check that Euclid may observe a pointing at a date.

    Parameters
    ----------
    ra, dec : float
        ICRS pointing in degrees.
    mjd : float
        Date (MJD).
    mission : MissionConfiguration
        Mission database, with the limits on the angle from the Sun.
    where : str
        Place in the user's input that gives the pointing, quoted in the error message.

    Raises
    ------
    BadInput
        If the date is before the launch, or the angle from the Sun is outside the limits. The message contains the next
        allowed dates.
    """
    launch = mission.value("svm.launch", "d")
    if mjd >= launch and is_allowed(ra, dec, mjd, mission):
        return
    lowest, highest = limits(mission)
    angle = solar_aspect(ra, dec, mjd)
    stretches = [
        f"{_date(first, 'up')} to {_date(last, 'down')}"
        for first, last in allowed_intervals(ra, dec, max(mjd, launch), mission)
    ]
    when = f"next allowed: MJD {', '.join(stretches[:2])}" if stretches else "no day of the next year is allowed"
    problem = (
        f"the pointing is {angle:.1f} deg from the Sun on MJD {mjd:g}, but {lowest:g} to {highest:g} deg is allowed"
    )
    if mjd < launch:
        problem = _before_launch(mjd, launch)
    raise BadInput(f"{where}: {problem}; {when}")


def check_launch(mjd: float, mission: MissionConfiguration, where: str) -> None:
    """Check that a date of an exposure of Euclid is not before the launch.

    Parameters
    ----------
    mjd : float
        Date (MJD).
    mission : MissionConfiguration
        Mission database, with the date of the launch.
    where : str
        Place in the user's input that gives the date, quoted in the error message.

    Raises
    ------
    BadInput
        If the date is before the launch.
    """
    launch = mission.value("svm.launch", "d")
    if mjd < launch:
        raise BadInput(f"{where}: {_before_launch(mjd, launch)}")


def _before_launch(mjd: float, launch: float) -> str:
    return f"MJD {mjd:g} is before the launch of Euclid on MJD {_date(launch, 'up')}"


def _date(mjd: float, towards: str) -> str:
    """Return a date as text, such as "60000.0 (2023-02-25)", rounded to 0.1 day.

    It is rounded up if `towards` is "up", otherwise down, so that the ends of an interval stay inside it.
    """
    tenth = (np.ceil if towards == "up" else np.floor)(mjd * 10.0) / 10.0
    return f"{tenth:.1f} ({_FIRST_DAY + int(tenth)})"
