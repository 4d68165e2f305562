"""A grism as its wheel leaves it: turned a little from where it was asked for, and away from the beam of the field.

tilt       by which a grism is turned for its spectra to run at an angle
turned     the same, with the wheel's error in an exposure
vignetted  what a turned grism lets through of a source's light
"""

from __future__ import annotations

import numpy as np

from lake_schema.arrays import Float
from lake_schema.mission.configuration import MissionConfiguration
from truesky.randomness import rng
from truesky.render.camera import traces

# Spectra are followed along the columns: a grism that is turned by more is none of NISP's, deg.
MAX_TILT = 45.0


def tilt(grism: str, angle: float, section: str, mission: MissionConfiguration) -> float:
    """By which a grism is turned from its own direction, deg, -180 .. 180.

    grism, angle     : its name, and the angle at which its spectra run in the focal plane, deg
    section, mission : of the camera in the mission database
    Errors           : BadInput for a grism that the database does not have
    """
    return (angle - traces.direction(grism, section, mission) + 180.0) % 360.0 - 180.0


def tilt_with_error(
    requested_tilt: float, exposure: str, section: str, mission: MissionConfiguration, seed: int
) -> float:
    """The tilt that a grism has in an exposure, deg: as asked for, and the wheel's error.

    asked            : deg;  exposure : what the error is keyed by, with the seed of the request
    section, mission : of the camera in the mission database
    """
    error = mission.value(f"{section}.grism_wheel_error", "deg")
    return requested_tilt + float(rng.stream(seed, "grism_wheel", exposure).normal(0.0, error))


def vignetting_throughput(
    x: Float, y: Float, dispersion_angle: float, requested_tilt: float, section: str, mission: MissionConfiguration
) -> Float:
    """[n] part of the light of sources at places (x, y) [n] arcsec of the focal plane that a grism lets through.

    x, y             : of the undispersed images;  along : the angle at which spectra run, deg
    asked            : the grism's tilt, deg: what it loses goes with it, on the side that it is turned to
    section, mission : of the camera in the mission database
    Assumed          : the side, and the law of other tilts than the one that was measured
    Ref              : Serrano et al. 2024 (10 % at 0.385 deg, none at 0.17 deg)
    """
    key = f"{section}.vignetting"
    low, high = (mission.value(f"{key}.angle_{end}", "arcsec") for end in ("low", "high"))
    depth = mission.value(f"{key}.depth", "") * abs(requested_tilt) / mission.value(f"{key}.tilt", "deg")
    turn = np.radians(dispersion_angle)
    away = np.sign(requested_tilt) * (np.cos(turn) * y - np.sin(turn) * x)
    return np.asarray(1.0 - np.minimum(depth * np.clip((away - low) / (high - low), 0.0, 1.0), 1.0))
