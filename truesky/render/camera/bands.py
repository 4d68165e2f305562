"""Names of the passbands of cameras."""

from __future__ import annotations

from collections.abc import Callable

from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.mission.parameter import SPACE_CAMERAS


def ground_bands(camera: str, mission: MissionConfiguration) -> tuple[str, ...]:
    """Passbands of a ground camera that have a zero point in the mission database, () for any other camera."""
    prefix = f"ext.{camera}."
    keys = (p.key for p in mission.parameters if p.key.startswith(prefix) and p.key.endswith(".zero_point"))
    return () if camera in SPACE_CAMERAS else tuple(key.removeprefix(prefix).partition(".")[0] for key in keys)


def single_camera_bands(only_camera: str, *bands: str) -> Callable[[str, MissionConfiguration], tuple[str, ...]]:
    """Return a function (camera, mission) that gives `bands` for the camera `only_camera` and () for any other."""
    return lambda camera, mission: bands if camera == only_camera else ()
