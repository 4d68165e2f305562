"""Where the Sun lets Euclid look: the angle between a pointing and the Sun, and the dates at which it is allowed.

sun_vector, solar_aspect   the Sun's direction, and its distance from a pointing
position_angle             of the focal plane, with the sunshield towards the Sun
allowed, next_allowed      dates
check_aspect               refuses a pointing, and says when it is allowed

Ref : Scaramella et al. 2022, section 4.1
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

# The low-precision Sun is good to 0.02 deg.
_TOLERANCE = 0.05
# Days that are looked through for an allowed date, in steps and to an accuracy of so many days: a year sees every
# season, the shortest of them lasts two weeks.
_SPAN, _STEP, _EXACT = 400.0, 1.0, 1e-3
# 1858-11-17, from where MJD counts.
_FIRST_DAY = np.datetime64("1858-11-17")


def sun_vector(mjd: float) -> Float:
    """Unit vector [3], ICRS, from the Earth to the Sun.  Error: 0.02 deg"""
    return sky.unit_vectors(*equatorial(sun_longitude(mjd), 0.0))


def solar_aspect(ra: float, dec: float, mjd: float) -> float:
    """Angle between a pointing and the Sun, deg."""
    return float(np.degrees(np.arccos(np.clip(matrices.matmul(sky.unit_vectors(ra, dec), sun_vector(mjd)), -1.0, 1.0))))


def position_angle(ra: float, dec: float, mjd: float) -> float:
    """Of the focal plane's y axis, deg, north through east: across the direction of the Sun, z x p."""
    p, s = sky.unit_vectors(ra, dec), sun_vector(mjd)
    towards = s - matrices.matmul(s, p) * p
    if matrices.matmul(towards, towards) < 1e-12:
        raise BadInput(f"a pointing at ra {ra:g}, dec {dec:g} on MJD {mjd:g} looks along the Sun's direction")
    y = np.cross(towards, p)
    east, north, _ = pointing.basis(ra, dec)
    return float(np.degrees(np.arctan2(matrices.matmul(y, east), matrices.matmul(y, north))))


def limits(mission: MissionConfiguration) -> tuple[float, float]:
    """Smallest and largest angle from the Sun at which Euclid observes, deg."""
    return mission.value("svm.solar_aspect_min", "deg"), mission.value("svm.solar_aspect_max", "deg")


def is_allowed(ra: float, dec: float, mjd: float, mission: MissionConfiguration) -> bool:
    """Whether the sunshield lets the telescope look there.

    ra, dec : deg;  mjd : date;  mission : the mission database
    """
    lowest, highest = limits(mission)
    return lowest - _TOLERANCE <= solar_aspect(ra, dec, mjd) <= highest + _TOLERANCE


def allowed_intervals(
    ra: float, dec: float, start: float, mission: MissionConfiguration
) -> Iterator[tuple[float, float]]:
    """Stretches of dates (MJD from, to) within 400 days at which a place is seen.  Error: 0.001 d

    ra, dec : deg;  start : MJD;  mission : the mission database
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
    """Dates [n] MJD from `start` on, and the Sun's directions [n, 3] at them."""
    days = start + np.arange(0.0, _SPAN + _STEP, _STEP)
    return days, np.stack([sun_vector(float(day)) for day in days])


def _edge(ra: float, dec: float, forbidden: float, free: float, mission: MissionConfiguration) -> float:
    """An allowed date next to where the Sun begins to forbid it."""
    while abs(free - forbidden) > _EXACT:
        middle = 0.5 * (free + forbidden)
        forbidden, free = (forbidden, middle) if is_allowed(ra, dec, middle, mission) else (middle, free)
    return free


def next_allowed(ra: float, dec: float, start: float, mission: MissionConfiguration) -> float:
    """The first date at which a place is seen, MJD; BadInput where there is none in 400 days.

    ra, dec : deg;  start : MJD, the earliest;  mission : the mission database
    """
    if is_allowed(ra, dec, start, mission):
        return start
    for first, _ in allowed_intervals(ra, dec, start, mission):
        return first
    lowest, highest = limits(mission)
    raise BadInput(f"ra {ra:g}, dec {dec:g} is {lowest:g} to {highest:g} deg from the Sun on no day of the next year")


def check_aspect(ra: float, dec: float, mjd: float, mission: MissionConfiguration, where: str) -> None:
    """Refuse a pointing of the telescope that its sunshield forbids; the message names the next allowed dates.

    ra, dec, mjd : deg, and date;  mission : the mission database;  where : named in the refusal
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
        f"{where}: {angle:.1f} deg from the Sun on MJD {mjd:g}, the telescope looks {lowest:g} to {highest:g} deg from "
        f"it; {when}"
    )


def _date(mjd: float, towards: str) -> str:
    """A date that lies within the stretch: the first rounded up, the last rounded down."""
    tenth = (np.ceil if towards == "up" else np.floor)(mjd * 10.0) / 10.0
    return f"{tenth:.1f} ({_FIRST_DAY + int(tenth)})"
