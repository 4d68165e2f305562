"""Ground surveys: pointings from each survey's rule, or from a user's table.

exposures    of one survey over an area
read         a table of pointings, CSV

Ref : Serrano et al. 2024, appendix on the survey files of the eighth science challenge
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np

from jobs import rng
from jobs.render.camera import detectors as camera_detectors
from jobs.render.camera import pointing
from jobs.render.camera.detectors import Detector
from jobs.render.planning.planned_exposures import Exposure, bands_of, exposure_time
from jobs.request.area import Area
from jobs.request.observations import CHANNELS, IMAGE_TYPES, Observation
from lake_schema import user_files
from lake_schema.errors import BadInput
from lake_schema.mission.configuration import MissionConfiguration

_DAY_S, _OVERHEAD_S = 86400.0, 30.0
_MOST_ROWS, _LONGEST = 1_000_000, 1000
_MOST_LINES, _LONGEST_LINE = 2 * _MOST_ROWS, 20 * _LONGEST
# Mean midnight of the sites is not modelled: ground exposures follow one another from the earliest date on.
_COLUMNS = ("channel", "camera", "band", "ra", "dec", "position_angle", "mjd")
_OPTIONAL = ("exposure_time_s", "sky", "seeing", "zero_point", "psf", "detectors", "image_type")


def camera_of(survey: str, mission: MissionConfiguration) -> str:
    """The camera of a survey."""
    return _rules(survey, mission)[0]["camera"]


def exposures(
    block: Observation, area: Area, mission: MissionConfiguration, seed: int, start: float
) -> Iterator[Exposure]:
    """The exposures of a survey over an area: as many as are asked for, else one layer.

    Bands that the survey takes together are taken at the same places.
    block   : of the request, with its survey and bands;  area : of the request
    mission : the mission database;  seed : of the request;  start : MJD
    """
    now = start
    rules = _rules(block.survey, mission)
    groups = [tuple(rule["bands"].split()) for rule in rules]
    if block.bands:
        known = [band for group in groups for band in group]
        for band in block.bands:
            if band not in known:
                raise BadInput(f"survey {block.survey} has no band {band!r} ({', '.join(known)})")
        groups = [tuple(band for band in group if band in block.bands) for group in groups]
    for rule, bands in zip(rules, groups, strict=True):
        if not bands:
            continue
        for i, (ra, dec) in enumerate(_places(rule, bands, block, area, mission, seed)):
            # Where the survey shares its exposures among bands, they take turns.
            turn = bands if rule["shared"] == "0" else (bands[i % len(bands)],)
            for band in turn:
                own = float(rule["exposure_time_s"])
                seconds = own if block.exposure_time_s is None else block.exposure_time_s
                yield Exposure(
                    channel="EXT",
                    camera=rule["camera"],
                    band=band,
                    image_type=block.image_type,
                    ra=ra,
                    dec=dec,
                    position_angle=0.0,
                    mjd=now,
                    exposure_time_s=seconds,
                    survey=block.survey,
                    field=i + 1,
                    detectors=block.detectors,
                )
                now += (seconds + _OVERHEAD_S) / _DAY_S


def _rules(survey: str, mission: MissionConfiguration) -> list[dict[str, str]]:
    return [row for row in mission.rows("survey.external") if row["survey"] == survey]


def _places(
    rule: Mapping[str, str],
    bands: tuple[str, ...],
    block: Observation,
    area: Area,
    mission: MissionConfiguration,
    seed: int,
) -> list[tuple[float, float]]:
    """Pointings of a pattern, in passes over the area, those nearest to it kept."""
    detectors = camera_detectors.detectors(rule["camera"], mission)
    x, y = pointing.outline(detectors)
    half = [0.5 * float(axis.max() - axis.min()) / 3600.0 for axis in (x, y)]
    margin = float(rule["margin_deg"])
    if rule["pattern"] == "chips":
        return _by_chips(detectors, half, block.exposures, area, margin)
    count = block.exposures
    # As large a step as the filled part of a round field allows: neighbours just touch.
    filled = 0.9
    passes = max(int(rule["passes"]), 1)
    if not count:
        return [place for k in range(passes) for place in _pass(area, half, filled, margin, k, seed, rule["survey"])]
    lo, hi = 0.02, 20.0
    for _ in range(40):
        middle = np.sqrt(lo * hi)
        found = sum(len(_pass(area, half, middle, margin, k, seed, rule["survey"])) for k in range(passes))
        lo, hi = (middle, hi) if found >= count else (lo, middle)
    places = [place for k in range(passes) for place in _pass(area, half, lo, margin, k, seed, rule["survey"])]
    depth = area.depth(*np.array(places).T)
    kept = np.sort(np.argsort(-depth, kind="stable")[:count])
    return [places[i] for i in kept]


def _pass(
    area: Area, half: list[float], step: float, margin: float, number: int, seed: int, survey: str
) -> list[tuple[float, float]]:
    """One pass: rows of declination, each row equally spaced, the whole shifted at random from pass to pass."""
    ra0, dec0, radius = area.bounds()
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
    near = area.contains(ra, dec, margin)
    return list(zip(ra[near].tolist(), dec[near].tolist(), strict=True))


def _by_chips(
    detectors: tuple[Detector, ...], half: list[float], count: int, area: Area, margin: float
) -> list[tuple[float, float]]:
    """Each pointing as often as there are detectors, shifted so that every one of them sees its centre."""
    base = _pass(area, half, 1.0, margin, 0, 0, "chips")
    wanted = int(np.ceil(count / len(detectors))) if count else len(base)
    lo, hi = 0.02, 20.0
    for _ in range(40):
        middle = np.sqrt(lo * hi)
        lo, hi = (middle, hi) if len(_pass(area, half, middle, margin, 0, 0, "chips")) >= wanted else (lo, middle)
    base = _pass(area, half, lo, margin, 0, 0, "chips") if count else base
    depth = area.depth(*np.array(base).T)
    base = [base[i] for i in np.sort(np.argsort(-depth, kind="stable")[:wanted])]
    places = []
    for ra, dec in base:
        x, y = np.array([[-d.x, -d.y] for d in detectors]).T
        lon, lat = pointing.sky_of_plane(x, y, ra, dec, 0.0)
        places += list(zip(lon.tolist(), lat.tolist(), strict=True))
    return places[:count] if count else places


# ------------------------------------------------------------------------------------------------ tables


def read(path: Path, block: Observation, mission: MissionConfiguration) -> list[Exposure]:
    """Pointings of a CSV file: columns channel, camera, band, ra, dec, position_angle, mjd, and any of exposure_time_s,
    sky (electron / (s pix)), seeing (arcsec), zero_point (mag), psf (a file beside it), detectors
    (by blanks), image_type.

    Errors : BadInput names the file, the line and the column
    """
    stream = io.StringIO(user_files.text(path, "table of pointings"), newline="")
    numbered, at = _plain_lines(path, stream), 0

    def texts() -> Iterator[str]:
        nonlocal at
        for number, line in numbered:
            at = number
            yield line

    lines = csv.DictReader(texts())
    found: list[Exposure] = []
    try:
        names = lines.fieldnames or []
        for name in _COLUMNS:
            if name not in names:
                raise BadInput(f"{path}: column {name} is missing")
        for name in names:
            if name not in (*_COLUMNS, *_OPTIONAL):
                known = ", ".join((*_COLUMNS, *_OPTIONAL))
                raise BadInput(f"{path}: column {user_files.shown(name)} is not known; known: {known}")
        for row in lines:
            if len(found) >= _MOST_ROWS:
                raise BadInput(f"{path}: more than {_MOST_ROWS} pointings")
            where = f"{path} line {at}"
            if not all(isinstance(text, str) and len(text) <= _LONGEST for text in row.values() if text is not None):
                raise BadInput(f"{where}: a text is too long, or there are more than columns")
            found.append(_of_row(row, where, len(found) + 1, block, mission, path.parent))
    except csv.Error as error:
        raise BadInput(f"{path}: {' '.join(str(error).split())}") from None
    return found


def _plain_lines(path: Path, stream: Iterable[str]) -> Iterator[tuple[int, str]]:
    """Number and text of each line that is no comment, as many and as long as pointings need."""
    for number, line in enumerate(stream, start=1):
        if number > _MOST_LINES or len(line) > _LONGEST_LINE:
            raise BadInput(f"{path}: more than {_MOST_LINES} lines, or one of more than {_LONGEST_LINE} characters")
        if not line.startswith("#"):
            yield number, line


def _of_row(
    row: Mapping[str, str], where: str, number: int, block: Observation, mission: MissionConfiguration, folder: Path
) -> Exposure:
    channel, camera, band = (str(row[name]) for name in ("channel", "camera", "band"))
    if channel not in CHANNELS:
        raise BadInput(f"{where}: channel = {channel!r} is not one of {', '.join(CHANNELS)}")
    try:
        bands = bands_of(channel, camera, mission)
    except BadInput as error:
        raise BadInput(f"{where}: {error}") from None
    if band not in bands:
        raise BadInput(f"{where}: camera {camera} has no band {band!r}")
    image_type = row.get("image_type") or block.image_type
    if image_type not in IMAGE_TYPES:
        raise BadInput(f"{where}: image_type = {image_type!r} is not one of {', '.join(IMAGE_TYPES)}")

    def number_of(name: str, lo: float, hi: float) -> float:
        try:
            value = float(row[name])
        except (ValueError, TypeError):
            raise BadInput(f"{where}: {name} = {row[name]!r} is not a number") from None
        if not lo <= value <= hi:
            raise BadInput(f"{where}: {name} = {value} is outside {lo:g} to {hi:g}")
        return value

    def optional(name: str, lo: float, hi: float) -> float | None:
        return number_of(name, lo, hi) if row.get(name) else None

    seconds = optional("exposure_time_s", 0.0, 1e6)
    if seconds is None:
        seconds = block.exposure_time_s
    return Exposure(
        channel=channel,
        camera=camera,
        band=band,
        image_type=image_type,
        ra=number_of("ra", -360.0, 360.0) % 360.0,
        dec=number_of("dec", -90.0, 90.0),
        position_angle=number_of("position_angle", -360.0, 360.0),
        mjd=number_of("mjd", 40_000.0, 100_000.0),
        exposure_time_s=exposure_time(channel, camera, band, mission) if seconds is None else seconds,
        survey=block.survey,
        field=number,
        sky=optional("sky", 0.0, 1e6),
        seeing=optional("seeing", 0.01, 10.0) if channel == "EXT" else None,
        zero_point=optional("zero_point", 0.0, 50.0),
        psf=str(user_files.expanded(row["psf"], folder)) if row.get("psf") else None,
        detectors=tuple((row.get("detectors") or "").split()) or block.detectors,
    )
