"""Apply changed parameters to an exposure.

A request may simulate the same sky with several values of mission parameters, accuracies or detector effects. Each
combination is a variant. The column `settings` of the table `exposures` has its values as JSON.
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
    """Return the mission parameters, accuracy, and effects switched on or off, with which an exposure is simulated.

    Parameters
    ----------
    settings : str or None
        Column `settings` of the exposure: a JSON table of its changed parameters, or None.
    mission : MissionConfiguration
        Mission parameters of the request.
    accuracy : Accuracy
        Accuracy of the request, used unless `settings` has another.
    forced : mapping of str to bool
        Detector effects that the request forces on (True) or off (False), by name.

    Returns
    -------
    Variant
        Mission parameters, accuracy, and effects that are switched on or off, after the changes in `settings`.
    """
    values: dict[str, Any] = json.loads(settings) if settings else {}
    parameters = {k: (v[0], v[1]) for k, v in values.items() if k != "accuracy" and not k.startswith("effects.")}
    explored = {k: v for k, v in parameters.items() if not k.startswith(EXPOSURE_ONLY_PREFIX)}
    # A parameter may be explored (varied over all exposures) and also set for this exposure alone. The value for this
    # exposure is then used.
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
    """Return a cached function that returns the mission parameters of an exposure, given its column `settings`.

    `mission` has the parameters of the request, to which the function applies the changes in `settings`.
    """
    return cache(lambda settings: variant(settings, mission, SURVEY, {}).mission)


def exposure_overrides(parameters: Mapping[str, tuple[float, str]]) -> dict[str, tuple[float, str]]:
    """Return the given mission parameters with the prefix "own:" in front of their names.

    In the column `settings` of table `exposures`, this prefix marks parameters that apply to a single exposure only.
    Values are (value, unit).
    """
    return {f"{EXPOSURE_ONLY_PREFIX}{key}": value for key, value in parameters.items()}


def forced_effects(request: Request) -> dict[str, bool]:
    """Return the detector effects that a request forces on (True) or off (False), by name; others are absent."""
    return {**dict.fromkeys(request.effects.on, True), **dict.fromkeys(request.effects.off, False)}
