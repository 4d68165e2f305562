"""The channels that are rendered."""

from __future__ import annotations

from collections.abc import Mapping

from jobs.render.channels import ground, vis
from jobs.render.effects.effect import Effect
from lake_schema.errors import BadInput

EFFECTS: Mapping[str, Mapping[str, tuple[Effect, ...]]] = {"VIS": vis.EFFECTS, "EXT": ground.EFFECTS}


def effects_of(channel: str, image_type: str, where: str) -> tuple[Effect, ...]:
    """The effects of a kind of image, in their order; BadInput where nothing renders it."""
    if channel not in EFFECTS:
        raise BadInput(f"{where}: channel {channel!r} is not one of {', '.join(EFFECTS)}")
    if image_type not in EFFECTS[channel]:
        raise BadInput(f"{where}: {channel} has no image type {image_type!r}, only {', '.join(EFFECTS[channel])}")
    return EFFECTS[channel][image_type]
