"""Read the observations of a request: single pointings, and blocks of exposures that the planner schedules."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from lake_schema import ramps, user_files
from lake_schema.errors import BadInput
from lake_schema.store import layout
from truesky.request import area as areas
from truesky.request import pointing_tables
from truesky.request.area import Area
from truesky.request.pointing_tables import CHANNELS, IMAGE_TYPES, Contents
from truesky.request.toml_values import (
    Toml,
    as_table,
    boolean,
    checked_number,
    has_key,
    integer,
    number,
    optional_number,
    quote_value,
    section,
    string,
    strings,
    table_list,
)

_MAX_POINTINGS, _MAX_OBSERVATIONS, _MAX_REALISATIONS = 100_000, 1000, 10_000
# Largest length of a list with one value per frame.
_MAX_VALUES = 1000
# Largest number of user dithers, and their largest offset along each axis (arcsec).
_MAX_DITHERS, _MAX_OFFSET = 1000, 36_000.0
DITHERS = ("S", "J", "none")
EUCLID_SURVEYS = ("wide", "deep", "edf_north", "edf_south", "edf_fornax")
GROUND_SURVEYS = ("des", "lsst", "cfis", "jedis", "ps1", "wishes", "whigs")
# Calibrations of each channel. The list is not derived from the rendered types because more can be planned.
# test_checks.py checks that it contains all rendered types.
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
# Kinds of observation, as messages name them.
_SURVEY, _USER_FIELD = "fields of a Euclid survey", "a Euclid field at ra, dec"
_GROUND, _GROUND_USER_FIELD = "a ground survey's pattern", "a ground camera's field at ra, dec"
_TIMED, _UNTIMED = "dark and flat frames", "bias, charge_injection and trap_pumping frames"
_DITHERED, _TABLE = "calibrations on the sky", "a table of pointings"
_CALIBRATION = (_TIMED, _UNTIMED, _DITHERED)
# Kinds that use a key; a key that is not listed is used by all. EXT always has a survey, which selects its camera.
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
}
# Keys that only some channels use.
_CHANNELS_OF_KEY = {"short": ("VIS",), "flat": ("VIS",), "blue": ("NISP-S",), "macc": ("NISP-P", "NISP-S")}
# Image types that use a key of calibrations.
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
# Sources of the bright exposure before the darks that measure persistence.
BRIGHT_TYPES = ("flat", "sky")
# Number of LEDs of each calibration unit. This is a copy because requests must not import the renderer;
# test_survey.py compares it with the lamps.
LAMPS = {"VIS": 6, "NISP-P": 5, "NISP-S": 5}


@dataclass(frozen=True, slots=True)
class Pointing:
    """One exposure of the list `pointing`.

    Attributes
    ----------
    ra, dec : float
        Position in degrees of the boresight, or of the centre of detector `centre_on`.
    position_angle : float
        Position angle of the focal plane's y axis in degrees, from north through east.
    mjd : float
        Start of the exposure (MJD).
    detectors : tuple of str
        Names of detectors; () for all of the camera.
    centre_on : str, optional
        Detector whose centre has the position ra, dec.
    exposure_time_s : float, optional
        Exposure time in seconds; None for the mission's value.
    realisations : int
        Number of exposures that differ only in their noise.
    grism_angle : float, optional
        Direction of NISP-S spectra in the focal plane in degrees; None for 0.
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
    grism_angle: float | None = None


