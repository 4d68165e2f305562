"""Apply explored parameters: each variant of a request has its own mission, accuracy and effects."""

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
    """Return the mission, accuracy and forced effects of an exposure.

    Parameters
    ----------
    settings : str or None
        Column `settings` of the exposure: a JSON table of the changed parameters, or None.
    mission : MissionConfiguration
        Mission database of the request.
    accuracy : Accuracy
        Accuracy of the request.
    forced : mapping of str to bool
        Effects that the request forces on or off.

    Returns
    -------
    Variant
        Mission, accuracy and effects with the settings applied.
    """
    values: dict[str, Any] = json.loads(settings) if settings else {}
    parameters = {k: (v[0], v[1]) for k, v in values.items() if k != "accuracy" and not k.startswith("effects.")}
    explored = {k: v for k, v in parameters.items() if not k.startswith(EXPOSURE_ONLY_PREFIX)}
    # Parameters set for a single exposure take precedence over explored parameters.
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
    """Return a cached function from the settings of an exposure to its mission, based on the mission of the request."""
    return cache(lambda settings: variant(settings, mission, SURVEY, {}).mission)


def exposure_overrides(parameters: Mapping[str, tuple[float, str]]) -> dict[str, tuple[float, str]]:
    """Return parameters that an exposure overrides, with the keys that the column `settings` uses for them."""
    return {f"{EXPOSURE_ONLY_PREFIX}{key}": value for key, value in parameters.items()}


def forced_effects(request: Request) -> dict[str, bool]:
    """Return the effects that a request forces on (True) or off (False)."""
    return {**dict.fromkeys(request.effects.on, True), **dict.fromkeys(request.effects.off, False)}
