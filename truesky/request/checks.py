"""Check a whole request (a user's TOML file): sources, bands, mission parameters, and whether it can be rendered.

Checks of single keys are in the modules that read them.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import TYPE_CHECKING

from lake_schema.errors import BadInput
from lake_schema.tables.exposures import RENDERED_TYPES
from truesky.request.files import Ingest
from truesky.request.schema import Request, Stars

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
    if request.sources is not None:
        for key, is_present in other_sections.items():
            if is_present:
                raise BadInput(f"sources: the tables contain all sources, the section {key} is not allowed")


def check_bands(request: Request) -> None:
    """Raise BadInput if a camera would observe in a user's passband for which it has no zero point and sky.

    VIS can observe in any user passband, and a user's camera in the passbands that its folder defines. No observation
    that the planner schedules may use a user passband.
    """
    user_passbands = {name for name, _ in request.curves.passbands}
    of_cameras = {(camera.name, curve.band) for camera in request.mission.cameras for curve in camera.curves}
    for i, pointing in enumerate(request.pointings):
        if (pointing.camera, pointing.band) in of_cameras:
            continue
        if pointing.band in user_passbands and pointing.channel != "VIS":
            problem = (
                f"{pointing.band} is a user passband, for which camera {pointing.camera} has no zero point and sky"
            )
            raise BadInput(f"pointing[{i}].band: {problem}: only VIS can observe in it")
    for i, block in enumerate(request.observations):
        if user_bands := sorted(user_passbands & set(block.bands)):
            raise BadInput(f"observation[{i}].bands: {user_bands[0]} is a user passband: no survey observes in it")


def check_mission(request: Request) -> MissionConfiguration:
    """Check and return the mission parameters (instruments and survey) that a request selects.

    Parameters
    ----------
    request : Request
        The request.

    Returns
    -------
    MissionConfiguration
        Parameters with the values (overrides) and cameras of the user.

    Raises
    ------
    BadInput
        If a user's value has an unknown name or a wrong unit, or is out of range. This includes the values that the
        section `explore` tries in turn. Also if a user's camera, or the ramp of an infrared detector (numbers of
        groups, reads and drops), is not valid. The message names the key.
    """
    from lake_schema.mission.checks import camera_faults, ramp_faults
    from lake_schema.mission.configuration import resolve

    overrides = {key: (override.value, override.unit) for key, override in request.mission.overrides}
    try:
        mission = resolve(ladder=request.mission.ladder, overrides=overrides, cameras=request.mission.cameras)
    except BadInput as error:
        raise BadInput(f"mission: {error}") from None
    for i, camera in enumerate(request.mission.cameras):
        for fault in camera_faults(camera.name, mission):
            raise BadInput(f"mission.cameras[{i}]: {fault}")
    for fault in ramp_faults(mission):
        raise BadInput(f"mission: {fault}")
    for key, values in request.explore:
        if key == "accuracy" or key.startswith("effects."):
            continue
        for value in values:
            try:
                changed_mission = mission.with_overrides({key: tuple(json.loads(value))})
            except BadInput as error:
                raise BadInput(f"explore.{key}: {error}") from None
            for fault in ramp_faults(changed_mission):
                raise BadInput(f"explore.{key}: {fault}")
    return mission


def check_rendered(request: Request) -> None:
    """Raise BadInput if the request contains a channel and image type that cannot be rendered, only planned."""
    for key, (channel, image_type) in _requested_types(request):
        if not _is_rendered((channel, image_type)):
            raise BadInput(f"{key}: no simulator renders {channel} {image_type} yet: it can only be planned")


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