@dataclass(frozen=True, slots=True)
class Observation:
    """A block of exposures that the planner schedules.

    Attributes
    ----------
    channels : tuple of str
        Channels that observe, or EXT alone.
    image_type : str
        Image type of the exposures.
    survey : str
        Survey whose pattern is used; it selects the camera of EXT.
    pointings : str
        Path of a table of pointings, or "".
    table : Contents, optional
        Summary of this table.
    ra, dec : float, optional
        Centre of a user's field in degrees; None for the fields of the survey.
    position_angle : float, optional
        Position angle in degrees of the focal plane's y axis at ra, dec. None for
        the angle set by the direction of the Sun (Euclid) or 0 (ground cameras).
    area : Area, optional
        Area to observe; None for the area of the request.
    fields : int
        Largest number of fields; those deepest in the area are used. 0 for all.
    visits : int
        Visits of each field; 0 for the number of the survey.
    exposures : int
        Number of exposures. A ground survey that shares positions among bands counts those of all bands together.
        For calibrations, the number of frames. 0 for the default.
    dither : str or tuple of (float, float)
        Pattern within a field, or offsets (x, y) in arcsec along the axes of the focal plane.
    short, flat : bool
        True to include the short VIS exposure, and the closing flat.
    blue : bool
        True to use the blue grism in addition to the red grisms.
    bands : tuple of str
        Passbands; () for all of the channel.
    detectors : tuple of str
        Names of detectors; () for all of the camera.
    mjd : float, optional
        Earliest date (MJD); None for the launch of the mission.
    exposure_time_s : float, optional
        Exposure time in seconds; None for the mission's value.
    realisations : int
        Number of copies of each exposure that differ only in their noise.
    lamps : tuple of int
        Numbers of the LEDs for flats in their order; () for all. Each is used in the bands that respond to it.
    macc : tuple of int
        Groups, reads and drops of NISP-P ramps, or of NISP-S ramps without NISP-P; () for the mission's values.
    intensities : tuple of float
        Levels of flats relative to the mission's level of the lamp, each for `exposures` frames; () for 1.
    delays_s : tuple of float
        For persistence, seconds from the end of the bright exposure to the start of each dark; () for the mission's
        values.
    bright : str
        For persistence, the source of the bright exposure, one of `BRIGHT_TYPES`.
    phase_times_s : tuple of float
        For trap pumping, seconds that charge stays under an electrode, one frame for each; () for the mission's values.
    defocus_nm : tuple of float
        For exposures out of focus, rms of the wavefront in nm, one exposure for each; () for the mission's value on
        both sides of the focus.
    magnitude : float, optional
        AB magnitude of calibration stars in the exposure's band; None for the mission's value.
    distance_deg : float, optional
        Distance in degrees of a star outside the field from the boresight; None for the mission's value.
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
        """Return ra, dec (degrees) of the user's field, or None for fields of the survey."""
        return None if self.ra is None or self.dec is None else (self.ra, self.dec)


def parse_pointings(table: Toml) -> tuple[Pointing, ...]:
    """Read the pointings of a request; raises BadInput that names the key if one is not valid."""
    entries = table_list(table, "pointing", _MAX_POINTINGS)
    return tuple(_pointing(value, f"pointing[{i}]") for i, value in enumerate(entries))


def _pointing(value: object, path: str) -> Pointing:
    table = as_table(value, path, set(Pointing.__slots__))
    channel = string(table, f"{path}.channel", CHANNELS)
    return Pointing(
        channel=channel,
        camera=layout.check_name(string(table, f"{path}.camera", default=channel.lower().partition("-")[0])),
        band=layout.check_name(string(table, f"{path}.band")),
        ra=number(table, f"{path}.ra", -360.0, 360.0) % 360.0,
        dec=number(table, f"{path}.dec", -90.0, 90.0),
        position_angle=number(table, f"{path}.position_angle", -360.0, 360.0, 0.0),
        mjd=number(table, f"{path}.mjd", 40_000.0, 100_000.0),
        detectors=strings(table, f"{path}.detectors"),
        centre_on=string(table, f"{path}.centre_on") if "centre_on" in table else None,
        exposure_time_s=optional_number(table, f"{path}.exposure_time_s", 0.0, 1e6),
        realisations=integer(table, f"{path}.realisations", 1, _MAX_REALISATIONS, 1),
        grism_angle=optional_number(table, f"{path}.grism_angle", -360.0, 360.0),
    )


def parse_observations(table: Toml, folder: Path = Path()) -> tuple[Observation, ...]:
    """Read the observations of a request; tables of pointings must be in `folder` or below.

    Raises
    ------
    BadInput
        If an observation is not valid. The message names the key.
    """
    entries = table_list(table, "observation", _MAX_OBSERVATIONS)
    return tuple(_observation(value, f"observation[{i}]", folder) for i, value in enumerate(entries))


