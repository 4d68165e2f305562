"""Image types: which see the sky, which see moving bodies; whose random numbers an exposure has.

identity       what tells an exposure's random numbers from those of all others
"""

from __future__ import annotations

from lake_schema.mission.parameter import CAMERAS
from lake_schema.tables.exposures import ExposureRow

SKY_TYPES = ("science", "deep", "self_calibration")


def sees_sky(channel: str, image_type: str) -> bool:
    """Whether sources shine on the detectors; a flat of VIS is taken with its shutter open."""
    return image_type in SKY_TYPES or (channel, image_type) == ("VIS", "flat")


def sees_bodies(channel: str, image_type: str) -> bool:
    """Whether moving bodies are drawn: of the channels by VIS alone."""
    return channel == "VIS" and sees_sky(channel, image_type)


def section(camera: str) -> str:
    """Prefix of a camera's parameters in the mission database."""
    return f"ext.{camera}" if camera in CAMERAS else camera


def identity(exposure: ExposureRow) -> str:
    """What an exposure's random numbers are keyed by: what was pointed where and when, not its place in a plan.

    Of several alike the first has the numbers that it has alone.
    """
    places = (exposure.ra, exposure.dec, exposure.position_angle, exposure.mjd)
    number = exposure.realisation or 1
    again = (str(number),) if number > 1 else ()
    return ":".join((exposure.camera, exposure.band, *(place.hex() for place in places), *again))
