"""Image types with sky, and the identity of an exposure from which its random numbers are drawn."""

from __future__ import annotations

import json
from functools import lru_cache

from lake_schema.mission.parameter import SPACE_CAMERAS
from lake_schema.tables.exposures import ExposureRow

SKY_TYPES = ("science", "deep", "self_calibration")

# Prefix, in `settings`, of parameters that belong to a single exposure and are not explored by a request.
EXPOSURE_ONLY_PREFIX = "own:"


def section(camera: str) -> str:
    """Prefix of a camera's parameters in the mission database."""
    return camera if camera in SPACE_CAMERAS else f"ext.{camera}"


def identity(exposure: ExposureRow) -> str:
    """Return the text from which an exposure's random numbers are drawn.

    Notes
    -----
    It depends on pointing, time, band and grism, but not on the position of the exposure in a plan. The grism and its
    angle are included because the band does not define the direction of spectra. The first of several identical
    exposures has the same random numbers as a single one.
    """
    places = (exposure.ra, exposure.dec, exposure.position_angle, exposure.mjd)
    grism = () if exposure.grism is None else (exposure.grism, (exposure.grism_angle or 0.0).hex())
    number = exposure.realisation or 1
    repeat = (str(number),) if number > 1 else ()
    return ":".join((exposure.camera, exposure.band, *(place.hex() for place in places), *grism, *repeat))


@lru_cache(maxsize=1024)
def shared_settings(settings: str | None) -> str | None:
    """Settings of an exposure (JSON) without the parameters that belong to it alone; None if none remain.

    The result identifies the variant of an exploration.
    """
    values = json.loads(settings) if settings else {}
    shared = {key: value for key, value in values.items() if not key.startswith(EXPOSURE_ONLY_PREFIX)}
    return json.dumps(shared, sort_keys=True) if shared else None
