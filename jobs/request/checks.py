"""What is checked of a whole request: its bands, the mission's parameters, and whether all of it can be rendered."""

from __future__ import annotations

import json

from jobs.request.files import Ingest
from jobs.request.schema import Request, Stars
from lake_schema.errors import BadInput
from lake_schema.tables.exposures import RENDERED


def check_sources(request: Request) -> None:
    """Where a request names its sources, nothing else makes some."""
    others = {"ingest": request.ingest != Ingest(), "stars": request.stars != Stars(), "solar_system": request.bodies}
    if request.sources is not None:
        for key, there in others.items():
            if there:
                raise BadInput(f"sources: those of the tables are the only ones, but there is a section {key}")


def check_bands(request: Request) -> None:
    """Of its own bands a request can point VIS in: of no other camera are zero point, sky and seeing known there."""
    own = {name for name, _ in request.curves.passbands}
    for i, pointing in enumerate(request.pointings):
        if pointing.band in own and pointing.channel != "VIS":
            what = f"{pointing.band} is your own passband, in which camera {pointing.camera} has no zero point and sky"
            raise BadInput(f"pointing[{i}].band: {what}: only VIS can be pointed in it")
    for i, block in enumerate(request.observations):
        if found := sorted(own & set(block.bands)):
            raise BadInput(f"observation[{i}].bands: {found[0]} is your own passband: no survey observes in it")


def check_mission(request: Request) -> None:
    """Overrides and explored values must be of the database's names, units and ranges."""
    from lake_schema.mission.configuration import resolve

    own = {key: (override.value, override.unit) for key, override in request.mission.overrides}
    try:
        mission = resolve(ladder=request.mission.ladder, overrides=own)
    except BadInput as error:
        raise BadInput(f"mission: {error}") from None
    for key, values in request.explore:
        if key == "accuracy" or key.startswith("effects."):
            continue
        for value in values:
            try:
                mission.overridden_with({key: tuple(json.loads(value))})
            except BadInput as error:
                raise BadInput(f"explore.{key}: {error}") from None


def check_rendered(request: Request) -> None:
    """There must be a simulator for every channel and image type: what can only be planned is refused by its key."""
    wanted: list[tuple[str, tuple[str, ...], str]]
    wanted = [(f"pointing[{i}].channel", (p.channel,), "science") for i, p in enumerate(request.pointings)]
    wanted += [(f"observation[{i}].channels", o.channels, o.image_type) for i, o in enumerate(request.observations)]
    for key, channels, image_type in wanted:
        for channel in channels:
            if image_type not in RENDERED.get(channel, ()):
                raise BadInput(f"{key}: no simulator renders {channel} {image_type} yet: it can be planned alone")