def _observation(value: object, path: str, folder: Path) -> Observation:
    table = as_table(value, path, set(Observation.__slots__) - {"table"})
    channels = strings(table, f"{path}.channels", CHANNELS)
    if not channels:
        raise BadInput(f"{path}.channels is missing or empty")
    ground = "EXT" in channels
    if ground and len(channels) > 1:
        raise BadInput(f"{path}.channels: EXT must be the only channel")
    image_type = string(table, f"{path}.image_type", IMAGE_TYPES, "science")
    if image_type not in _SKY_TYPES:
        for channel in channels:
            if image_type not in _CALIBRATIONS[channel]:
                legal = ", ".join((*_SKY_TYPES, *_CALIBRATIONS[channel]))
                raise BadInput(f"{path}.image_type = {image_type!r} is not a type of {channel}: {legal}")
    surveys = GROUND_SURVEYS if ground else EUCLID_SURVEYS
    _refuse_two_places(table, path)
    _refuse_unused(table, channels, image_type, path)
    file = _pointings_file(table, path, folder)
    return Observation(
        channels=channels,
        image_type=image_type,
        survey=string(table, f"{path}.survey", surveys, None if ground else "wide"),
        pointings="" if file is None else str(file),
        table=None if file is None else _contents(file, channels, image_type, path),
        ra=_wrap_ra(optional_number(table, f"{path}.ra", -360.0, 360.0)),
        dec=optional_number(table, f"{path}.dec", -90.0, 90.0),
        position_angle=optional_number(table, f"{path}.position_angle", -360.0, 360.0),
        area=areas.parse(section(table, "area", None), f"{path}.area") if has_key(table, f"{path}.area") else None,
        fields=integer(table, f"{path}.fields", 1, 1_000_000, 0),
        visits=integer(table, f"{path}.visits", 1, 1000, 0),
        exposures=integer(table, f"{path}.exposures", 1, 1_000_000, 0),
        dither=_dither(table, f"{path}.dither", ground),
        short=boolean(table, f"{path}.short", True),
        flat=boolean(table, f"{path}.flat", True),
        blue=boolean(table, f"{path}.blue", False),
        bands=tuple(layout.check_name(band) for band in strings(table, f"{path}.bands")),
        detectors=strings(table, f"{path}.detectors"),
        mjd=optional_number(table, f"{path}.mjd", 40_000.0, 100_000.0),
        exposure_time_s=optional_number(table, f"{path}.exposure_time_s", 0.0, 1e6),
        realisations=integer(table, f"{path}.realisations", 1, _MAX_REALISATIONS, 1),
        lamps=_lamps(table, f"{path}.lamps", channels),
        macc=_macc(table, f"{path}.macc"),
        phase_times_s=_numbers(table, f"{path}.phase_times_s", 1e-6, 100.0),
        defocus_nm=_numbers(table, f"{path}.defocus_nm", -2000.0, 2000.0),
        magnitude=optional_number(table, f"{path}.magnitude", -10.0, 30.0),
        distance_deg=optional_number(table, f"{path}.distance_deg", 0.0, 10.0),
        intensities=_numbers(table, f"{path}.intensities", 1e-4, 1e4),
        delays_s=_numbers(table, f"{path}.delays_s", 1.0, 1e6),
        bright=string(table, f"{path}.bright", BRIGHT_TYPES, BRIGHT_TYPES[0]),
    )


def _lamps(table: Toml, path: str, channels: tuple[str, ...]) -> tuple[int, ...]:
    """Return the numbers of LEDs, which all channels must have."""
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
    """Read a list of whole numbers, () if the key is missing.

    The list must be as long as `names`. If `names` is empty, it may be shorter than `bounds`.
    """
    values = table.get(path.rpartition(".")[2])
    if values is None:
        return ()
    if not isinstance(values, list) or not values or len(values) > len(bounds) or (names and len(values) != len(names)):
        raise BadInput(f"{path} = {quote_value(values)} is not [{', '.join(names) or 'whole numbers'}]")
    numbers = []
    for i, (value, (low, high)) in enumerate(zip(values, bounds, strict=False)):
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            name = f"{names[i]} = " if names else ""
            raise BadInput(f"{path}: {name}{quote_value(value)} is not a whole number from {low} to {high}")
        numbers.append(value)
    return tuple(numbers)


