"""Names of the passbands of each camera."""

from __future__ import annotations

from collections.abc import Callable

from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.mission.parameter import SPACE_CAMERAS


def ground_bands(camera: str, mission: MissionConfiguration) -> tuple[str, ...]:
    """Return the names of a ground camera's passbands: all that have a zero point in the mission database.

    The result is () for the cameras of Euclid and for an unknown camera.
    """
    prefix = f"ext.{camera}."
    keys = (p.key for p in mission.parameters if p.key.startswith(prefix) and p.key.endswith(".zero_point"))
    return () if camera in SPACE_CAMERAS else tuple(key.removeprefix(prefix).partition(".")[0] for key in keys)


def single_camera_bands(only_camera: str, *bands: str) -> Callable[[str, MissionConfiguration], tuple[str, ...]]:
    """Return a function of (camera, mission) that returns `bands` for the camera `only_camera` and () for any other."""
    return lambda camera, mission: bands if camera == only_camera else ()
