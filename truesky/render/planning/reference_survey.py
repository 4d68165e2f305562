"""Place the fields of the Euclid wide and deep surveys on the sky, and choose their dates within the Sun constraints.

References
----------
Scaramella et al. 2022; Serrano et al. 2024, section 3.2
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

# Half the diagonal of Euclid's field of view, deg. A field whose centre is farther from an area cannot see any of it.
_REACH = 0.52
# Largest angular speed of the Sun along the ecliptic during the year, deg per day.
_SUN_RATE = 1.02
# A date for each visit of a field is searched in this number of half-years from the start of the survey. Without a free
# date, BadInput is raised.
_MAX_SEASONS = 40


@dataclass(frozen=True, slots=True)
class Field:
    """One visit of a field of a Euclid survey.

    `number` is that of the field in its survey and `visit` that of the visit, both from 1. `ra`, `dec` (ICRS) and
    `position_angle` are in degrees. `mjd` is the start.
    """

    number: int
    visit: int
    ra: float
    dec: float
    position_angle: float
    mjd: float


def lattice(area: Area, mission: MissionConfiguration, count: int = 0) -> tuple[Int, Float, Float]:
    """Return the fields of the Euclid wide survey that may see part of an area.

    Parameters
    ----------
    area : Area
        Area on the sky.
    mission : MissionConfiguration
        Mission database, with the steps between neighbouring fields.
    count : int
        Number of fields. The fields with centres farthest inside the area (or nearest to it) are chosen. 0 means all
        fields that may see part of the area.

    Returns
    -------
    number : int array, shape (n,)
        Numbers of the fields on the whole sky, from 1, ascending.
    ra, dec : float array, shape (n,)
        ICRS positions of the field centres in degrees.

    Notes
    -----
    The fields form a fixed lattice on the whole sky, which does not depend on the area. It has rows of constant
    ecliptic latitude, and fields are equally spaced in longitude along a row.
    """
    step_x, step_y = (mission.value(f"survey.step_{axis}", "deg") for axis in "xy")
    rows = int(np.ceil(180.0 / step_y))
    latitude = -90.0 + 180.0 * (np.arange(rows) + 0.5) / rows
    # A row of fields lies between two circles of ecliptic latitude; the one nearer to the ecliptic is longer. The
    # fields must leave no gaps even there.
    widest = np.cos(np.radians(np.maximum(np.abs(latitude) - 90.0 / rows, 0.0)))
    counts = np.ceil(360.0 * widest / step_x).astype(np.int64)
    number = np.arange(counts.sum())
    row = np.repeat(np.arange(rows), counts)
    column = number - np.repeat(np.cumsum(counts) - counts, counts)
    ra, dec = equatorial(360.0 * (column + 0.5) / counts[row], latitude[row])
    depth = area.depth(ra, dec)
    if area.patches and count:
        # The area consists of circles. Divide the distance of a field from the edge of each circle by the radius of the
        # circle, so that small circles also get fields.
        depth = np.max(
            [1.0 - sky.separation(ra, dec, x, y) / max(radius, 1e-9) for x, y, radius in area.patches], axis=0
        )
    inside = np.flatnonzero(depth >= -_REACH) if not count else np.sort(np.argsort(-depth, kind="stable")[:count])
    return number[inside] + 1, ra[inside], dec[inside]


def wide(area: Area, mission: MissionConfiguration, start: float, count: int = 0, visits: int = 1) -> list[Field]:
    """Return the visits of the wide survey to an area, in order of time.

    Parameters
    ----------
    area : Area
        Area on the sky to be observed.
    mission : MissionConfiguration
        Mission database, with the lattice of fields and the Sun constraints.
    start : float
        Earliest MJD.
    count : int
        Number of fields. The fields with centres farthest inside the area are chosen. 0 means all fields that may see
        part of the area.
    visits : int
        Number of visits of each field.

    Returns
    -------
    list of Field
        Visits in order of time, then of field number.

    Notes
    -----
    BadInput is raised if the visits do not fit into 20 years.
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
    """Yield (index of the field, index of the visit, MJD) for fields at ecliptic positions `lon`, `lat` in degrees.

    A field is visited once per season (the days around a date at which it is 90 deg from the Sun). If several fields
    can be observed, the one whose season ends first is taken. Raises BadInput if the visits do not fit into 20 years.
    """
    days_before, days_after = _windows(lat, mission)
    slot = mission.value("svm.field_time", "d")
    # A field is 90 deg from the Sun twice a year, in the middle of a season. Begin with the first season of each field
    # that ends after `start`.
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
                raise BadInput(f"{len(lon)} fields with {visits} visits do not fit into {_MAX_SEASONS // 2} years")
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
    """Return for how many days around its quadrature (90 deg from the Sun) a field can be observed.

    The first array is the days before quadrature, the second the days after it. `lat` is the ecliptic latitude (deg) of
    each field. The days are limited by the angle to the Sun and by the tolerance of the position angle.
    """
    lowest, highest = (mission.value(f"svm.solar_aspect_{end}", "deg") for end in ("min", "max"))
    beta = np.radians(np.abs(lat))
    # The angle from the Sun follows from the ecliptic latitude beta: cos(angle) = cos(beta) cos(longitude from the
    # Sun). Its limits allow more days on one side of quadrature. This side changes between morning and evening seasons,
    # hence the smaller number of days is used for both sides.
    aspect = [
        np.degrees(np.arcsin(np.minimum(abs(np.cos(np.radians(limit))) / np.maximum(np.cos(beta), 1e-9), 1.0)))
        for limit in (lowest, highest)
    ]
    roll = mission.value("survey.roll_tolerance", "deg") / np.maximum(np.sin(beta), 1e-6)
    days = np.minimum(np.minimum(*aspect), roll) / _SUN_RATE
    slot = mission.value("svm.field_time", "d")
    # Near the ecliptic pole, the tolerance of the position angle lasts for less than one visit. Allow at least one
    # visit around quadrature.
    return np.maximum(days, slot), np.maximum(days, 2 * slot)


