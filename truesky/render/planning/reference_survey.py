"""The fields of the reference survey: a fixed lattice in ecliptic coordinates, and when the Sun lets each be seen.

wide      fields of the wide survey over an area, each with its date and position angle
deep      fields of a deep survey: a raster in the tangent plane, turned with the Sun from visit to visit
own       visits of a field of the user's

Ref : Scaramella et al. 2022; Serrano et al. 2024, section 3.2
"""

from __future__ import annotations

import heapq
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from lake_schema import sky
from lake_schema.arrays import Float, Int
from lake_schema.errors import BadInput
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.sky.ecliptic import ecliptic, equatorial
from truesky.render.camera import pointing
from truesky.render.sky.diffuse_light import sun_longitude
from truesky.render.sky.solar_aspect import next_allowed, position_angle
from truesky.request.area import Area

# Half the diagonal of the field of view, deg: fields whose centre is nearer to an area than this may see it.
_REACH = 0.52
# The Sun's largest daily motion, deg; how many half-years are looked through for a free date.
_SUN_RATE, _MAX_SEASONS = 1.02, 40


@dataclass(frozen=True, slots=True)
class Field:
    """One visit of a field: number in its survey, ICRS deg, MJD of its start."""

    number: int
    visit: int
    ra: float
    dec: float
    position_angle: float
    mjd: float


# ------------------------------------------------------------------------------------------------ wide survey


def lattice(area: Area, mission: MissionConfiguration, count: int = 0) -> tuple[Int, Float, Float]:
    """Numbers, ra, dec of the wide survey's fields that may see an area; of `count` > 0, those deepest inside.

    The lattice does not depend on the area: rows of ecliptic latitude, equally spaced in longitude.
    """
    step_x, step_y = (mission.value(f"survey.step_{axis}", "deg") for axis in "xy")
    rows = int(np.ceil(180.0 / step_y))
    latitude = -90.0 + 180.0 * (np.arange(rows) + 0.5) / rows
    # A row must hold together at its longer edge.
    widest = np.cos(np.radians(np.maximum(np.abs(latitude) - 90.0 / rows, 0.0)))
    counts = np.ceil(360.0 * widest / step_x).astype(np.int64)
    number = np.arange(counts.sum())
    row = np.repeat(np.arange(rows), counts)
    column = number - np.repeat(np.cumsum(counts) - counts, counts)
    ra, dec = equatorial(360.0 * (column + 0.5) / counts[row], latitude[row])
    depth = area.depth(ra, dec)
    if area.patches and count:
        # The same share of each patch, whatever its size.
        depth = np.max(
            [1.0 - sky.separation(ra, dec, x, y) / max(radius, 1e-9) for x, y, radius in area.patches], axis=0
        )
    inside = np.flatnonzero(depth >= -_REACH) if not count else np.sort(np.argsort(-depth, kind="stable")[:count])
    return number[inside] + 1, ra[inside], dec[inside]


def wide(area: Area, mission: MissionConfiguration, start: float, count: int = 0, visits: int = 1) -> list[Field]:
    """Fields of the wide survey over an area, in the order they are observed.

    start : MJD before which nothing is observed
    area  : of the request;  mission : the mission database
    count : fields, those deepest in the area, 0 = all that see it;  visits : of each field
    """
    number, ra, dec = lattice(area, mission, count)
    lon, lat = ecliptic(ra, dec)
    dates = _dates(lon, lat, start, mission, visits)
    fields = [
        Field(int(number[i]), visit + 1, float(ra[i]), float(dec[i]), position_angle(ra[i], dec[i], mjd), mjd)
        for i, visit, mjd in dates
    ]
    return sorted(fields, key=lambda field: (field.mjd, field.number))


def _dates(
    lon: Float, lat: Float, start: float, mission: MissionConfiguration, visits: int
) -> Iterator[tuple[int, int, float]]:
    """(field, visit, MJD): each visit in a season of its own, whoever's season ends first goes first."""
    days_before, days_after = _windows(lat, mission)
    slot = mission.value("svm.field_time", "d")
    # A field is at right angles to the Sun twice a year; seasons are counted from the first that is not over.
    waiting: list[tuple[float, float, int, int, int]] = []
    for i in range(len(lon)):
        season = _season(float(lon[i]), start, 0)
        first = 0 if season + float(days_after[i]) >= start + slot else 1
        middle = _season(float(lon[i]), start, first)
        heapq.heappush(waiting, (middle - float(days_before[i]), middle + float(days_after[i]), i, 0, first))
    ready: list[tuple[float, float, int, int, int]] = []
    now = start
    while waiting or ready:
        while waiting and waiting[0][0] <= now:
            opened, closes, i, visit, season_number = heapq.heappop(waiting)
            heapq.heappush(ready, (closes, opened, i, visit, season_number))
        if not ready:
            now = max(now, waiting[0][0])
            continue
        closes, _, i, visit, season_number = heapq.heappop(ready)
        done = closes >= now + slot
        if done:
            yield i, visit, now
            now += slot
        if not done or visit + 1 < visits:
            if season_number >= _MAX_SEASONS:
                raise BadInput(f"{len(lon)} fields of {visits} visits do not fit into {_MAX_SEASONS // 2} years")
            middle = _season(float(lon[i]), start, season_number + 1)
            entry = (
                middle - float(days_before[i]),
                middle + float(days_after[i]),
                i,
                visit + int(done),
                season_number + 1,
            )
            heapq.heappush(waiting, entry)


