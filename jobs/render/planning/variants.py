"""The values that a request explores: one variant of the mission, accuracy and effects each.

variant      what a variant changes: mission, accuracy, effects
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from jobs.accuracy import Accuracy
from jobs.render.exposure.records import Variant
from jobs.request.schema import Request
from lake_schema.mission.configuration import MissionConfiguration


def variant(
    settings: str | None, mission: MissionConfiguration, accuracy: Accuracy, forced: Mapping[str, bool]
) -> Variant:
    """The mission, accuracy and forced effects of an exposure, from its `settings`."""
    values: dict[str, Any] = json.loads(settings) if settings else {}
    overrides = {k: (v[0], v[1]) for k, v in values.items() if k != "accuracy" and not k.startswith("effects.")}
    effects = {k.removeprefix("effects."): bool(v) for k, v in values.items() if k.startswith("effects.")}
    return Variant(
        mission.overridden_with(overrides) if overrides else mission,
        Accuracy(**values["accuracy"]) if "accuracy" in values else accuracy,
        {**forced, **effects},
    )


def forced(request: Request) -> dict[str, bool]:
    """Effect -> on or off, of a request."""
    return {**dict.fromkeys(request.effects.on, True), **dict.fromkeys(request.effects.off, False)}
