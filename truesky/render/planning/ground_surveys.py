"""Plan the exposures of ground surveys.

The pointings follow the pattern of the survey, or a user's CSV table of pointings. The table may also list exposures of
Euclid cameras.

References
----------
Serrano et al. 2024, appendix on the survey files of the eighth science challenge
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from lake_schema.errors import BadInput, Mistakes
from lake_schema.mission.configuration import MissionConfiguration
from truesky.fluxes import passbands
from truesky.randomness import rng
from truesky.render.camera import detectors as camera_detectors
from truesky.render.camera import pointing
from truesky.render.camera.detectors import Detector
from truesky.render.channels import image_types, registry
from truesky.render.planning import calibration_frames
from truesky.render.planning.planned_exposures import (
    Exposure,
    bands_of,
    exposure_time,
    through_grism,
    zero_point_of,
)
from truesky.render.sky import diffuse_light, opsim, twilight
from truesky.render.sky.observatory import LOWEST_ALTITUDE, Site, next_dark_time, next_dark_transit, sun_direction
from truesky.render.sky.solar_aspect import next_allowed, position_angle
from truesky.request.area import Area
from truesky.request.exposures import pointing_tables, visit_tables
from truesky.request.exposures.observations import Observation
from truesky.request.exposures.pointing_tables import Row, Visit
from truesky.request.instruments import check_band

# Number of mistakes in a table of pointings after which the rest of its rows are not read.
_MAX_MISTAKES = 20
_DAY_S = 86400.0
# Seconds from the end of an exposure to the start of the next one.
_OVERHEAD_S = 30.0
# Pivot wavelength (angstrom) below which exposures without a date are taken with the Moon below the horizon.
_BLUE = 5500.0
# Largest illuminated fraction of the Moon for exposures without a date in redder bands, while the Moon is up.
_FAINT_MOON = 0.4


def camera_of(survey: str, mission: MissionConfiguration) -> str:
    """Return the name of the camera of a ground survey; raises IndexError if the mission database lacks the survey."""
    return _rules(survey, mission)[0]["camera"]


def exposures(
    block: Observation, area: Area, mission: MissionConfiguration, seed: int, start: float
) -> Iterator[Exposure]:
    """Generate the exposures of a ground survey over an area or at a position given by the user.

    Parameters
    ----------
    block : Observation
        Observation block of the request, with its survey and bands.
    area : Area
        Area on the sky to be observed, unless the block gives the position of a single field.
    mission : MissionConfiguration
        Mission database, with the rules of the survey: bands, pattern of pointings and exposure times.
    seed : int
        Seed of the request, used for pointing errors and the shift of the pattern.
    start : float
        MJD of the first exposure, or the earliest possible MJD if the block has no date.

    Yields
    ------
    Exposure
        One exposure per pointing and band, or one per pointing if its bands take turns. If the block sets a number of
        exposures, each group of bands that share pointings has that many pointings. Otherwise the pattern covers the
        area as often as the survey defines.

    Notes
    -----
    Bands that the survey observes together share their pointings. Some surveys use these bands in turn, one per
    pointing. The exposures follow one another from `start`. If the block has no date, each exposure waits until its
    field is next high in a dark night (`max_moon`). The pointings have random errors, with the standard deviation that
    the mission database has for the camera.
    """
    now = start
    rules = _rules(block.survey, mission)
    groups = [tuple(rule["bands"].split()) for rule in rules]
    if block.bands:
        groups = [tuple(band for band in group if band in block.bands) for group in groups]
    for rule, bands in zip(rules, groups, strict=True):
        if not bands:
            continue
        section = image_types.section(rule["camera"])
        site, error = Site.from_mission(section, mission), mission.value(f"{section}.pointing_error", "arcsec")
        places = (
            _pattern_pointings(rule, block, area, mission, seed)
            if block.field_centre is None
            else _user_field_pointings(block)
        )
        for i, (ra, dec) in enumerate(places):
            # Either every pointing is observed in all bands, or the bands take turns from pointing to pointing.
            all_bands = rule["shared"] == "0" or (block.field_centre is not None and not block.exposures)
            selected_bands = bands if all_bands else (bands[i % len(bands)],)
            for band in selected_bands:
                seconds = _seconds(rule, band, mission) if block.exposure_time_s is None else block.exposure_time_s
                now = next_dark_time(ra, dec, now, site, max_moon(band)) if block.mjd is None else now
                actual = _with_pointing_error((ra, dec), error, rng.stream(seed, "pointing", block.survey, band, i))
                yield Exposure(
                    channel="EXT",
                    camera=rule["camera"],
                    band=band,
                    image_type=block.image_type,
                    ra=actual[0],
                    dec=actual[1],
                    position_angle=block.position_angle or 0.0,
                    mjd=now,
                    exposure_time_s=seconds,
                    survey=block.survey,
                    field=i + 1,
                    detectors=block.detectors,
                    clouds=block.clouds,
                )
                now += (seconds + _OVERHEAD_S) / _DAY_S


def _seconds(rule: Mapping[str, str], band: str, mission: MissionConfiguration) -> float:
    """Return the exposure time in a band, in seconds.

    It is the camera's value for the band if the mission database has one, otherwise the value of the survey.
    """
    key = f"{image_types.section(rule['camera'])}.{band}.exposure_time"
    return mission.value(key, "s") if key in mission else float(rule["exposure_time_s"])


def _with_pointing_error(place: tuple[float, float], error: float, rng: np.random.Generator) -> tuple[float, float]:
    """Return ra and dec (deg) displaced by a random Gaussian error of `error` arcsec rms along each coordinate.

    `place` is (ra, dec) in degrees.
    """
    if error == 0.0:
        return place
    east, north = error * rng.standard_normal(2)
    ra, dec = pointing.sky_of_plane(np.array([-east]), np.array([north]), *place, 0.0)
    return float(ra[0]), float(dec[0])


def _rules(survey: str, mission: MissionConfiguration) -> list[Mapping[str, str]]:
    return [row for row in mission.rows("survey.external") if row["survey"] == survey]


def _pattern_pointings(
    rule: Mapping[str, str], block: Observation, area: Area, mission: MissionConfiguration, seed: int
) -> list[tuple[float, float]]:
    """Return the pointings (ra, dec in degrees) of the survey's pattern over the area.

    If the request sets a number of exposures, the pattern is made so dense that it has at least that many pointings.
    The pointings farthest inside the area are then returned.
    """
    detectors = camera_detectors.detectors(rule["camera"], mission)
    x, y = pointing.outline(detectors)
    half = [0.5 * float(axis.max() - axis.min()) / 3600.0 for axis in (x, y)]
    margin = float(rule["margin_deg"])
    if rule["pattern"] == "chips":
        return _chip_pointings(detectors, half, block.exposures, area, margin)
    count = block.exposures
    # Distance between neighbouring pointings as a fraction of the side of the field of view, unless the user sets the
    # number of pointings.
    filled = 0.9
    passes = max(int(rule["passes"]), 1)
    if not count:
        return [
            place for k in range(passes) for place in _pattern_pass(area, half, filled, margin, k, seed, rule["survey"])
        ]
    lo, hi = 0.02, 20.0
    for _ in range(40):
        middle = np.sqrt(lo * hi)
        n_pointings = sum(
            len(_pattern_pass(area, half, middle, margin, k, seed, rule["survey"])) for k in range(passes)
        )
        lo, hi = (middle, hi) if n_pointings >= count else (lo, middle)
    places = [place for k in range(passes) for place in _pattern_pass(area, half, lo, margin, k, seed, rule["survey"])]
    depth = area.depth(*np.array(places).T)
    deepest = np.sort(np.argsort(-depth, kind="stable")[:count])
    return [places[i] for i in deepest]


def _user_field_pointings(block: Observation) -> list[tuple[float, float]]:
    """Return the dithered pointings (ra, dec in degrees) around the field position that the user gives.

    If the request sets a number of exposures, the dithers are repeated in turn until that number is reached.
    """
    assert block.field_centre is not None
    steps = np.zeros((1, 2)) if isinstance(block.dither, str) else np.array(block.dither)
    ra, dec = pointing.sky_of_plane(steps[:, 0], steps[:, 1], *block.field_centre, block.position_angle or 0.0)
    count = block.exposures or len(steps)
    return [(float(ra[i % len(steps)]), float(dec[i % len(steps)])) for i in range(count)]


def _pattern_pass(
    area: Area, half: list[float], step: float, margin: float, number: int, seed: int, survey: str
) -> list[tuple[float, float]]:
    """Return the pointings (ra, dec in degrees) of one coverage of the area by the survey's pattern.

    The pattern has equally spaced rows of constant declination. `number` counts the coverages: each has its own random
    shift of the pattern, drawn with `seed` and `survey`. `half` is half the field of view along x and y (deg), and
    `step` is the distance of neighbouring pointings as a fraction of the field of view. Pointings up to `margin` (deg)
    outside the area are included.
    """
    ra0, dec0, radius = area.bounding_circle()
    reach = radius + margin
    step_x, step_y = 2 * half[0] * step, 2 * half[1] * step
    shift = rng.stream(seed, "pattern", survey, number).random(2)
    rows = dec0 + (np.arange(np.floor(-reach / step_y) - 1, np.ceil(reach / step_y) + 1) + shift[1]) * step_y
    lon, lat = [], []
    for dec in rows[np.abs(rows) < 90.0]:
        width = step_x / max(np.cos(np.radians(dec)), 1e-3)
        across = min(reach / max(np.cos(np.radians(min(abs(dec), 89.0))), 1e-3), 180.0)
        row = ra0 + (np.arange(np.floor(-across / width), np.ceil(across / width) + 1) + shift[0]) * width
        row = row[: int(np.ceil(360.0 / width))]
        lon.append(row % 360.0)
        lat.append(np.full(row.size, dec))
    if not lon:
        return []
    ra, dec = np.concatenate(lon), np.concatenate(lat)
    in_area = area.contains(ra, dec, margin)
    return list(zip(ra[in_area].tolist(), dec[in_area].tolist(), strict=True))


def _chip_pointings(
    detectors: tuple[Detector, ...], half: list[float], count: int, area: Area, margin: float
) -> list[tuple[float, float]]:
    """Return pointings (ra, dec in degrees) that place the same positions of the sky on every detector in turn.

    The positions form a grid over the area. `count` is the number of pointings; 0 means that all positions are used.
    `half` is half the field of view along x and y (deg). Positions up to `margin` (deg) outside the area are included.
    """
    centres = _pattern_pass(area, half, 1.0, margin, 0, 0, "chips")
    n_centres = int(np.ceil(count / len(detectors))) if count else len(centres)
    lo, hi = 0.02, 20.0
    for _ in range(40):
        middle = np.sqrt(lo * hi)
        lo, hi = (
            (middle, hi) if len(_pattern_pass(area, half, middle, margin, 0, 0, "chips")) >= n_centres else (lo, middle)
        )
    centres = _pattern_pass(area, half, lo, margin, 0, 0, "chips") if count else centres
    depth = area.depth(*np.array(centres).T)
    centres = [centres[i] for i in np.sort(np.argsort(-depth, kind="stable")[:n_centres])]
    places = []
    for ra, dec in centres:
        x, y = np.array([[-d.x, -d.y] for d in detectors]).T
        lon, lat = pointing.sky_of_plane(x, y, ra, dec, 0.0)
        places += list(zip(lon.tolist(), lat.tolist(), strict=True))
    return places[:count] if count else places


def date_warnings(exposures: Iterable[Exposure], mission: MissionConfiguration) -> Iterator[str]:
    """Yield lines that warn of ground exposures of the sky whose dates are not possible.

    There is one line for exposures in daylight, one for those below the horizon or lower than an airmass of 3, and one
    for those before first light of their camera. A line has the number of these exposures, and an example.
    """
    count = 0
    problems: dict[str, list[tuple[float, str]]] = {"Sun": [], "low": [], "early": []}
    sites: dict[str, Site] = {}
    for exposure in exposures:
        channel = registry.CHANNELS[exposure.channel]
        if not (channel.on_ground and channel.sees_sky(exposure.image_type)):
            continue
        count += 1
        if exposure.camera not in sites:
            sites[exposure.camera] = Site.from_mission(image_types.section(exposure.camera), mission)
        site, place = sites[exposure.camera], f"{exposure.camera} on MJD {exposure.mjd:.3f}"
        sun, _ = sun_direction(exposure.mjd, site)
        if sun > twilight.LIMITS[1]:
            problems["Sun"].append((sun, f"{place}, the Sun at {sun:+.0f} deg"))
        altitude = float(site.altitude(exposure.ra, exposure.dec, exposure.mjd))
        if altitude < LOWEST_ALTITUDE:
            problems["low"].append((-altitude, f"{place}, the field at {altitude:+.0f} deg"))
        key = f"{image_types.section(exposure.camera)}.first_light"
        if key in mission and exposure.mjd < mission.value(key, "d"):
            light = mission.value(key, "d")
            problems["early"].append((light - exposure.mjd, f"{place}, first light on MJD {light:g}"))
    texts = {
        "Sun": (f"when the Sun is above {twilight.LIMITS[1]:g} deg", "sunlight is not simulated"),
        "low": (
            f"when the field is lower than {LOWEST_ALTITUDE:.0f} deg",
            "it is simulated on the meridian, at an airmass of at most 3",
        ),
        "early": ("before first light of the camera", "the camera was not on its telescope"),
    }
    for name, examples in problems.items():
        if examples:
            when, consequence = texts[name]
            summary = f"{len(examples)} of {count} exposures of the sky have dates {when} ({max(examples)[1]})"
            yield f"EXT: {summary}: {consequence}; omit the date to observe in a dark night"


def read(path: Path, block: Observation, mission: MissionConfiguration) -> list[Exposure]:
    """Read the exposures of a user's table of pointings or of visits.

    Parameters
    ----------
    path : Path
        CSV table of pointings (`truesky.request.exposures.pointing_tables`), of ground or Euclid cameras; or table of
        visits of the Rubin Observatory's scheduler (`visit_tables`), for the camera of the observation's survey.
    block : Observation
        Observation block of the request that names the table; gives the values that a row leaves empty.
    mission : MissionConfiguration
        Mission database; gives the values that neither the row nor the block has.

    Returns
    -------
    list of Exposure
        One exposure per row of a table of pointings, and one or more per visit.

    Raises
    ------
    BadInput
        If a row is invalid, for example if its camera lacks the band, or if a visit is before first light of the
        camera, in daylight or below the horizon. The message names the file and the line.

    Notes
    -----
    Without a date, a Euclid exposure begins when the Sun constraints allow it, and a ground exposure when its field
    next crosses the meridian at night.
    """
    if visit_tables.is_table_of_visits(path):
        bands = bands_of("EXT", camera_of(block.survey, mission), mission)
        rows = visit_tables.read(path, bands, block.image_type)
    else:
        rows = pointing_tables.read(path, block.channels, block.image_type)
    with Mistakes() as mistakes:
        exposures_of_rows: list[Exposure] = []
        for number, row in enumerate(rows, start=1):
            if row.visit is None:
                exposures_of_rows.append(mistakes.read(_exposure_of_row, row, number, block, mission))
            else:
                exposures_of_rows += mistakes.read(_exposures_of_visit, row, row.visit, number, block, mission) or ()
            if len(mistakes) >= _MAX_MISTAKES:
                break
    return exposures_of_rows


def earliest_date(camera: str, mission: MissionConfiguration) -> float:
    """Return the earliest MJD of exposures without a date: the launch of Euclid, or first light if that is later.

    `camera` is a ground camera, or "vis" or "nisp". A camera without first light in the mission database existed before
    the launch.
    """
    launch, key = mission.value("svm.launch", "d"), f"{image_types.section(camera)}.first_light"
    return max(launch, mission.value(key, "d")) if key in mission else launch


def max_moon(band: str) -> float:
    """Return the illuminated fraction of the brightest Moon under which exposures without a date are taken.

    The result is 0 (Moon below the horizon) in bands bluer than 5500 angstrom, such as u and g, and in bands with a
    curve of the user. It is 0.4 in other bands.
    """
    is_red = band in passbands.names() and passbands.pivot_wavelength(passbands.load(band)) >= _BLUE
    return _FAINT_MOON if is_red else 0.0


def first_date(
    instrument: tuple[str, str], band: str, place: tuple[float, float], mission: MissionConfiguration
) -> float:
    """Return the first date at which a camera can observe a position well.

    Parameters
    ----------
    instrument : (str, str)
        Names of the channel and of the camera.
    band : str
        Name of the passband, on which the allowed Moon depends.
    place : (float, float)
        Right ascension and declination in degrees.
    mission : MissionConfiguration
        Mission database, with the launch of Euclid and the first light of the camera.

    Returns
    -------
    float
        MJD, after the launch and after first light of the camera. Euclid observes when the Sun allows the position. A
        ground camera observes when the position crosses the meridian, where the airmass is smallest, in a dark night.

    Raises
    ------
    BadInput
        If the Sun allows the position at no date.
    """
    channel, camera = instrument
    earliest = earliest_date(camera, mission)
    if not registry.CHANNELS[channel].on_ground:
        return next_allowed(*place, earliest, mission)
    site = Site.from_mission(image_types.section(camera), mission)
    return next_dark_transit(*place, earliest, site, max_moon(band))


def _exposures_of_visit(
    row: Row, visit: Visit, number: int, block: Observation, mission: MissionConfiguration
) -> list[Exposure]:
    """Return the exposures of a visit, one after the other.

    The table gives sky and seeing. `number` is the number of the visit in the table, from 1.
    """
    camera, mjd, seconds = camera_of(block.survey, mission), row.mjd or 0.0, row.exposure_time_s or 0.0
    section = image_types.section(camera)
    site = Site.from_mission(section, mission)
    wavelength = passbands.pivot_wavelength(passbands.load(row.band))
    try:
        _check_visit(row, camera, site, mission)
        parallactic = site.zenith(row.ra, row.dec, mjd) if visit.parallactic is None else visit.parallactic
        altitude = float(site.altitude(row.ra, row.dec, mjd))
        angle = opsim.position_angle((visit.rot_sky, visit.rot_tel), parallactic, altitude, section, mission)
        seeing = opsim.zenith_seeing(visit.seeing_eff, visit.airmass, wavelength, opsim.WIDTH_RATIO)
    except BadInput as error:
        raise error.with_prefix(row.location) from None
    zero_point = zero_point_of(section, row.band, mission)
    detector = _first_detector(camera, mission)
    exposure = Exposure(
        channel=row.channel,
        camera=camera,
        band=row.band,
        image_type=row.image_type,
        ra=row.ra,
        dec=row.dec,
        position_angle=angle,
        mjd=mjd,
        exposure_time_s=seconds,
        survey=block.survey,
        field=number,
        sky=diffuse_light.rate_of_brightness(visit.sky_brightness, detector, row.band, zero_point, mission),
        seeing=seeing,
        detectors=block.detectors,
        clouds=block.clouds,
    )
    step = (seconds + visit.overhead_s) / _DAY_S
    return [
        replace(exposure, mjd=mjd + i * step, dither=i + 1 if visit.exposures > 1 else None)
        for i in range(visit.exposures)
    ]


@lru_cache(maxsize=8)
def _first_detector(camera: str, mission: MissionConfiguration) -> Detector:
    # To read the layout of a camera takes milliseconds, and a table may have a million visits.
    return camera_detectors.detectors(camera, mission)[0]


def _check_visit(row: Row, camera: str, site: Site, mission: MissionConfiguration) -> None:
    """Raise BadInput if a visit is before first light of the camera, in daylight, or too low for the simulation."""
    key, mjd = f"{image_types.section(camera)}.first_light", row.mjd or 0.0
    if key in mission and mjd < mission.value(key, "d"):
        light = mission.value(key, "d")
        raise BadInput(f"MJD {mjd:.3f} is before first light of {camera} on MJD {light:g} (mission parameter {key})")
    sun, _ = sun_direction(mjd, site)
    if sun > twilight.LIMITS[1]:
        raise BadInput(f"on MJD {mjd:.3f} the Sun is at {sun:+.1f} deg, but must be below {twilight.LIMITS[1]:g} deg")
    altitude = float(site.altitude(row.ra, row.dec, mjd))
    if altitude < LOWEST_ALTITUDE:
        below = "below the horizon" if altitude < 0.0 else f"lower than {LOWEST_ALTITUDE:.1f} deg"
        raise BadInput(f"on MJD {mjd:.3f} the field has an altitude of {altitude:.1f} deg, {below}")


def _exposure_of_row(row: Row, number: int, block: Observation, mission: MissionConfiguration) -> Exposure:
    camera = row.camera or camera_of(block.survey, mission)
    try:
        bands = bands_of(row.channel, camera, mission)
    except BadInput as error:
        raise error.with_prefix(f"{row.location}: camera") from None
    check_band(row.band, bands, f"camera {camera}", row.location)
    mjd, angle = row.mjd if row.mjd is not None else block.mjd, row.position_angle
    is_euclid = row.channel != "EXT"
    if mjd is None:
        mjd = first_date((row.channel, camera), row.band, (row.ra, row.dec), mission)
    if angle is None:
        angle = position_angle(row.ra, row.dec, mjd) if is_euclid else 0.0
    seconds = block.exposure_time_s if row.exposure_time_s is None else row.exposure_time_s
    exposure = Exposure(
        channel=row.channel,
        camera=camera,
        band=row.band,
        image_type=row.image_type,
        ra=row.ra,
        dec=row.dec,
        position_angle=angle,
        mjd=mjd,
        exposure_time_s=exposure_time(row.channel, camera, row.band, mission) if seconds is None else seconds,
        survey=block.survey,
        field=number,
        target=calibration_frames.TARGETS.get(row.image_type, (None,))[0],
        sky=row.sky,
        seeing=row.seeing,
        zero_point=row.zero_point,
        clouds=block.clouds if row.clouds is None else row.clouds,
        psf=row.psf,
        detectors=row.detectors or block.detectors,
    )
    return through_grism(exposure, row.grism_angle, mission, f"{row.location}: grism_angle")
