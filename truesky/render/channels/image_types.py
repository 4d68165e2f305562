"""Properties of image types, and the text that identifies an exposure for its random numbers."""

from __future__ import annotations

import json
from functools import lru_cache

from lake_schema.mission.parameter import SPACE_CAMERAS
from lake_schema.tables.exposures import ExposureRow

# Image types in which all channels see the sky.
SKY_TYPES = ("science", "deep", "self_calibration")

# Prefix of parameter names in the column `settings` of an exposure (JSON of changed parameters). It marks parameters
# that are set for this exposure alone. The others have values that the request explores for all exposures.
EXPOSURE_ONLY_PREFIX = "own:"


def section(camera: str) -> str:
    """Return the beginning of a camera's parameter names in the mission database.

    It is the name of a Euclid camera ("vis", "nisp"), or "ext." and the name of a ground camera.
    """
    return camera if camera in SPACE_CAMERAS else f"ext.{camera}"


def identity(exposure: ExposureRow) -> str:
    """Return a text that identifies an exposure and selects its random numbers.

    Notes
    -----
    The text has camera, band, pointing, date and grism, but not the number of the exposure, so that an exposure is the
    same in every request. The angle of the grism is included because the band does not define the direction of spectra.
    Repetitions of an exposure also have their number from 2 on; the first one has the text of an exposure that is not
    repeated.
    """
    places = (exposure.ra, exposure.dec, exposure.position_angle, exposure.mjd)
    grism = () if exposure.grism is None else (exposure.grism, (exposure.grism_angle or 0.0).hex())
    number = exposure.realisation or 1
    repeat = (str(number),) if number > 1 else ()
    return ":".join((exposure.camera, exposure.band, *(place.hex() for place in places), *grism, *repeat))


@lru_cache(maxsize=1024)
def shared_settings(settings: str | None) -> str | None:
    """Return the changed parameters of an exposure (JSON) without those set for it alone; None if none remain.

    The result identifies the combination of explored parameter values: exposures with the same text belong together.
    """
    values = json.loads(settings) if settings else {}
    shared = {key: value for key, value in values.items() if not key.startswith(EXPOSURE_ONLY_PREFIX)}
    return json.dumps(shared, sort_keys=True) if shared else None
