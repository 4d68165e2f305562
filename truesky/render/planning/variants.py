"""The values that a request explores: one variant of the mission, accuracy and effects each.

variant      what a variant changes: mission, accuracy, effects
missions     settings of exposures -> the mission of each
own          parameters of an exposure of its own, as a part of its settings
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from functools import cache
from typing import Any

from lake_schema.mission.configuration import MissionConfiguration
from truesky.render.channels.image_types import EXPOSURE_ONLY_PREFIX
from truesky.render.exposure.records import Variant
from truesky.request.accuracy import SURVEY, Accuracy
from truesky.request.schema import Request


def variant(
    settings: str | None, mission: MissionConfiguration, accuracy: Accuracy, forced: Mapping[str, bool]
) -> Variant:
    """The mission, accuracy and forced effects of an exposure, from its `settings`."""
    values: dict[str, Any] = json.loads(settings) if settings else {}
    parameters = {k: (v[0], v[1]) for k, v in values.items() if k != "accuracy" and not k.startswith("effects.")}
    explored = {k: v for k, v in parameters.items() if not k.startswith(EXPOSURE_ONLY_PREFIX)}
    # What an exposure is taken with goes before what is explored.
    overrides = {
        **explored,
        **{
            k.removeprefix(EXPOSURE_ONLY_PREFIX): v for k, v in parameters.items() if k.startswith(EXPOSURE_ONLY_PREFIX)
        },
    }
    effects = {k.removeprefix("effects."): bool(v) for k, v in values.items() if k.startswith("effects.")}
    return Variant(
        mission.with_overrides(overrides) if overrides else mission,
        Accuracy(**values["accuracy"]) if "accuracy" in values else accuracy,
        {**forced, **effects},
    )


def mission_lookup(mission: MissionConfiguration) -> Callable[[str | None], MissionConfiguration]:
    """An exposure's settings -> its mission; mission : of the request."""
    return cache(lambda settings: variant(settings, mission, SURVEY, {}).mission)


def exposure_overrides(parameters: Mapping[str, tuple[float, str]]) -> dict[str, tuple[float, str]]:
    """Parameters that an exposure is taken with instead of the request's, as its settings have them."""
    return {f"{EXPOSURE_ONLY_PREFIX}{key}": value for key, value in parameters.items()}


def forced_effects(request: Request) -> dict[str, bool]:
    """Effect -> on or off, of a request."""
    return {**dict.fromkeys(request.effects.on, True), **dict.fromkeys(request.effects.off, False)}
