"""Image types of the sky; whose random numbers an exposure has.

identity       what tells an exposure's random numbers from those of all others
family         what exposures of one sequence have in common of their settings
"""

from __future__ import annotations

import json
from functools import lru_cache

from lake_schema.mission.parameter import SPACE_CAMERAS
from lake_schema.tables.exposures import ExposureRow

SKY_TYPES = ("science", "deep", "self_calibration")

# In settings before the name of a parameter that is an exposure's own, and no value that a request explores.
EXPOSURE_ONLY_PREFIX = "own:"


def section(camera: str) -> str:
    """Prefix of a camera's parameters in the mission database."""
    return camera if camera in SPACE_CAMERAS else f"ext.{camera}"


def identity(exposure: ExposureRow) -> str:
    """What an exposure's random numbers are keyed by: what was pointed where and when, not its place in a plan.

    A grism and its angle are a part of it: the band alone does not tell how spectra run.

    Of several alike the first has the numbers that it has alone.
    """
    places = (exposure.ra, exposure.dec, exposure.position_angle, exposure.mjd)
    grism = () if exposure.grism is None else (exposure.grism, (exposure.grism_angle or 0.0).hex())
    number = exposure.realisation or 1
    repeat = (str(number),) if number > 1 else ()
    return ":".join((exposure.camera, exposure.band, *(place.hex() for place in places), *grism, *repeat))


@lru_cache(maxsize=1024)
def shared_settings(settings: str | None) -> str | None:
    """Settings of an exposure without what is its own alone: those of the variant of an exploration."""
    values = json.loads(settings) if settings else {}
    shared = {key: value for key, value in values.items() if not key.startswith(EXPOSURE_ONLY_PREFIX)}
    return json.dumps(shared, sort_keys=True) if shared else None
