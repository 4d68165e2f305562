"""What a request wants observed: single pointings, and blocks of exposures that the planner lays out.

Pointing, pointings            the list `pointing`
Observation, observations      the list `observation`
"""

from __future__ import annotations

from dataclasses import dataclass

from jobs.request import area as areas
from jobs.request.area import Area
from jobs.request.toml_values import (
    Toml,
    boolean,
    has,
    integer,
    number,
    optional,
    section,
    string,
    strings,
    table_of,
    tables,
)
from lake_schema.errors import BadInput
from lake_schema.store import layout
from lake_schema.tables import exposures as declared

_MOST_POINTINGS, _MOST_OBSERVATIONS, _MOST_REALISATIONS = 100_000, 1000, 10_000
CHANNELS = tuple(code for code, _ in declared.CHANNELS)
IMAGE_TYPES = tuple(code for code, _ in declared.IMAGE_TYPES)
DITHERS = ("S", "J", "none")
EUCLID_SURVEYS = ("wide", "deep", "edf_north", "edf_south", "edf_fornax")
GROUND_SURVEYS = ("des", "lsst", "cfis", "jedis", "ps1", "wishes")
# What each channel can be asked for besides the sky. Not derived from what is rendered: more than that can be planned
# (test_checks.py: all that is rendered is in it).
_CALIBRATIONS = {
    "VIS": ("bias", "dark", "flat", "charge_injection", "self_calibration"),
    "NISP-P": ("dark", "flat", "self_calibration", "standard_star"),
    "NISP-S": ("dark", "flat", "standard_star", "planetary_nebula"),
    "EXT": ("bias", "dark", "flat"),
}
_SKY_TYPES = ("science", "deep")


@dataclass(frozen=True, slots=True)
class Pointing:
    """One exposure that is asked for.

    ra, dec         : deg, of the boresight, or of the centre of detector `centre_on` where that is given
    position_angle  : deg, of the focal plane's y axis, north through east
    detectors       : names, () = all of the camera
    exposure_time_s : None = the mission's
    realisations    : how many exposures, which differ in their noise alone
    """

    channel: str
    camera: str
    band: str
    ra: float
    dec: float
    position_angle: float
    mjd: float
    detectors: tuple[str, ...] = ()
    centre_on: str | None = None
    exposure_time_s: float | None = None
    realisations: int = 1


@dataclass(frozen=True, slots=True)
class Observation:
    """A block of exposures that the planner lays out.

    survey    : whose pattern;  pointings : a table of pointings (path) instead
    area      : where, None = the request's
    fields    : how many fields at most, those deepest in the area, 0 = all
    visits    : how often each field is observed, 0 = the survey's
    exposures : of a ground survey, in all bands together of which the positions are its own; of calibrations, frames
    dither    : pattern within a field;  short, flat : with the short VIS exposure, the closing flat
    blue      : with the blue grism besides the red ones
    mjd       : the earliest date, None = the mission's launch
    realisations : how many of each exposure, which differ in their noise alone
    """

    channels: tuple[str, ...]
    image_type: str = "science"
    survey: str = "wide"
    pointings: str = ""
    area: Area | None = None
    fields: int = 0
    visits: int = 0
    exposures: int = 0
    dither: str = "S"
    short: bool = True
    flat: bool = True
    blue: bool = False
    bands: tuple[str, ...] = ()
    detectors: tuple[str, ...] = ()
    mjd: float | None = None
    exposure_time_s: float | None = None
    realisations: int = 1


def pointings(table: Toml) -> tuple[Pointing, ...]:
    """Of a request's table.  BadInput names the key."""
    found = tables(table, "pointing", _MOST_POINTINGS)
    return tuple(_pointing(value, f"pointing[{i}]") for i, value in enumerate(found))


def _pointing(value: object, path: str) -> Pointing:
    table = table_of(value, path, set(Pointing.__slots__))
    channel = string(table, f"{path}.channel", CHANNELS)
    return Pointing(
        channel=channel,
        camera=layout.name(string(table, f"{path}.camera", default=channel.lower().partition("-")[0])),
        band=layout.name(string(table, f"{path}.band")),
        ra=number(table, f"{path}.ra", -360.0, 360.0) % 360.0,
        dec=number(table, f"{path}.dec", -90.0, 90.0),
        position_angle=number(table, f"{path}.position_angle", -360.0, 360.0, 0.0),
        mjd=number(table, f"{path}.mjd", 40_000.0, 100_000.0),
        detectors=strings(table, f"{path}.detectors"),
        centre_on=string(table, f"{path}.centre_on") if "centre_on" in table else None,
        exposure_time_s=optional(table, f"{path}.exposure_time_s", 0.0, 1e6),
        realisations=integer(table, f"{path}.realisations", 1, _MOST_REALISATIONS, 1),
    )


def observations(table: Toml) -> tuple[Observation, ...]:
    """Of a request's table.  BadInput names the key."""
    found = tables(table, "observation", _MOST_OBSERVATIONS)
    return tuple(_observation(value, f"observation[{i}]") for i, value in enumerate(found))


def _observation(value: object, path: str) -> Observation:
    table = table_of(value, path, set(Observation.__slots__))
    channels = strings(table, f"{path}.channels", CHANNELS)
    if not channels:
        raise BadInput(f"{path}.channels is missing or empty")
    ground = "EXT" in channels
    if ground and len(channels) > 1:
        raise BadInput(f"{path}.channels: EXT stands alone")
    image_type = string(table, f"{path}.image_type", IMAGE_TYPES, "science")
    if image_type not in _SKY_TYPES:
        for channel in channels:
            if image_type not in _CALIBRATIONS[channel]:
                legal = ", ".join((*_SKY_TYPES, *_CALIBRATIONS[channel]))
                raise BadInput(f"{path}.image_type = {image_type!r} is none of {channel}'s: {legal}")
    surveys = GROUND_SURVEYS if ground else EUCLID_SURVEYS
    own = has(table, f"{path}.area")
    return Observation(
        channels=channels,
        image_type=image_type,
        survey=string(table, f"{path}.survey", surveys, None if ground else "wide"),
        pointings=string(table, f"{path}.pointings", default=""),
        area=areas.parse(section(table, "area", None), f"{path}.area") if own else None,
        fields=integer(table, f"{path}.fields", 1, 1_000_000, 0),
        visits=integer(table, f"{path}.visits", 1, 1000, 0),
        exposures=integer(table, f"{path}.exposures", 1, 1_000_000, 0),
        dither=string(table, f"{path}.dither", DITHERS, "S"),
        short=boolean(table, f"{path}.short", True),
        flat=boolean(table, f"{path}.flat", True),
        blue=boolean(table, f"{path}.blue", False),
        bands=tuple(layout.name(band) for band in strings(table, f"{path}.bands")),
        detectors=strings(table, f"{path}.detectors"),
        mjd=optional(table, f"{path}.mjd", 40_000.0, 100_000.0),
        exposure_time_s=optional(table, f"{path}.exposure_time_s", 0.0, 1e6),
        realisations=integer(table, f"{path}.realisations", 1, _MOST_REALISATIONS, 1),
    )
