"""Read the observations of a request (a user's TOML file): blocks of exposures, which the planner schedules."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lake_schema import ramps
from lake_schema.errors import BadInput, Mistakes
from lake_schema.texts import spelling
from truesky.request import area as areas
from truesky.request import instruments, sky_notation
from truesky.request.area import Area
from truesky.request.exposures import named_tables
from truesky.request.exposures.pointing_tables import CHANNELS, CLOUDS_LIMITS, IMAGE_TYPES, Contents
from truesky.request.exposures.pointings import MAX_REALISATIONS
from truesky.request.toml_values import (
    Toml,
    as_table,
    boolean,
    check_keys,
    checked_integer,
    checked_number,
    integer,
    optional_number,
    quote_value,
    section,
    string,
    strings,
    table_list,
)

if TYPE_CHECKING:
    from lake_schema.mission.configuration import MissionConfiguration

# Largest numbers of observation blocks in a request, and of values in a list with one value per calibration frame.
_MAX_OBSERVATIONS, _MAX_VALUES = 1000, 1000
# Largest number of dither offsets that a user may give, and largest offset along each axis (arcsec).
_MAX_DITHERS, _MAX_OFFSET = 1000, 36_000.0
DITHERS = ("S", "J", "none")
EUCLID_SURVEYS = ("wide", "deep", "edf_north", "edf_south", "edf_fornax")
GROUND_SURVEYS = ("des", "lsst", "cfis", "jedis", "ps1", "wishes", "whigs")
# Types of calibration images that can be planned for each channel. Some of them cannot be rendered. test_checks.py
# checks that all types that can be rendered are listed.
_CALIBRATIONS = {
    "VIS": (
        "bias", "dark", "flat", "charge_injection", "trap_pumping", "self_calibration", "defocus", "bleeding",
        "stray_light", "white_dwarf",
    ),
    "NISP-P": ("dark", "flat", "persistence", "self_calibration", "standard_star"),
    "NISP-S": ("dark", "flat", "persistence", "standard_star", "planetary_nebula"),
    "EXT": ("bias", "dark", "flat"),
}  # fmt: skip
_SKY_TYPES = ("science", "deep")
# Kinds of observation, with the words by which error messages name them. They decide which keys are allowed.
_SURVEY, _USER_FIELD = "fields of a Euclid survey", "a Euclid field at ra, dec"
_GROUND, _GROUND_USER_FIELD = "a ground survey's pattern", "a ground camera's field at ra, dec"
_TIMED, _UNTIMED = "dark and flat frames", "bias, charge_injection and trap_pumping frames"
_DITHERED, _TABLE = "calibrations on the sky", "a table of pointings"
_CALIBRATION = (_TIMED, _UNTIMED, _DITHERED)
# Kinds of observation for which a key is allowed. A key that is not listed is allowed for all kinds. `survey` is also
# allowed for all ground observations (EXT), since it selects the camera.
_BLOCKS_OF_KEY = {
    "survey": (_SURVEY, _TABLE),
    "area": (_SURVEY, _GROUND, *_CALIBRATION),
    "fields": (_SURVEY,),
    "visits": (_SURVEY, _USER_FIELD),
    "exposures": (_GROUND, _GROUND_USER_FIELD, *_CALIBRATION),
    "dither": (_SURVEY, _USER_FIELD, _GROUND_USER_FIELD),
    "short": (_SURVEY, _USER_FIELD),
    "flat": (_SURVEY, _USER_FIELD),
    "blue": (_SURVEY, _USER_FIELD),
    "bands": (_SURVEY, _USER_FIELD, _GROUND, _GROUND_USER_FIELD, *_CALIBRATION),
    "lamps": (_TIMED,),
    "phase_times_s": (_UNTIMED,),
    "defocus_nm": (_DITHERED,),
    "magnitude": (_DITHERED,),
    "distance_deg": (_DITHERED,),
    "intensities": (_TIMED,),
    "delays_s": (_TIMED,),
    "bright": (_TIMED,),
    "macc": (_SURVEY, _USER_FIELD, _TIMED, _DITHERED, _TABLE),
    "exposure_time_s": (_GROUND, _GROUND_USER_FIELD, _TIMED, _DITHERED, _TABLE),
    "clouds": (_GROUND, _GROUND_USER_FIELD, _TABLE),
}
# Channels that use a key. A key that is not listed is used by all channels.
_CHANNELS_OF_KEY = {
    "short": ("VIS",), "flat": ("VIS",), "blue": ("NISP-S",), "macc": ("NISP-P", "NISP-S"), "clouds": ("EXT",),
}  # fmt: skip
# Image types that use a key. A key that is not listed is used by all image types.
_TYPES_OF_KEY = {
    "lamps": ("flat", "persistence"),
    "intensities": ("flat", "persistence"),
    "delays_s": ("persistence",),
    "bright": ("persistence",),
    "phase_times_s": ("trap_pumping",),
    "defocus_nm": ("defocus",),
    "magnitude": ("bleeding", "white_dwarf", "stray_light"),
    "distance_deg": ("stray_light",),
}
# Where keys belong that an observation does not have.
_PLACES = dict.fromkeys(("camera", "centre_on", "grism_angle"), "[[pointing]]")
# Light of the bright exposure that precedes the dark frames in which persistence is measured.
BRIGHT_TYPES = ("flat", "sky")
# Number of LEDs of the calibration unit of each channel. This copies the renderer's lamps, because requests must not
# import the renderer; test_infrared.py compares the two.
LAMPS = {"VIS": 6, "NISP-P": 5, "NISP-S": 5}


@dataclass(frozen=True, slots=True)
class Observation:
    """A block of exposures that the planner schedules.

    "The mission's value" of a field is the value in the mission database.

    Attributes
    ----------
    channels : tuple of str
        Channels that observe: VIS, NISP-P and NISP-S in any combination, or EXT (ground cameras) alone.
    image_type : str
        Image type of the exposures, such as "science" or "flat".
    survey : str
        Survey whose pattern of fields and exposures is used. For EXT it also selects the camera.
    pointings : str
        Path of a table of pointings (a CSV file with one exposure per line), or "" for none.
    table : Contents, optional
        Summary of the table of pointings; None without such a table.
    ra, dec : float, optional
        Centre of a user's field in degrees; None for the fields of the survey.
    position_angle : float, optional
        Position angle in degrees of the focal plane's y axis at ra, dec. None for
        the angle set by the direction of the Sun (Euclid) or 0 (ground cameras).
    area : Area, optional
        Area to observe; None for the area of the request, or for that of the Euclid Deep Field if `survey` is one.
    fields : int
        Largest number of fields; fields farthest from the edge of the area are used first. 0 for all fields.
    visits : int
        Visits of each field; 0 for the number in the survey.
    exposures : int
        Number of exposures. A ground survey that shares positions among bands counts those of all bands together.
        For calibrations, the number of frames or of dithers, at each level, phase time or defocus, and for flats also
        of each lamp in each band that sees it. 0 for the default;
        bias, dark, flat and charge_injection frames have none, so that 0 is refused.
    dither : str or tuple of (float, float)
        Name of the dither pattern within a field, one of `DITHERS`, or offsets (x, y) in arcsec along the axes of the
        focal plane.
    short, flat : bool
        True to include the short VIS exposure in the first dither, and the VIS flat after the last dither.
    blue : bool
        True to use the blue grism in place of the red grisms in every second visit of a field.
    bands : tuple of str
        Passbands; () for all passbands of the channels.
    detectors : tuple of str
        Names of detectors to render; () for all detectors of the camera.
    mjd : float, optional
        Earliest date (MJD, UTC); None for the launch of the mission. Without a date, an observation with NISP begins
        when earlier NISP observations without a date, or of calibrations, have ended and their persistence has faded.
    exposure_time_s : float, optional
        Exposure time in seconds; None for the mission's value.
    clouds : float
        Mean extinction in magnitudes by clouds that drift over a ground camera; 0 for a clear sky.
    realisations : int
        Number of copies of each exposure that differ only in their noise.
    lamps : tuple of int
        Numbers of the LEDs for flats, also for those that precede the darks of persistence, from 1, in the order of
        use; () for all. Each is used in the bands that respond to its light.
    macc : tuple of int
        Numbers of groups, of reads per group and of dropped frames between groups in the ramps of NISP-P, or of NISP-S
        if the block has no NISP-P; () for the mission's values.
    intensities : tuple of float
        Levels of flats relative to the mission's level of the lamp. Each is used for `exposures` frames; () for 1.
    delays_s : tuple of float
        For persistence, seconds from the end of the bright exposure to the start of each dark; () for the mission's
        values.
    bright : str
        For persistence, the light of the bright exposure, one of `BRIGHT_TYPES`.
    phase_times_s : tuple of float
        For trap pumping, seconds that charge stays under an electrode; () for the mission's values. Each is used for
        `exposures` frames, by default one.
    defocus_nm : tuple of float
        For exposures out of focus, rms wavefront error of the defocus in nm, negative on one side of the focus. There
        is one exposure for each, at each dither; () for the mission's value on both sides.
    magnitude : float, optional
        AB magnitude of calibration stars in the exposure's band; None for the mission's value.
    distance_deg : float, optional
        Distance in degrees from the boresight of a bright star outside the field, whose stray light is observed; None
        for the mission's value.
    """

    channels: tuple[str, ...]
    image_type: str = "science"
    survey: str = "wide"
    pointings: str = ""
    table: Contents | None = None
    ra: float | None = None
    dec: float | None = None
    position_angle: float | None = None
    area: Area | None = None
    fields: int = 0
    visits: int = 0
    exposures: int = 0
    dither: str | tuple[tuple[float, float], ...] = "S"
    short: bool = True
    flat: bool = True
    blue: bool = False
    bands: tuple[str, ...] = ()
    detectors: tuple[str, ...] = ()
    mjd: float | None = None
    exposure_time_s: float | None = None
    clouds: float = 0.0
    realisations: int = 1
    lamps: tuple[int, ...] = ()
    macc: tuple[int, ...] = ()
    phase_times_s: tuple[float, ...] = ()
    defocus_nm: tuple[float, ...] = ()
    magnitude: float | None = None
    distance_deg: float | None = None
    intensities: tuple[float, ...] = ()
    delays_s: tuple[float, ...] = ()
    bright: str = BRIGHT_TYPES[0]

    @property
    def field_centre(self) -> tuple[float, float] | None:
        """Return (ra, dec) in degrees of the user's field, or None if the survey's fields are observed."""
        return None if self.ra is None or self.dec is None else (self.ra, self.dec)


# Keys of an observation. `table` is made from the file that `pointings` names.
_OBSERVATION_KEYS = tuple(key for key in Observation.__slots__ if key != "table")


def parse_observations(
    table: Toml, folder: Path = Path(), mission: MissionConfiguration | None = None, user_bands: Collection[str] = ()
) -> tuple[Observation, ...]:
    """Read the list `observation` of a request, () if it is missing.

    Tables of pointings (CSV files that an observation may name) are read, too.

    Parameters
    ----------
    table : Toml
        The parsed request.
    folder : Path, optional
        Folder of the request. Tables of pointings must be in this folder or below.
    mission : MissionConfiguration, optional
        Mission parameters, which list the passbands and detectors. None if they are not valid; then these names are
        not checked.
    user_bands : collection of str, optional
        Names of the user's passbands, in which no survey observes.

    Returns
    -------
    tuple of Observation
        The observations in the order of the file.

    Raises
    ------
    BadInput
        If observations or their tables of pointings are not valid. There is one line for each mistake, which names the
        key.
    """
    with Mistakes() as mistakes:
        observations = tuple(
            mistakes.read(_observation, value, f"observation[{i}]", folder, mission, user_bands)
            for i, value in enumerate(table_list(table, "observation", _MAX_OBSERVATIONS))
        )
    return observations


def _observation(
    value: object, path: str, folder: Path, mission: MissionConfiguration | None, user_bands: Collection[str]
) -> Observation:
    table = as_table(value, path, None)
    with Mistakes() as mistakes:
        read = mistakes.read
        read(check_keys, table, path, _OBSERVATION_KEYS, _PLACES)
        places = read(_refuse_two_places, table, path)
        kind = read(_kind, table, path)
        values = read(_values_of_kind, table, path, kind, mission, user_bands) if kind is not None else {}
        if kind is not None and places is not None:
            # A second place is one mistake: neither its keys nor a table of pointings are mistakes, too.
            read(_refuse_unused, table, *kind, path)
            survey = (values or {}).get("survey")
            values = {
                **(values or {}),
                **(read(named_tables.read_table, table, path, (*kind, survey), folder, mission) or {}),
            }
        observation = Observation(
            channels=(),
            ra=read(sky_notation.optional_ra, table, f"{path}.ra"),
            dec=read(sky_notation.optional_dec, table, f"{path}.dec"),
            position_angle=read(optional_number, table, f"{path}.position_angle", -360.0, 360.0, "deg"),
            area=read(_area, table, f"{path}.area"),
            fields=read(integer, table, f"{path}.fields", 1, 1_000_000, 0),
            visits=read(integer, table, f"{path}.visits", 1, 1000, 0),
            exposures=read(integer, table, f"{path}.exposures", 1, 1_000_000, 0),
            short=read(boolean, table, f"{path}.short", True),
            flat=read(boolean, table, f"{path}.flat", True),
            blue=read(boolean, table, f"{path}.blue", False),
            mjd=read(sky_notation.optional_mjd, table, f"{path}.mjd"),
            exposure_time_s=read(optional_number, table, f"{path}.exposure_time_s", 0.0, 1e6, "s"),
            clouds=read(optional_number, table, f"{path}.clouds", *CLOUDS_LIMITS, "mag") or 0.0,
            realisations=read(integer, table, f"{path}.realisations", 1, MAX_REALISATIONS, 1),
            macc=read(_macc, table, f"{path}.macc"),
            phase_times_s=read(_numbers, table, f"{path}.phase_times_s", 1e-6, 100.0),
            defocus_nm=read(_numbers, table, f"{path}.defocus_nm", -2000.0, 2000.0),
            magnitude=read(optional_number, table, f"{path}.magnitude", -10.0, 30.0),
            distance_deg=read(optional_number, table, f"{path}.distance_deg", 0.0, 10.0, "deg"),
            intensities=read(_numbers, table, f"{path}.intensities", 1e-4, 1e4),
            delays_s=read(_numbers, table, f"{path}.delays_s", 1.0, 1e6),
            bright=read(string, table, f"{path}.bright", BRIGHT_TYPES, BRIGHT_TYPES[0]),
        )
    return replace(observation, **values)


def _area(table: Toml, path: str) -> Area | None:
    return areas.parse(section(table, "area", None), path) if "area" in table else None


def _kind(table: Toml, path: str) -> tuple[tuple[str, ...], str]:
    """Return channels and image type of an observation; raises BadInput if they are wrong or do not fit together."""
    with Mistakes() as mistakes:
        channels = mistakes.read(_channels, table, f"{path}.channels")
        image_type = mistakes.read(string, table, f"{path}.image_type", IMAGE_TYPES, "science")
    if image_type not in _SKY_TYPES:
        for channel in channels:
            if image_type not in _CALIBRATIONS[channel]:
                legal = ", ".join((*_SKY_TYPES, *_CALIBRATIONS[channel]))
                raise BadInput(f"{path}.image_type = {image_type!r} is not a type of {channel}: {legal}")
    return channels, image_type


def _channels(table: Toml, path: str) -> tuple[str, ...]:
    channels = strings(table, path, CHANNELS)
    if not channels:
        raise BadInput(f'{path} is missing or empty: it must be a list of VIS, NISP-P and NISP-S, or ["EXT"]')
    if "EXT" in channels and len(channels) > 1:
        raise BadInput(f"{path}: EXT must be the only channel: use another [[observation]] for the others")
    return channels


def _values_of_kind(
    table: Toml,
    path: str,
    kind: tuple[tuple[str, ...], str],
    mission: MissionConfiguration | None,
    user_bands: Collection[str],
) -> dict[str, Any]:
    """Read those values of an observation that depend on its channels and its image type, and return them by key.

    `kind` has the channels and the image type.
    """
    channels, image_type = kind
    ground = "EXT" in channels
    surveys = GROUND_SURVEYS if ground else EUCLID_SURVEYS
    with Mistakes() as mistakes:
        read = mistakes.read
        values: dict[str, Any] = {
            "channels": channels,
            "image_type": image_type,
            "survey": read(string, table, f"{path}.survey", surveys, None if ground else "wide"),
            "dither": read(_dither, table, f"{path}.dither", ground),
            "bands": read(_bands, table, f"{path}.bands"),
            "detectors": read(strings, table, f"{path}.detectors"),
            "lamps": read(_lamps, table, f"{path}.lamps", channels),
        }
        if mission is not None and None not in (values["survey"], values["bands"], values["detectors"]):
            of_user = [band for band in values["bands"] if band in user_bands]
            for band in of_user:
                problem = f"{path}.bands: {band} is a user passband: no survey observes in it"
                mistakes.add(BadInput(f"{problem}, use [[pointing]]"))
            names = {**values, "bands": [band for band in values["bands"] if band not in of_user]}
            read(_check_names, names, table.get("blue") is True, mission, path)
    return values


def _bands(table: Toml, path: str) -> tuple[str, ...]:
    """Read the passbands of an observation. A grism stands for its passband: the survey sets the angles of spectra."""
    named = strings(table, path)
    return tuple(dict.fromkeys(instruments.replace_grism(band, None, path)[0] for band in named))


def _check_names(values: Mapping[str, Any], has_blue_grism: bool, mission: MissionConfiguration, path: str) -> None:
    """Raise BadInput if an observation names passbands or detectors that its channels or its survey do not have.

    `values` has the channels, survey, bands and detectors of the observation by key.
    """
    channels, survey = values["channels"], values["survey"]
    bands, owner = instruments.observable_bands(channels, survey, has_blue_grism, mission)
    cameras = dict.fromkeys(
        instruments.EUCLID_CAMERAS[channel]
        if channel in instruments.EUCLID_CAMERAS
        else instruments.survey_camera(survey, mission)
        for channel in channels
    )
    with Mistakes() as mistakes:
        for band in values["bands"]:
            mistakes.read(instruments.check_band, band, bands, owner, f"{path}.bands", mission)
        # A detector restricts the images of the camera to which it belongs. Another camera takes all of its detectors.
        mistakes.read(instruments.check_detectors, tuple(cameras), values["detectors"], mission, f"{path}.detectors")


def _lamps(table: Toml, path: str, channels: tuple[str, ...]) -> tuple[int, ...]:
    """Read the numbers of LEDs for flats, () if the key is missing.

    Raises BadInput if one of the channels does not have such an LED, or if a number occurs twice.
    """
    lamp_count = min(LAMPS.get(channel, 1) for channel in channels)
    lamps = _integers(table, path, (), ((1, lamp_count),) * lamp_count)
    if len(set(lamps)) < len(lamps):
        raise BadInput(f"{path} = {quote_value(list(lamps))} contains a lamp twice")
    return lamps


def _macc(table: Toml, path: str) -> tuple[int, ...]:
    macc = _integers(table, path, ("groups", "reads", "drops"), ((2, 1000), (1, 1000), (0, 1000)))
    if macc and (frames := ramps.frame_count(*macc)) > ramps.MAX_FRAMES:
        raise BadInput(f"{path} = {quote_value(list(macc))} has {frames} frames, more than {ramps.MAX_FRAMES}")
    return macc


def _integers(table: Toml, path: str, names: tuple[str, ...], bounds: tuple[tuple[int, int], ...]) -> tuple[int, ...]:
    """Read a list of whole numbers, () if the key at the end of `path` is missing.

    `bounds` has the smallest and largest value of each number, and `names` their names for error messages. The list
    must be as long as `names`; if `names` is empty, it may be shorter than `bounds`. Raises BadInput if the value is
    not such a list, and OutOfRange if a number is out of range.
    """
    values = table.get(path.rpartition(".")[2])
    if values is None:
        return ()
    if not isinstance(values, list) or not values or len(values) > len(bounds) or (names and len(values) != len(names)):
        raise BadInput(f"{path} = {quote_value(values)} is not [{', '.join(names) or 'whole numbers'}]")
    return tuple(
        checked_integer(value, f"{path}[{i}]{f' ({names[i]})' if names else ''}", low, high)
        for i, (value, (low, high)) in enumerate(zip(values, bounds, strict=False))
    )


def _numbers(table: Toml, path: str, lo: float, hi: float) -> tuple[float, ...]:
    """Read a list of 1 to 1000 different numbers from `lo` to `hi`, () if the key at the end of `path` is missing.

    Raises BadInput if the value is not such a list, and OutOfRange if a number is out of range.
    """
    values = table.get(path.rpartition(".")[2])
    if values is None:
        return ()
    if not isinstance(values, list) or not 1 <= len(values) <= _MAX_VALUES:
        raise BadInput(f"{path} = {quote_value(values)} is not a list of 1 to {_MAX_VALUES} numbers")
    numbers = tuple(checked_number(value, f"{path}[{i}]", lo, hi) for i, value in enumerate(values))
    if len(set(numbers)) < len(numbers):
        raise BadInput(f"{path} = {quote_value(values)} contains a number twice")
    return numbers


def _refuse_two_places(table: Toml, path: str) -> Toml:
    """Return an observation; raise BadInput if it has more than one way to give positions, or an incomplete one.

    The ways are the position of a user's field (`ra` and `dec`), a table of pointings, and survey fields in an `area`.
    """
    if ("ra" in table) != ("dec" in table):
        raise BadInput(f"{path}.{'dec' if 'ra' in table else 'ra'} is missing: ra and dec must be given together")
    if "position_angle" in table and "ra" not in table:
        raise BadInput(f"{path}.position_angle requires ra and dec: it is not used for fields of a survey")
    for key in ("ra", "pointings"):
        for other in ("pointings", "area", "fields"):
            if key != other and key in table and other in table:
                raise BadInput(f"{path}: {key} and {other} exclude each other: delete one of them")
    return table


def _refuse_unused(table: Toml, channels: tuple[str, ...], image_type: str, path: str) -> None:
    """Raise BadInput if a key has no effect on this kind of observation, its channels or its image type."""
    ground = "EXT" in channels
    kind = _block_kind(table, ground, image_type)
    with Mistakes() as mistakes:
        for key in table:
            if kind not in _BLOCKS_OF_KEY.get(key, (kind,)) and not (ground and key == "survey"):
                useless = {other for other, users in _CHANNELS_OF_KEY.items() if not {*users} & {*channels}}
                useless |= {other for other, types in _TYPES_OF_KEY.items() if image_type not in types}
                keys = [other for other, kinds in _BLOCKS_OF_KEY.items() if kind in kinds and other not in useless]
                hints = {"exposures": "visits repeats the exposures; ", "visits": "use exposures; "}
                instead = "" if kind == _TABLE else hints.get(key, "")
                text = f"{path}.{key} is not for {kind}: {instead}its keys are {', '.join(keys)}, realisations"
                mistakes.add(BadInput(text))
            elif image_type not in (types := _TYPES_OF_KEY.get(key, (image_type,))):
                mistakes.add(BadInput(f"{path}.{key} is not for {image_type}: used by {', '.join(types)}"))
            elif not {*(users := _CHANNELS_OF_KEY.get(key, channels))} & {*channels}:
                mistakes.add(BadInput(f"{path}.{key} is not for {', '.join(channels)}: used by {', '.join(users)}"))


def _block_kind(table: Toml, ground: bool, image_type: str) -> str:
    if "pointings" in table:
        return _TABLE
    if image_type not in _SKY_TYPES:
        timed = dict.fromkeys(("dark", "flat", "persistence"), _TIMED)
        untimed = dict.fromkeys(("bias", "charge_injection", "trap_pumping"), _UNTIMED)
        return {**timed, **untimed}.get(image_type, _DITHERED)
    if ground:
        return _GROUND_USER_FIELD if "ra" in table else _GROUND
    return _USER_FIELD if "ra" in table else _SURVEY


def _dither(table: Toml, path: str, ground: bool) -> str | tuple[tuple[float, float], ...]:
    """Read the key `dither`: the name of a pattern, or a list of offsets (x, y) in arcsec.

    The default is "S", or "none" for ground cameras, which have no named patterns. Raises BadInput for other values.
    """
    dither = table.get("dither", "none" if ground else "S")
    if not isinstance(dither, list):
        if not isinstance(dither, str) or dither not in DITHERS:
            hint = spelling.did_you_mean(dither, DITHERS) if isinstance(dither, str) else ""
            allowed = f"use {', '.join(DITHERS)} or a list of offsets, [[x, y], ..] arcsec"
            raise BadInput(f"{path} = {quote_value(dither)} is not allowed: {f'{hint} ' if hint else ''}{allowed}")
        if ground and dither != "none":
            raise BadInput(
                f"{path} = {quote_value(dither)} is a Euclid pattern: use a list of offsets in arcsec, [[x, y], ..]"
            )
        return dither
    if not 1 <= len(dither) <= _MAX_DITHERS or not all(isinstance(step, list) and len(step) == 2 for step in dither):
        raise BadInput(f"{path} must be one of {', '.join(DITHERS)}, or 1 to {_MAX_DITHERS} offsets [x, y] in arcsec")
    steps = [
        [checked_number(n, f"{path}[{i}][{axis}]", -_MAX_OFFSET, _MAX_OFFSET, "arcsec") for axis, n in enumerate(step)]
        for i, step in enumerate(dither)
    ]
    return tuple((x, y) for x, y in steps)