def _windows(lat: Float, mission: MissionConfiguration) -> tuple[Float, Float]:
    """Days before and after the right angle to the Sun within which a field may be seen."""
    lowest, highest = (mission.value(f"svm.solar_aspect_{end}", "deg") for end in ("min", "max"))
    beta = np.radians(np.abs(lat))
    # cos(aspect) = cos(beta) cos(longitude from the Sun); the smaller of the two sides serves both seasons.
    aspect = [
        np.degrees(np.arcsin(np.minimum(abs(np.cos(np.radians(limit))) / np.maximum(np.cos(beta), 1e-9), 1.0)))
        for limit in (lowest, highest)
    ]
    roll = mission.value("survey.roll_tolerance", "deg") / np.maximum(np.sin(beta), 1e-6)
    days = np.minimum(np.minimum(*aspect), roll) / _SUN_RATE
    slot = mission.value("svm.field_time", "d")
    # Near the pole a field's turn is faster than its slot: it is then seen at the right angle itself.
    return np.maximum(days, slot), np.maximum(days, 2 * slot)


def _season(lon: float, start: float, number: int) -> float:
    """MJD of the number-th time after `start` at which the Sun is 90 deg from an ecliptic longitude."""
    half_turns = 0.5 * 365.2422 * number
    remaining_angle = (lon - 90.0 - sun_longitude(start)) % 180.0
    date = start + remaining_angle / 360.0 * 365.2422 + half_turns
    for _ in range(4):
        error = (lon - 90.0 - sun_longitude(date) + 90.0) % 180.0 - 90.0
        date += error / 360.0 * 365.2422
    return float(date)


# ------------------------------------------------------------------------------------------------ deep survey


def deep(area: Area, mission: MissionConfiguration, start: float, visits: int, count: int = 0) -> list[Field]:
    """Visits of a deep field, in the order they are observed: a raster about the area's centre, turned at each visit.

    count : fields of the raster, those deepest in the area, 0 = all that may see it
    area  : of the request;  mission : the mission database
    start : MJD before which nothing is observed;  visits : of the field
    """
    ra0, dec0, _ = area.bounding_circle()
    lon, lat = (float(x) for x in ecliptic(ra0, dec0))
    fields: list[Field] = []
    now = start
    for visit, date in enumerate(_visit_dates(lon, lat, start, visits, mission)):
        now = max(now, date)
        angle = position_angle(ra0, dec0, now)
        for number, (ra, dec) in enumerate(_raster(area, ra0, dec0, angle, mission, count), start=1):
            field_angle = position_angle(ra, dec, now)
            fields.append(Field(number, visit + 1, ra, dec, field_angle, now))
            now += mission.value("svm.field_time", "d")
    return fields


def _visit_dates(lon: float, lat: float, start: float, visits: int, mission: MissionConfiguration) -> list[float]:
    lowest, highest = (mission.value(f"svm.solar_aspect_{end}", "deg") for end in ("min", "max"))
    span = mission.value("svm.mission_duration", "d")
    days = start + np.arange(int(span))
    sun = np.array([sun_longitude(float(day)) for day in days])
    cosine = np.cos(np.radians(lat)) * np.cos(np.radians(lon - sun))
    aspect = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    # Two degrees from the limits: the fields of a raster lie around its centre.
    open_days = days[(aspect >= lowest + 2.0) & (aspect <= highest - 2.0)]
    if open_days.size < visits:
        raise BadInput(f"a deep field at ecliptic latitude {lat:.1f} is seen on {open_days.size} days, not {visits}")
    chosen = open_days[(np.arange(visits) * open_days.size) // visits]
    return [float(day) for day in chosen]


def _raster(
    area: Area, ra0: float, dec0: float, angle: float, mission: MissionConfiguration, count: int
) -> Sequence[tuple[float, float]]:
    step_x, step_y = (mission.value(f"survey.step_{axis}", "deg") for axis in "xy")
    reach = area.bounding_circle()[2] + _REACH
    nx, ny = (int(np.ceil(reach / step)) for step in (step_x, step_y))
    x, y = np.meshgrid(np.arange(-nx, nx + 1) * step_x, np.arange(-ny, ny + 1) * step_y)
    ra, dec = pointing.sky_of_plane(x.ravel() * 3600.0, y.ravel() * 3600.0, ra0, dec0, angle)
    depth = area.depth(ra, dec)
    inside = np.flatnonzero(depth >= -_REACH) if not count else np.sort(np.argsort(-depth, kind="stable")[:count])
    return [(float(ra[i]), float(dec[i])) for i in inside]


# ------------------------------------------------------------------------------------------------ a field of one's own


def user_field_visits(
    place: tuple[float, float], mission: MissionConfiguration, start: float, visits: int, angle: float | None = None
) -> list[Field]:
    """Visits of a field, one after another, each at the first date that the Sun allows.

    place   : ra, dec deg;  mission : the mission database;  start : MJD, the earliest
    visits  : how many;  angle : position angle, deg, None = as the Sun asks at each visit
    """
    fields: list[Field] = []
    now = start
    for visit in range(visits):
        now = next_allowed(*place, now, mission)
        visit_angle = position_angle(*place, now) if angle is None else angle
        fields.append(Field(1, visit + 1, *place, visit_angle, now))
        now += mission.value("svm.field_time", "d")
    return fields
