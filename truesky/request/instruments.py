"""Find the cameras, passbands and detectors that a request (a user's TOML file) may name, and refuse other names."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from functools import cache
from typing import TYPE_CHECKING

from lake_schema.errors import BadInput, bad_input
from lake_schema.tables.exposures import EUCLID_BANDS, GRISM_NAMES
from lake_schema.texts import spelling
from truesky.request.toml_values import known_name, quote_value

if TYPE_CHECKING:
    from lake_schema.mission.camera_folder import Camera
    from lake_schema.mission.configuration import MissionConfiguration

# Camera of each channel of Euclid. The channel EXT has all ground cameras of the mission database.
EUCLID_CAMERAS = {"VIS": "vis", "NISP-P": "nisp", "NISP-S": "nisp"}
# Channel of the ground cameras.
GROUND_CHANNEL = "EXT"
# Passband of a pointing that names none, by channel of Euclid.
_DEFAULT_BANDS = {"VIS": "euclid_vis", "NISP-P": "euclid_h", "NISP-S": "nisp_red"}
# End of the name of the passband of a ground camera that is the default for pointings, if the camera has it.
_DEFAULT_GROUND_BAND = "_r"
# Grism of NISP's wheel with which the mission does not observe.
_UNUSED_GRISM = "RGS270"
# Largest angle in degrees between the spectra of a grism that a request names and the direction of the untilted grism.
_MAX_GRISM_TILT = 45.0
# Largest number of detectors that an error message suggests.
_SUGGESTED_DETECTORS = 3
# The same of mission parameters.
_SUGGESTED_PARAMETERS = 3


def camera_names(channel: str, mission: MissionConfiguration) -> tuple[str, ...]:
    """Return the names of the cameras of a channel: one for each channel of Euclid, all ground cameras for EXT."""
    return (EUCLID_CAMERAS[channel],) if channel in EUCLID_CAMERAS else mission.ground_cameras


@cache
def band_names(channel: str, camera: str, mission: MissionConfiguration) -> tuple[str, ...]:
    """Return the names of the passbands that a camera has in a channel.

    Parameters
    ----------
    channel, camera : str
        Names of the channel ("VIS", "NISP-P", "NISP-S" or "EXT") and of the camera.
    mission : MissionConfiguration
        Mission parameters. A ground camera has the passbands for which they contain a zero point.

    Returns
    -------
    tuple of str
        Names of the passbands.
    """
    if channel in EUCLID_BANDS:
        return EUCLID_BANDS[channel]
    prefix = f"ext.{camera}."
    keys = (p.key for p in mission.parameters if p.key.startswith(prefix) and p.key.endswith(".zero_point"))
    return tuple(key.removeprefix(prefix).partition(".")[0] for key in keys)


def survey_bands(survey: str, mission: MissionConfiguration) -> tuple[str, ...]:
    """Return the passbands of a ground survey, in the order of its rules in the mission parameters."""
    rules = [row for row in mission.rows("survey.external") if row["survey"] == survey]
    return tuple(band for rule in rules for band in rule["bands"].split())


def survey_camera(survey: str, mission: MissionConfiguration) -> str:
    """Return the camera of a ground survey."""
    return next(row["camera"] for row in mission.rows("survey.external") if row["survey"] == survey)


def observable_bands(
    channels: Sequence[str], survey: str, has_blue_grism: bool, mission: MissionConfiguration
) -> tuple[tuple[str, ...], str]:
    """Return the passbands in which an observation may take exposures, and the name of their owner.

    Parameters
    ----------
    channels : sequence of str
        Channels of the observation.
    survey : str
        Survey of the observation, which defines the passbands of ground cameras.
    has_blue_grism : bool
        True if the observation uses the blue grism.
    mission : MissionConfiguration
        Mission parameters.

    Returns
    -------
    bands : tuple of str
        Names of the passbands in the order of the channels.
    owner : str
        Names of the channels, or the survey, for error messages.
    """
    if GROUND_CHANNEL in channels:
        return survey_bands(survey, mission), f"survey {survey}"
    bands = (band for channel in channels for band in EUCLID_BANDS[channel])
    return tuple(band for band in bands if band != "nisp_blue" or has_blue_grism), ", ".join(channels)


def default_band(channel: str, camera: str, mission: MissionConfiguration) -> str:
    """Return the passband of a pointing that names none.

    Parameters
    ----------
    channel, camera : str
        Names of the channel and of the camera.
    mission : MissionConfiguration
        Mission parameters.

    Returns
    -------
    str
        euclid_vis, euclid_h or nisp_red for the channels of Euclid. For a ground camera the r band, or its first
        passband if it has no r band.
    """
    if channel in _DEFAULT_BANDS:
        return _DEFAULT_BANDS[channel]
    bands = band_names(channel, camera, mission)
    return next((band for band in bands if band.endswith(_DEFAULT_GROUND_BAND)), bands[0])


def replace_grism(band: str, grism_angle: float | None, path: str) -> tuple[str, float | None]:
    """Return the passband and the direction of the spectra if the name of a passband is the name of a grism.

    Parameters
    ----------
    band : str
        Name of a passband, or of a grism: RGS000, RGS180 or BGS000.
    grism_angle : float or None
        Direction of the spectra in the focal plane in degrees; None if the request does not state it.
    path : str
        Path of the angle, for the error message.

    Returns
    -------
    band : str
        Passband of the grism; the given name if it is not the name of a grism.
    grism_angle : float or None
        The given angle. If it is None, that of the untilted grism, or None without a grism.

    Raises
    ------
    BadInput
        If spectra of this grism cannot have this direction.
    """
    if band not in GRISM_NAMES:
        return band, grism_angle
    passband, nominal = GRISM_NAMES[band]
    if grism_angle is None:
        return passband, nominal
    tilt = abs((grism_angle - nominal + 180.0) % 360.0 - 180.0)
    if tilt > _MAX_GRISM_TILT:
        raise BadInput(f"{path} = {grism_angle:g} deg tilts {band} by {tilt:g} deg, more than {_MAX_GRISM_TILT:g}")
    return passband, grism_angle


def check_camera(channel: str, camera: str, mission: MissionConfiguration, path: str) -> None:
    """Check that a channel has a camera.

    Parameters
    ----------
    channel, camera : str
        Names of the channel and of the camera.
    mission : MissionConfiguration
        Mission parameters.
    path : str
        Path of the key, for the error message.

    Raises
    ------
    BadInput
        If the channel has no such camera. The message lists its cameras.
    """
    names = camera_names(channel, mission)
    if camera not in names:
        raise BadInput(f"{path}: channel {channel} has no camera {camera!r}: {spelling.choices(camera, names)}")


def check_band(
    band: str, bands: Sequence[str], owner: str, path: str, mission: MissionConfiguration | None = None
) -> None:
    """Check that a camera or a survey has a passband.

    Parameters
    ----------
    band : str
        Name of the passband.
    bands : sequence of str
        Names of the passbands that are allowed.
    owner : str
        Camera or survey with these passbands, such as "camera vis", for the error message.
    path : str
        Path of the key, for the error message; "" if the caller adds it.
    mission : MissionConfiguration, optional
        Mission parameters, for the channel, camera or survey that has the passband, if another one has it.

    Raises
    ------
    BadInput
        If the passband is not allowed.
    """
    if band in bands:
        return
    if band == _UNUSED_GRISM:
        usable = ", ".join(grism for grism, (passband, _) in GRISM_NAMES.items() if passband in bands)
        problem = f"{path}{': ' if path else ''}Euclid does not observe with grism {band}"
        raise BadInput(f"{problem}: use {usable}" if usable else problem)
    meant = known_name(band, bands)
    remedy = spelling.choices(meant, bands)
    in_observation = path.endswith("bands")
    other = "" if mission is None or meant != band else _owner_of_band(band, in_observation, mission)
    if other:
        filter_name = band.rpartition("_")[2]
        same = [name for name in bands if name.rpartition("_")[2] == filter_name] if len(bands) > 1 else bands
        form = 'bands = ["{}"]' if in_observation else 'band = "{}"'
        remedy = f"{other}, or {form.format(same[0]) if len(same) == 1 else f'one of {spelling.join_words(bands)}'}"
    raise BadInput(f"{path}{': ' if path else ''}{owner} has no band {band!r}: {remedy}")


def _owner_of_band(band: str, in_observation: bool, mission: MissionConfiguration) -> str:
    """Return the channel, camera or survey that has a passband, and the keys that select it, "" if none has it.

    The keys belong to an observation if `in_observation` is True, else to a pointing.
    """
    band = known_name(band, [name for bands in EUCLID_BANDS.values() for name in bands])
    for channel, bands in EUCLID_BANDS.items():
        if band in bands:
            keys = f'channels = ["{channel}"]' if in_observation else f'channel = "{channel}"'
            keys += " and blue = true" if in_observation and band == "nisp_blue" else ""
            return f"{band} is a band of {channel}, write {keys}"
    if in_observation:
        surveys = [row["survey"] for row in mission.rows("survey.external") if band in row["bands"].split()]
        listed = [(f"survey {name}", f'channels = ["{GROUND_CHANNEL}"] and survey = "{name}"') for name in surveys]
    else:
        cameras = [name for name in mission.ground_cameras if band in band_names(GROUND_CHANNEL, name, mission)]
        listed = [(f"camera {name}", f'channel = "{GROUND_CHANNEL}" and camera = "{name}"') for name in cameras]
    return f"{band} is a band of {listed[0][0]}, write {listed[0][1]}" if listed else ""


def check_detectors(cameras: Sequence[str], names: Collection[str], mission: MissionConfiguration, path: str) -> None:
    """Check that each of the given detectors belongs to one of some cameras.

    Parameters
    ----------
    cameras : sequence of str
        Names of the cameras, at least one.
    names : collection of str
        Names of the detectors.
    mission : MissionConfiguration
        Mission parameters, which list the detectors of cameras.
    path : str
        Path of the key, for the error message.

    Raises
    ------
    BadInput
        If none of the cameras has a detector of one of these names. There is one line for each.
    """
    if not names:
        return
    existing = [name for camera in cameras for name in _detector_names(camera, mission)]
    owner = f"camera {cameras[0]} has" if len(cameras) == 1 else f"cameras {spelling.join_words(cameras, 'and')} have"
    unknown = [name for name in names if name not in existing]
    if unknown:
        raise bad_input(
            f"{path}: {owner} no detector {name!r}: {spelling.choices(name, existing, _SUGGESTED_DETECTORS)}"
            for name in unknown
        )


def detectors_of_camera(camera: str, names: Collection[str], mission: MissionConfiguration) -> tuple[str, ...]:
    """Return the given detectors that belong to a camera, or () if all belong to other cameras.

    Parameters
    ----------
    camera : str
        Name of the camera.
    names : collection of str
        Names of detectors of several cameras.
    mission : MissionConfiguration
        Mission parameters, which list the detectors of cameras.

    Returns
    -------
    tuple of str
        Names in the given order.
    """
    if not names:
        return ()
    existing = set(_detector_names(camera, mission))
    return tuple(name for name in names if name in existing)


def _detector_names(camera: str, mission: MissionConfiguration) -> Sequence[str]:
    # Import here, because most requests name no detectors.
    from lake_schema.mission import detector_overrides

    return detector_overrides.detectors(camera if camera in EUCLID_CAMERAS.values() else f"ext.{camera}", mission)


def parameter_units(cameras: Sequence[Camera] = ()) -> dict[str, str]:
    """Return the unit of each mission parameter by its name, with the parameters of the user's cameras."""
    # Import here, because the import is slow and few requests have mission parameters.
    from lake_schema.mission.configuration import resolve

    return {parameter.key: parameter.unit for parameter in resolve(cameras=cameras).parameters}


