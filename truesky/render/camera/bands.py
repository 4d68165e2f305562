"""Names of the passbands of each camera."""

from __future__ import annotations

from collections.abc import Callable

from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.mission.parameter import SPACE_CAMERAS
from truesky.request import instruments
from truesky.request.instruments import GROUND_CHANNEL


def ground_bands(camera: str, mission: MissionConfiguration) -> tuple[str, ...]:
    """Return the names of a ground camera's passbands: all that have a zero point in the mission database.

    The result is () for the cameras of Euclid and for an unknown camera.
    """
    return () if camera in SPACE_CAMERAS else instruments.band_names(GROUND_CHANNEL, camera, mission)


def single_camera_bands(only_camera: str, *bands: str) -> Callable[[str, MissionConfiguration], tuple[str, ...]]:
    """Return a function of (camera, mission) that returns `bands` for the camera `only_camera` and () for any other."""
    return lambda camera, mission: bands if camera == only_camera else ()
