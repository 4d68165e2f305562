"""Check a whole request (a user's TOML file): sources, bands, mission parameters, and whether it can be rendered.

Checks of single keys are in the modules that read them.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING

from lake_schema.errors import BadInput, Mistakes, OutOfRange, bad_input
from lake_schema.tables.exposures import RENDERED_TYPES
from truesky.cosmology import FIDUCIAL, LIMITS, POWERS, Cosmology
from truesky.request import instruments
from truesky.request.files import Ingest
from truesky.request.schema import FILE_NAMES, MissionChoice, Override, Request, Stars
from truesky.request.toml_values import Toml, as_table, number, quote_value, string

# Largest distance in degrees from the area to a pointing that may belong to it.
_NEAR_AREA = 3.0
# Keys of the section `universe` that only select or count sources that truesky draws.
_DRAWN_SOURCES = ("galaxy_limit", "galaxy_band", "star_limit", "high_redshift_boost", "quasar_boost", "variables")
# Starts of messages about mission parameters.
_OVERRIDE, _PARAMETER = "mission override ", "mission parameter "

if TYPE_CHECKING:
    from lake_schema.mission.configuration import MissionConfiguration


def check_sources(request: Request) -> None:
    """Raise BadInput if a request has the section `sources` and also `ingest`, `stars` or `solar_system`.

    The tables in `sources` contain all sources of the simulation, and the other sections would add more.
    """
    other_sections = {
        "ingest": request.ingest != Ingest(),
        "stars": request.stars != Stars(),
        "solar_system": request.bodies,
    }
    present = [key for key, is_present in other_sections.items() if is_present]
    if request.sources is not None and present:
        raise bad_input(f"sources: the tables contain all sources, the section {key} is not allowed" for key in present)


def unused_values(table: Toml) -> Iterator[str]:
    """Yield one line for each key of a valid request that has no effect, because the section `sources` is given.

    `table` is the parsed request.
    """
    for key in _DRAWN_SOURCES if table.get("sources") else ():
        if key in table.get("universe", {}):
            yield f"universe.{key} has no effect: the tables in [sources] contain all sources"


def parse_file_names(table: Toml) -> str:
    """Read the names of files of whole exposures from the section `products`. Raise BadInput without such files."""
    names = string(table, "products.names", FILE_NAMES, FILE_NAMES[0])
    if names != FILE_NAMES[0] and table.get("files") != "exposure":
        raise BadInput(f'products.names = "{names}" names files of whole exposures: write files = "exposure", too')
    return names


def check_places(request: Request) -> None:
    """Raise BadInput for pointings outside the area whose right ascension and declination seem to be exchanged."""
    with Mistakes() as mistakes:
        for i, pointing in enumerate(request.pointings):
            # A declination that was given as right ascension may have been read as an angle from 0 to 360 deg.
            exchanged_dec = (pointing.ra + 180.0) % 360.0 - 180.0
            if abs(exchanged_dec) > 90.0:
                continue
            places = (pointing.ra % 360.0, pointing.dec), (pointing.dec % 360.0, exchanged_dec)
            inside, exchanged_inside = (bool(request.area.contains([x], [y], _NEAR_AREA)[0]) for x, y in places)
            if exchanged_inside and not inside:
                place = f"ra = {pointing.ra:g}, dec = {pointing.dec:g}"
                mistakes.add(BadInput(f"pointing[{i}]: {place} is outside the area: are ra and dec exchanged?"))


def check_bands(request: Request) -> None:
    """Raise BadInput if a camera would observe in a user's passband for which it has no zero point and sky.

    VIS can observe in any user passband, and a user's camera in the passbands that its folder defines. No observation
    that the planner schedules may use a user passband.
    """
    user_passbands = {name for name, _ in request.curves.passbands}
    of_cameras = {(camera.name, curve.band) for camera in request.mission.cameras for curve in camera.curves}
    with Mistakes() as mistakes:
        for i, pointing in enumerate(request.pointings):
            if (pointing.camera, pointing.band) in of_cameras:
                continue
            if pointing.band in user_passbands and pointing.channel != "VIS":
                problem = (
                    f"{pointing.band} is a user passband, for which camera {pointing.camera} has no zero point and sky"
                )
                mistakes.add(BadInput(f"pointing[{i}].band: {problem}: only VIS can observe in it"))


def parse_override(value: object, name: str, has_quotes: bool, units: Mapping[str, str]) -> Override:
    """Read a value of a mission parameter in the section `mission.overrides`.

    Parameters
    ----------
    value : object
        Value in the request, which must be a table with value and unit.
    name : str
        Name of the parameter.
    has_quotes : bool
        False if the user wrote the name without quotes, so that it is several keys.
    units : mapping of str to str
        Units of all parameters, from `instruments.parameter_units`.

    Returns
    -------
    Override
        The value.

    Raises
    ------
    BadInput
        If no such parameter exists, or the value or its unit is missing or of a wrong type. The message contains a
        correct line.
    """
    path = f"mission.overrides.{name}"
    problem, line = instruments.explain_override(name, value, units)
    assigned = path if isinstance(value, dict) else f"{path} = {quote_value(value)}"
    if problem:
        raise BadInput(f"{assigned}: {problem}{f' write {line}' if problem.endswith('?') else ''}")
    if not has_quotes:
        raise BadInput(f"{path}: write the name of the parameter in quotes, such as {line}")
    if not isinstance(value, dict):
        raise BadInput(f"{assigned} has no unit: write {line}")
    if "value" in value and "unit" not in value:
        raise BadInput(f"{path}.unit is missing: write {line}")
    table = as_table(value, path, ("value", "unit"))
    with Mistakes() as mistakes:
        amount = mistakes.read(number, table, f"{path}.value", -math.inf, math.inf)
        unit = mistakes.read(string, table, f"{path}.unit")
    return Override(amount, unit)


def check_mission(choice: MissionChoice) -> MissionConfiguration:
    """Check and return the mission parameters (instruments and survey) that the section `mission` selects.

    The parameters have the values (overrides) and cameras of the user.

    Raises
    ------
    BadInput
        If a user's value has an unknown name or a wrong unit, or is out of range. Also if a user's camera, the ramp of
        an infrared detector (numbers of groups, reads and drops), or the offset of ghosts, is not valid. There is one
        line for each mistake, which names the key.
    """
    from lake_schema.mission.checks import camera_faults, value_faults
    from lake_schema.mission.configuration import resolve

    overrides = {key: (override.value, override.unit) for key, override in choice.overrides}
    try:
        mission = resolve(ladder=choice.ladder, overrides=overrides, cameras=choice.cameras)
    except BadInput as error:
        raise bad_input(_with_mission_key(message, overrides) for message in error.messages) from None
    with Mistakes() as mistakes:
        for i, camera in enumerate(choice.cameras):
            for fault in camera_faults(camera.name, mission):
                mistakes.add(BadInput(f"mission.cameras[{i}]: {fault}"))
        for fault in value_faults(mission):
            mistakes.add(BadInput(f"mission: {fault}"))
    return mission


def _with_mission_key(message: str, overrides: Collection[str]) -> str:
    """Return a message about the mission parameters with the key of the request at its start.

    `overrides` contains the names of parameters to which the request gives values.
    """
    parameter = message.removeprefix(_OVERRIDE).removeprefix(_PARAMETER)
    is_override = message.startswith(_OVERRIDE) or (message != parameter and parameter.split()[0] in overrides)
    return f"mission.overrides.{parameter}" if is_override else f"mission: {message}"


def check_explored(explore: Sequence[tuple[str, Sequence[str]]], mission: MissionConfiguration) -> None:
    """Raise BadInput if a parameter in the section `explore` is unknown, or a value that it takes is not valid.

    `explore` has the parameters with their values as JSON texts. There is one line for each mistake.
    """
    with Mistakes() as mistakes:
        for key, values in explore:
            if key != "accuracy" and not key.startswith("effects."):
                mistakes.read(_check_values, key, values, mission)


def _check_values(key: str, values: Sequence[str], mission: MissionConfiguration) -> None:
    from lake_schema.mission.checks import value_faults

    with Mistakes() as mistakes:
        for value in values:
            try:
                changed_mission = mission.with_overrides({key: tuple(json.loads(value))})
            except BadInput as error:
                texts = (text.removeprefix(f"{_OVERRIDE}{key}: ") for text in error.messages)
                mistakes.add(bad_input(texts).with_prefix(f"explore.{key}"))
                continue
            for fault in value_faults(changed_mission):
                mistakes.add(BadInput(f"explore.{key}: {fault}"))


def check_rendered(request: Request) -> None:
    """Raise BadInput if the request contains a channel and image type that cannot be rendered, only planned."""
    with Mistakes() as mistakes:
        for key, (channel, image_type) in _requested_types(request):
            if not _is_rendered((channel, image_type)):
                problem = f"{key}: no simulator renders {channel} {image_type} yet"
                mistakes.add(BadInput(f"{problem}: it can only be planned"))


def describe_skipped(request: Request) -> str:
    """Return a line that lists the channels and image types of a request that cannot be rendered, "" if all can.

    Their exposures are planned and their costs are forecast, but rendering skips them.
    """
    names = dict.fromkeys(
        f"{channel} {image_type}" if channel in RENDERED_TYPES else channel
        for _, (channel, image_type) in _requested_types(request)
        if not _is_rendered((channel, image_type))
    )
    *first_names, last = names or ("",)
    listed = f"{', '.join(first_names)} and {last}" if first_names else last
    return f"{listed}: planned and forecast, skipped by rendering (no simulator yet)" if listed else ""


def _requested_types(request: Request) -> Iterator[tuple[str, tuple[str, str]]]:
    """Yield (key, (channel, image type)) for all pointings and observations of a request.

    The key is that of the request's file, such as "pointing[0].channel". An observation yields one pair per channel, or
    per combination in its table of pointings.
    """
    for i, pointing in enumerate(request.pointings):
        yield f"pointing[{i}].channel", (pointing.channel, "science")
    for i, block in enumerate(request.observations):
        kinds = block.table.kinds if block.table else [(channel, block.image_type) for channel in block.channels]
        yield from ((f"observation[{i}].{'pointings' if block.table else 'channels'}", kind) for kind in kinds)


def _is_rendered(kind: tuple[str, str]) -> bool:
    return kind[1] in RENDERED_TYPES.get(kind[0], ())


def parse_cosmology(value: object) -> Cosmology:
    """Read the section `universe.cosmology`; parameters that it does not contain have their fiducial values.

    Raises BadInput if a value is not allowed, with one line for each.
    """
    path = "universe.cosmology"
    table = as_table(value, path, Cosmology.__slots__)
    with Mistakes() as mistakes:
        values = {
            name: mistakes.read(_parameter, table, f"{path}.{name}", *limits, getattr(FIDUCIAL, name))
            for name, limits in LIMITS.items()
        }
        power = mistakes.read(string, table, f"{path}.power", POWERS, FIDUCIAL.power)
    try:
        return Cosmology(**values, power=power)
    except BadInput as error:
        raise error.with_prefix(path) from None


def _parameter(table: Toml, path: str, lo: float, hi: float, default: float) -> float:
    """Read a parameter of the cosmology; for h, ask whether the value is H0 in km/s/Mpc."""
    try:
        return number(table, path, lo, hi, default)
    except OutOfRange as error:
        h = table[path.rpartition(".")[2]]
        if path.endswith(".h") and 100.0 * lo <= h <= 100.0 * hi:
            raise error.with_question(f"h is H0 / (100 km/s/Mpc): did you mean {h / 100.0:g}?") from None
        raise