def override_values(name: str, value: object) -> Iterator[tuple[str, object]]:
    """Yield the name and the value of each mission parameter under a key of `mission.overrides`.

    If a user writes names without quotes, such as vis.gain, the value of the key `vis` is a table of parameters.
    """
    if isinstance(value, dict) and value and not value.keys() & {"value", "unit"}:
        for part, inner in value.items():
            yield from override_values(f"{name}.{part}", inner)
    else:
        yield name, value


def explain_override(name: str, value: object, units: Mapping[str, str]) -> tuple[str, str]:
    """Return the problem with the name of a parameter in `mission.overrides`, and a correct line of this section.

    Parameters
    ----------
    name : str
        Name of the parameter in the request.
    value : object
        Its value in the request.
    units : mapping of str to str
        Units of all parameters, from `parameter_units`.

    Returns
    -------
    problem : str
        Sentence with the most similar names if no such parameter exists, else "".
    line : str
        Text such as '"vis.gain" = { value = 3.0, unit = "electron / adu" }', with ".." for unknown parts. It has the
        most similar name if no such parameter exists.
    """
    from lake_schema.mission import detector_overrides

    problem, (key, _) = "", detector_overrides.split_name(name, units)
    if key not in units:
        # The names of all parameters of a camera begin with the same word, which would make them similar.
        camera, _, rest = key.partition(".")
        parameter_names = [other.removeprefix(f"{camera}.") for other in units if other.startswith(f"{camera}.")]
        similar = [
            f"{camera}.{other}" for other in spelling.closest_names(rest, parameter_names, _SUGGESTED_PARAMETERS)
        ]
        similar = similar if parameter_names else spelling.closest_names(key, units, _SUGGESTED_PARAMETERS)
        hint = f"did you mean {spelling.join_words(similar)}?" if similar else "truesky mission list prints all names"
        problem = f"no parameter {key} exists; {hint}"
        if similar:
            name, key = similar[0] + name.removeprefix(key), similar[0]
    number = value.get("value") if isinstance(value, dict) else value
    is_number = isinstance(number, (int, float)) and not isinstance(number, bool)
    text = quote_value(number) if is_number else ".."
    return problem, f'"{name}" = {{ value = {text}, unit = "{units.get(key, "..")}" }}'
