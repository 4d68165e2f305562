"""Passbands of the cameras.

of_ground   those of a ground camera, which the mission database has zero points of
of_one      those of a channel that has one camera
"""

from __future__ import annotations

from collections.abc import Callable

from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.mission.parameter import SPACE_CAMERAS


def ground_bands(camera: str, mission: MissionConfiguration) -> tuple[str, ...]:
    """Names of a ground camera's passbands; () of any other camera."""
    prefix = f"ext.{camera}."
    keys = (p.key for p in mission.parameters if p.key.startswith(prefix) and p.key.endswith(".zero_point"))
    return () if camera in SPACE_CAMERAS else tuple(key.removeprefix(prefix).partition(".")[0] for key in keys)


def single_camera_bands(only_camera: str, *bands: str) -> Callable[[str, MissionConfiguration], tuple[str, ...]]:
    """(camera, mission) -> these passbands of the camera `only`; () of any other camera."""
    return lambda camera, mission: bands if camera == only_camera else ()
