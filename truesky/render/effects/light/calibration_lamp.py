"""Light of flat fields: a lamp illuminates the detector unevenly.

In VIS and NISP it is one of the LEDs of the calibration unit, in ground cameras the lamp of the dome.

LEDs have different wavelengths, so that a passband detects different fractions of their photons. A dome has one lamp,
which gives the same signal in all passbands.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from lake_schema.arrays import Float
from lake_schema.errors import OutOfRange
from lake_schema.mission.configuration import MissionConfiguration
from truesky.fluxes import passbands
from truesky.fluxes.passbands import Passband
from truesky.render.camera import lamps
from truesky.render.camera.lamps import LAMPS
from truesky.render.effects.effect import Effect
from truesky.render.effects.light import illumination
from truesky.render.effects.scene import Frame, Scene

# Full width at half maximum of a Gaussian, divided by its standard deviation.
_FWHM = 2.0 * np.sqrt(2.0 * np.log(2.0))


def apply(frame: Frame, level: float, columns: Frame, rows: Frame, rng: np.random.Generator | None = None) -> Frame:
    """Add the uneven light of a calibration lamp to a frame.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Expected electrons.
    level : float
        Expected electrons of the lamp in a pixel in which its illumination pattern is 1, from 0 to 1e9.
    columns : float array, shape (nx,)
        Term of the illumination pattern that depends on the column, relative to the nominal illumination.
    rows : float array, shape (ny,)
        Term that depends on the row, relative to the nominal illumination. The pattern is 1 + columns + rows.
    rng : numpy.random.Generator, optional
        Not used.

    Returns
    -------
    float array, shape (ny, nx)
        Expected electrons including the lamp.

    Raises
    ------
    OutOfRange
        If `level` is outside its limits or NaN, or if the pattern is negative or infinite.
    BadInput
        If the lengths of `columns` and `rows` do not match the shape of the frame.
    """
    if not 0.0 <= level <= 1e9:
        raise OutOfRange("lamp", level, 0.0, 1e9)
    return np.asarray(frame + level * illumination.apply(np.ones(frame.shape), columns, rows))


def pattern(scene: Scene, led: int, nx: int, ny: int) -> tuple[Frame, Frame]:
    """Return the illumination of a detector by an LED: a paraboloid plus a slope.

    The direction of the slope depends on the position of the LED in the calibration unit.

    Parameters
    ----------
    scene : Scene
        Settings of the exposure, from which the parameters of the calibration unit are taken.
    led : int
        Number of the LED, from 1. A ground camera has one lamp with the number 1.
    nx, ny : int
        Columns and rows of the detector.

    Returns
    -------
    columns : float array, shape (nx,)
        Term of the pattern that depends on the column.
    rows : float array, shape (ny,)
        Term of the pattern that depends on the row. The pattern is 1 + columns + rows.

    Raises
    ------
    OutOfRange
        If the camera has no LED with the number `led`.
    """
    leds = lamps.count(scene.section)
    if not 1 <= led <= leds:
        raise OutOfRange("LED", led, 1, leds)
    angle = 2.0 * np.pi * (led - 1) / leds
    slope = scene.value("flat.gradient", "")
    direction = (slope * float(np.cos(angle)), slope * float(np.sin(angle)))
    return illumination.pattern(scene, nx, ny, scene.value("flat.illumination", ""), direction)


def efficiency_of_scene(scene: Scene, led: int) -> float:
    """Return the fraction of an LED's photons that the passband of an exposure detects, relative to a common scale.

    The scale is the highest response of the camera's built-in passbands, see `led_efficiency`. An exposure without
    passband uses the camera's first built-in one. OutOfRange is raised if the camera has no LED with the number `led`.
    """
    band = scene.band or passbands.load(LAMPS[scene.section][1][0])
    return led_efficiency(band, led, scene.section, scene.mission)


def led_efficiency(band: Passband, led: int, section: str, mission: MissionConfiguration) -> float:
    """Return the fraction of an LED's photons that a passband detects, relative to the camera's highest response.

    Parameters
    ----------
    band : Passband
        Passband of the exposure.
    led : int
        Number of the LED, from 1.
    section : str
        Name of the camera in the mission database, "vis" or "nisp".
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    float
        Detected fraction of the photons, divided by the highest response of the camera's built-in passbands;
        dimensionless.

    Raises
    ------
    OutOfRange
        If the camera has no LED with the number `led`.

    Notes
    -----
    The spectrum of an LED is a Gaussian. The mission database contains its central wavelength and its width.
    """
    width = _width(section, mission)
    detected = float(np.sum(detected_photons(band, led, section, mission)) / (width * np.sqrt(2.0 * np.pi)))
    return detected / _best_response(section)


@cache
def _best_response(section: str) -> float:
    """Return the highest response (detected photons per arriving photon) of the built-in passbands of a camera."""
    return max(float(passbands.load(name).response.max()) for name in LAMPS[section][1])


def detected_photons(band: Passband, led: int, section: str, mission: MissionConfiguration) -> Float:
    """Return the photons of an LED that a passband detects at each wavelength, in arbitrary units.

    Parameters
    ----------
    band : Passband
        Passband of the exposure.
    led : int
        Number of the LED, from 1.
    section : str
        Name of the camera in the mission database, "vis" or "nisp".
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    float64 array, shape (n,)
        Detected photons at the wavelengths of `band` (steps of 1 Angstrom). The peak of the LED's own spectrum is 1.

    Raises
    ------
    OutOfRange
        If the camera has no LED with the number `led`.
    """
    leds, _ = LAMPS[section]
    if not 1 <= led <= leds:
        raise OutOfRange("LED", led, 1, leds)
    offset = (band.wavelength - 10.0 * mission.value(f"{section}.flat.led_{led}", "nm")) / _width(section, mission)
    return np.asarray(band.response * np.exp(-0.5 * offset**2))


def _width(section: str, mission: MissionConfiguration) -> float:
    """Return the standard deviation of the Gaussian spectrum of an LED in Angstrom."""
    return float(10.0 * mission.value(f"{section}.flat.led_width", "nm") / _FWHM)


def _level(scene: Scene) -> float:
    level = scene.value("flat.signal", "electron")
    return level * efficiency_of_scene(scene, scene.lamp) if scene.section in LAMPS else level


def _parameters(scene: Scene) -> tuple[float, Frame, Frame]:
    return _level(scene), *pattern(scene, scene.lamp, scene.nx, scene.ny)


EFFECT = Effect("calibration_lamp", apply, _parameters, _level, cost=1e-2)
