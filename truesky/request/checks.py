"""What is checked of a whole request: its bands, the mission's parameters, and whether any of it can be rendered.

check_bands, check_mission   of names and values
check_rendered               all of it can be rendered
skipped                      what of it cannot, as one line
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
    """Where a request names its sources, nothing else makes some."""
    other_sections = {
        "ingest": request.ingest != Ingest(),
        "stars": request.stars != Stars(),
        "solar_system": request.bodies,
    }
    if request.sources is not None:
        for key, is_present in other_sections.items():
            if is_present:
                raise BadInput(f"sources: those of the tables are the only ones, but there is a section {key}")


def check_bands(request: Request) -> None:
    """Refuse a user's passband for a camera that has no zero point, sky and seeing in it: any but VIS and its own."""
    user_passbands = {name for name, _ in request.curves.passbands}
    of_cameras = {(camera.name, curve.band) for camera in request.mission.cameras for curve in camera.curves}
    for i, pointing in enumerate(request.pointings):
        if (pointing.camera, pointing.band) in of_cameras:
            continue
        if pointing.band in user_passbands and pointing.channel != "VIS":
            problem = (
                f"{pointing.band} is your own passband, in which camera {pointing.camera} has no zero point and sky"
            )
            raise BadInput(f"pointing[{i}].band: {problem}: only VIS can be pointed in it")
    for i, block in enumerate(request.observations):
        if user_bands := sorted(user_passbands & set(block.bands)):
            raise BadInput(f"observation[{i}].bands: {user_bands[0]} is your own passband: no survey observes in it")


def check_mission(request: Request) -> MissionConfiguration:
    """The mission that a request chooses: overrides and explored values must be of its names, units and ranges."""
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
    """There must be a simulator for each channel and image type that it wants observed."""
    for key, (channel, image_type) in _requested_types(request):
        if not _is_rendered((channel, image_type)):
            raise BadInput(f"{key}: no simulator renders {channel} {image_type} yet: it can be planned alone")


def describe_skipped(request: Request) -> str:
    """A line about what of a request is planned and forecast and not rendered, empty where all of it is rendered."""
    names = dict.fromkeys(
        f"{channel} {image_type}" if channel in RENDERED_TYPES else channel
        for _, (channel, image_type) in _requested_types(request)
        if not _is_rendered((channel, image_type))
    )
    *first_names, last = names or ("",)
    listed = f"{', '.join(first_names)} and {last}" if first_names else last
    return f"{listed}: planned and forecast, skipped by rendering (no simulator yet)" if listed else ""


def _requested_types(request: Request) -> Iterator[tuple[str, tuple[str, str]]]:
    """The key, channel and image type of all that a request wants observed."""
    for i, pointing in enumerate(request.pointings):
        yield f"pointing[{i}].channel", (pointing.channel, "science")
    for i, block in enumerate(request.observations):
        kinds = block.table.kinds if block.table else [(channel, block.image_type) for channel in block.channels]
        yield from ((f"observation[{i}].{'pointings' if block.table else 'channels'}", kind) for kind in kinds)


def _is_rendered(kind: tuple[str, str]) -> bool:
    return kind[1] in RENDERED_TYPES.get(kind[0], ())