def _numbers(table: Toml, path: str, lo: float, hi: float) -> tuple[float, ...]:
    """Read a list of different numbers, () if the key is missing."""
    values = table.get(path.rpartition(".")[2])
    if values is None:
        return ()
    if not isinstance(values, list) or not 1 <= len(values) <= _MAX_VALUES:
        raise BadInput(f"{path} = {quote_value(values)} is not a list of 1 to {_MAX_VALUES} numbers")
    numbers = tuple(checked_number(value, f"{path}[{i}]", lo, hi) for i, value in enumerate(values))
    if len(set(numbers)) < len(numbers):
        raise BadInput(f"{path} = {quote_value(values)} contains a number twice")
    return numbers


def _wrap_ra(ra: float | None) -> float | None:
    return None if ra is None else ra % 360.0


def _refuse_two_places(table: Toml, path: str) -> None:
    """Check that a user's field, a table of pointings, and an area with survey fields are not combined."""
    if ("ra" in table) != ("dec" in table):
        raise BadInput(f"{path}.{'dec' if 'ra' in table else 'ra'} is missing: ra and dec must be given together")
    if "position_angle" in table and "ra" not in table:
        raise BadInput(f"{path}.position_angle requires ra and dec: it is not used for fields of a survey")
    for key in ("ra", "pointings"):
        for other in ("pointings", "area", "fields"):
            if key != other and key in table and other in table:
                raise BadInput(f"{path}: {key} and {other} exclude each other")


def _refuse_unused(table: Toml, channels: tuple[str, ...], image_type: str, path: str) -> None:
    """Check that every key has an effect on this kind of observation."""
    ground = "EXT" in channels
    kind = _block_kind(table, ground, image_type)
    for key in table:
        used_by = _BLOCKS_OF_KEY.get(key, (kind,))
        if kind not in used_by and not (ground and key == "survey"):
            raise BadInput(f"{path}.{key} is not for {kind}: used by {', '.join(used_by)}")
        if key in _TYPES_OF_KEY and image_type not in _TYPES_OF_KEY[key]:
            raise BadInput(f"{path}.{key} is not for {image_type}: used by {', '.join(_TYPES_OF_KEY[key])}")
        if (allowed := _CHANNELS_OF_KEY.get(key)) is not None and not {*allowed} & {*channels}:
            raise BadInput(f"{path}.{key} is not for {', '.join(channels)}: used by {', '.join(allowed)}")


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


def _pointings_file(table: Toml, path: str, folder: Path) -> Path | None:
    """Return the path of the table of pointings, which must be inside the request's folder, or None."""
    if not string(table, f"{path}.pointings", default=""):
        return None
    file = folder / string(table, f"{path}.pointings")
    try:
        return user_files.check_file(layout.check_inside(folder, file), "table of pointings")
    except BadInput as error:
        raise BadInput(f"{path}.pointings: {error}") from None


def _contents(file: Path, channels: tuple[str, ...], image_type: str, path: str) -> Contents:
    try:
        return pointing_tables.contents(file, channels, image_type)
    except BadInput as error:
        raise BadInput(f"{path}.pointings: {error}") from None


def _dither(table: Toml, path: str, ground: bool) -> str | tuple[tuple[float, float], ...]:
    """Return the name of a pattern, or offsets in arcsec."""
    dither = table.get("dither", "none" if ground else "S")
    if not isinstance(dither, list):
        pattern = string({"dither": dither}, path, DITHERS)
        if ground and pattern != "none":
            raise BadInput(
                f"{path} = {quote_value(dither)} is a Euclid pattern: use a list of offsets in arcsec, [[x, y], ..]"
            )
        return pattern
    if not 1 <= len(dither) <= _MAX_DITHERS or not all(isinstance(step, list) and len(step) == 2 for step in dither):
        raise BadInput(f"{path} must be one of {', '.join(DITHERS)}, or 1 to {_MAX_DITHERS} offsets [x, y] in arcsec")
    steps = [
        [checked_number(n, f"{path}[{i}]", -_MAX_OFFSET, _MAX_OFFSET) for n in step] for i, step in enumerate(dither)
    ]
    return tuple((x, y) for x, y in steps)