def _season(lon: float, start: float, number: int) -> float:
    """Return the MJD at which the Sun is 90 deg from the ecliptic longitude `lon` (deg).

    `number` counts these dates from MJD `start`: 0 is the first one, 1 the next one half a year later.
    """
    half_turns = 0.5 * 365.2422 * number
    remaining_angle = (lon - 90.0 - sun_longitude(start)) % 180.0
    date = start + remaining_angle / 360.0 * 365.2422 + half_turns
    for _ in range(4):
        error = (lon - 90.0 - sun_longitude(date) + 90.0) % 180.0 - 90.0
        date += error / 360.0 * 365.2422
    return float(date)


def deep(area: Area, mission: MissionConfiguration, start: float, visits: int, count: int = 0) -> list[Field]:
    """Return the visits of a deep field, which is covered by a raster of pointings around the centre of its area.

    Parameters
    ----------
    area : Area
        Area of the deep field on the sky.
    mission : MissionConfiguration
        Mission database, with the steps of the raster and the Sun constraints.
    start : float
        Earliest MJD.
    visits : int
        Number of visits of the deep field, spread evenly over the days of the mission on which it is visible.
    count : int
        Number of pointings of the raster. The pointings farthest inside the area are chosen. 0 means all pointings that
        may see part of the area.

    Returns
    -------
    list of Field
        All pointings of all visits in order of time. `Field.number` counts the pointings of a visit.

    Notes
    -----
    The raster is rotated at each visit to the position angle that the Sun requires. BadInput is raised if the field is
    visible on fewer days than it has visits.
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
    # Select the days on which the centre of the deep field is visible. Limits on the angle from the Sun are narrowed by
    # 2 deg for the pointings around the centre.
    open_days = days[(aspect >= lowest + 2.0) & (aspect <= highest - 2.0)]
    if open_days.size < visits:
        raise BadInput(f"a deep field at ecliptic latitude {lat:.1f} is visible on {open_days.size} days, not {visits}")
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


def user_field_visits(
    place: tuple[float, float], mission: MissionConfiguration, start: float, visits: int, angle: float | None = None
) -> list[Field]:
    """Return successive visits of a Euclid field at a position given by the user.

    Parameters
    ----------
    place : tuple of float
        ICRS ra and dec in degrees.
    mission : MissionConfiguration
        Mission database, with the Sun constraints and the time per visit.
    start : float
        Earliest MJD.
    visits : int
        Number of visits.
    angle : float, optional
        Position angle in degrees; None means the angle that the Sun requires at each visit.

    Returns
    -------
    list of Field
        Visits in order of time, each at the first date after the previous visit that the Sun constraints allow. All
        have field number 1.
    """
    fields: list[Field] = []
    now = start
    for visit in range(visits):
        now = next_allowed(*place, now, mission)
        visit_angle = position_angle(*place, now) if angle is None else angle
        fields.append(Field(1, visit + 1, *place, visit_angle, now))
        now += mission.value("svm.field_time", "d")
    return fields
