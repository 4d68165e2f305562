"""Read the observations of a request (a user's TOML file): single pointings, and blocks of exposures.

The user gives position and time of a pointing. The planner schedules the exposures of a block.
"""

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

# Largest number of pointings and of observation blocks in a request, and of copies of an exposure with different noise.
_MAX_POINTINGS, _MAX_OBSERVATIONS, _MAX_REALISATIONS = 100_000, 1000, 10_000
# Largest number of values in a list that gives one value per calibration frame, such as delays_s.
_MAX_VALUES = 1000
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
}
# Channels that use a key. A key that is not listed is used by all channels.
_CHANNELS_OF_KEY = {"short": ("VIS",), "flat": ("VIS",), "blue": ("NISP-S",), "macc": ("NISP-P", "NISP-S")}
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
# Light of the bright exposure that precedes the dark frames in which persistence is measured.
BRIGHT_TYPES = ("flat", "sky")
# Number of LEDs of the calibration unit of each channel. This copies the renderer's lamps, because requests must not
# import the renderer; test_infrared.py compares the two.
LAMPS = {"VIS": 6, "NISP-P": 5, "NISP-S": 5}


@dataclass(frozen=True, slots=True)
class Pointing:
    """One science exposure of a request, with its position and time.

    Attributes
    ----------
    channel : str
        VIS, NISP-P, NISP-S or EXT (ground cameras).
    camera : str
        Name of the camera in the mission database.
    band : str
        Name of the passband.
    ra, dec : float
        ICRS position in degrees of the boresight, or of the centre of detector `centre_on`.
    position_angle : float
        Position angle of the focal plane's y axis in degrees, from north through east.
    mjd : float
        Start of the exposure (MJD).
    detectors : tuple of str
        Names of detectors to render; () for all detectors of the camera.
    centre_on : str, optional
        Detector whose centre has the position ra, dec.
    exposure_time_s : float, optional
        Exposure time in seconds; None for the value in the mission database.
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
        For calibrations, the number of frames or of dithers, at each level, phase time or defocus. 0 for the default;
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
        Earliest date (MJD); None for the launch of the mission. Without a date, an observation with NISP begins when
        earlier NISP observations without a date, or of calibrations, have ended and their persistence has faded.
    exposure_time_s : float, optional
        Exposure time in seconds; None for the mission's value.
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


def parse_pointings(table: Toml) -> tuple[Pointing, ...]:
    """Read the list `pointing` of a request, () if it is missing.

    `table` is the parsed request. Raises BadInput, which names the key, if an entry is not valid.
    """
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
    """Read the list `observation` of a request, () if it is missing.

    `table` is the parsed request and `folder` its folder. Tables of pointings (CSV files that an observation may name)
    are read, too. They must be in this folder or below.

    Raises
    ------
    BadInput
        If an observation or its table of pointings is not valid. The message names the key.
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
    not such a list.
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


def _wrap_ra(ra: float | None) -> float | None:
    return None if ra is None else ra % 360.0


def _refuse_two_places(table: Toml, path: str) -> None:
    """Raise BadInput if an observation has more than one way to give positions, or an incomplete one.

    The ways are the position of a user's field (`ra` and `dec`), a table of pointings, and survey fields in an `area`.
    """
    if ("ra" in table) != ("dec" in table):
        raise BadInput(f"{path}.{'dec' if 'ra' in table else 'ra'} is missing: ra and dec must be given together")
    if "position_angle" in table and "ra" not in table:
        raise BadInput(f"{path}.position_angle requires ra and dec: it is not used for fields of a survey")
    for key in ("ra", "pointings"):
        for other in ("pointings", "area", "fields"):
            if key != other and key in table and other in table:
                raise BadInput(f"{path}: {key} and {other} exclude each other")


def _refuse_unused(table: Toml, channels: tuple[str, ...], image_type: str, path: str) -> None:
    """Raise BadInput if a key has no effect on this kind of observation, its channels or its image type."""
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
    """Return the path of an observation's table of pointings, or None if it has none.

    Raises BadInput if the file is not in `folder` (the folder of the request) or below, or does not exist.
    """
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
    """Read the key `dither`: the name of a pattern, or a list of offsets (x, y) in arcsec.

    The default is "S", or "none" for ground cameras, which have no named patterns. Raises BadInput for other values.
    """
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
