"""Flats: the calibration unit shines with one of its LEDs; what it lights is far from even.

Each has its own wavelengths: of as much light the band detects more or less. A dome has one
lamp, as bright in all bands.
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

# Standard deviations in a full width at half maximum.
_FWHM = 2.0 * np.sqrt(2.0 * np.log(2.0))


def apply(frame: Frame, level: float, columns: Frame, rows: Frame, rng: np.random.Generator | None = None) -> Frame:
    """frame [ny, nx] expected e- -> plus level (1 + columns [nx] + rows [ny]).

    level : expected e-;  rng : not used
    """
    if not 0.0 <= level <= 1e9:
        raise OutOfRange("lamp", level, 0.0, 1e9)
    return np.asarray(frame + level * illumination.apply(np.ones(frame.shape), columns, rows))


def pattern(scene: Scene, led: int, nx: int, ny: int) -> tuple[Frame, Frame]:
    """What an LED lights: a paraboloid, and a slope whose direction is the LED's place on the unit.

    scene : with the parameters of the unit;  led : its number;  nx, ny : pixels of the detector
    """
    leds = lamps.count(scene.section)
    if not 1 <= led <= leds:
        raise OutOfRange("LED", led, 1, leds)
    angle = 2.0 * np.pi * (led - 1) / leds
    slope = scene.value("flat.gradient", "")
    direction = (slope * float(np.cos(angle)), slope * float(np.sin(angle)))
    return illumination.pattern(scene, nx, ny, scene.value("flat.illumination", ""), direction)


def efficiency_of_scene(scene: Scene, led: int) -> float:
    """What the scene's band detects of an LED's photons, as `seen_in`."""
    band = scene.band or passbands.load(LAMPS[scene.section][1][0])
    return led_efficiency(band, led, scene.section, scene.mission)


def led_efficiency(band: Passband, led: int, section: str, mission: MissionConfiguration) -> float:
    """What a band detects of an LED's photons, over what the embedded bands would where they see best; no unit.

    led     : its number, from 1;  band : passband
    section : of the camera, "vis" or "nisp";  mission : the mission database
    Error   : the LED's spectrum is taken as a Gaussian of its central wavelength and width
    Errors  : OutOfRange for a number that no LED has
    """
    width = _width(section, mission)
    detected = float(np.sum(detected_photons(band, led, section, mission)) / (width * np.sqrt(2.0 * np.pi)))
    return detected / _best_response(section)


@cache
def _best_response(section: str) -> float:
    """The largest response of the embedded bands of a camera."""
    return max(float(passbands.load(name).response.max()) for name in LAMPS[section][1])


def detected_photons(band: Passband, led: int, section: str, mission: MissionConfiguration) -> Float:
    """float64[n] what a band detects of an LED's photons, at its wavelengths 1 A apart, on any scale; as `seen_in`.

    band, led, section, mission : of `seen_in`
    """
    leds, _ = LAMPS[section]
    if not 1 <= led <= leds:
        raise OutOfRange("LED", led, 1, leds)
    offset = (band.wavelength - 10.0 * mission.value(f"{section}.flat.led_{led}", "nm")) / _width(section, mission)
    return np.asarray(band.response * np.exp(-0.5 * offset**2))


def _width(section: str, mission: MissionConfiguration) -> float:
    """Standard deviation, A."""
    return float(10.0 * mission.value(f"{section}.flat.led_width", "nm") / _FWHM)


def _level(scene: Scene) -> float:
    level = scene.value("flat.signal", "electron")
    return level * efficiency_of_scene(scene, scene.lamp) if scene.section in LAMPS else level


def _parameters(scene: Scene) -> tuple[float, Frame, Frame]:
    return _level(scene), *pattern(scene, scene.lamp, scene.nx, scene.ny)


EFFECT = Effect("calibration_lamp", apply, _parameters, _level, cost=1e-2)
