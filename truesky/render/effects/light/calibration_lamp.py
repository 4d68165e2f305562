"""Light of flats: one LED of the calibration unit, or the lamp of a dome, illuminates the detector unevenly.

LEDs have different wavelengths, so that a band detects different fractions of their photons. A dome has one lamp, which
has the same signal in all bands.
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

# Full width at half maximum of a Gaussian in standard deviations.
_FWHM = 2.0 * np.sqrt(2.0 * np.log(2.0))


def apply(frame: Frame, level: float, columns: Frame, rows: Frame, rng: np.random.Generator | None = None) -> Frame:
    """Add the light of a lamp.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Expected electrons.
    level : float
        Expected electrons of the lamp where its pattern is 1, 0 to 1e9.
    columns : float array, shape (nx,)
        Term of the pattern that depends on the column.
    rows : float array, shape (ny,)
        Term of the pattern that depends on the row. The pattern is 1 + columns + rows.
    rng : numpy.random.Generator, optional
        Not used.

    Returns
    -------
    float array, shape (ny, nx)
        Expected electrons including the lamp.

    Raises
    ------
    OutOfRange
        If `level` is outside its limits.
    """
    if not 0.0 <= level <= 1e9:
        raise OutOfRange("lamp", level, 0.0, 1e9)
    return np.asarray(frame + level * illumination.apply(np.ones(frame.shape), columns, rows))


def pattern(scene: Scene, led: int, nx: int, ny: int) -> tuple[Frame, Frame]:
    """Illumination by an LED: a paraboloid and a slope whose direction depends on the LED's position in the unit.

    Parameters
    ----------
    scene : Scene
        The exposure, with the parameters of the calibration unit.
    led : int
        Number of the LED, from 1.
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
        If the camera has no LED with this number.
    """
    leds = lamps.count(scene.section)
    if not 1 <= led <= leds:
        raise OutOfRange("LED", led, 1, leds)
    angle = 2.0 * np.pi * (led - 1) / leds
    slope = scene.value("flat.gradient", "")
    direction = (slope * float(np.cos(angle)), slope * float(np.sin(angle)))
    return illumination.pattern(scene, nx, ny, scene.value("flat.illumination", ""), direction)


def efficiency_of_scene(scene: Scene, led: int) -> float:
    """Return the efficiency of an LED in the band of the scene, see `led_efficiency`."""
    band = scene.band or passbands.load(LAMPS[scene.section][1][0])
    return led_efficiency(band, led, scene.section, scene.mission)


def led_efficiency(band: Passband, led: int, section: str, mission: MissionConfiguration) -> float:
    """Fraction of an LED's photons that a band detects, relative to the highest response of the embedded bands.

    Parameters
    ----------
    band : Passband
        Passband.
    led : int
        Number of the LED, from 1.
    section : str
        Camera in the mission database, "vis" or "nisp".
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    float
        Relative efficiency, dimensionless.

    Raises
    ------
    OutOfRange
        If the camera has no LED with this number.

    Notes
    -----
    The spectrum of an LED is a Gaussian with its central wavelength and width.
    """
    width = _width(section, mission)
    detected = float(np.sum(detected_photons(band, led, section, mission)) / (width * np.sqrt(2.0 * np.pi)))
    return detected / _best_response(section)


@cache
def _best_response(section: str) -> float:
    """Return the highest response of the embedded bands of a camera."""
    return max(float(passbands.load(name).response.max()) for name in LAMPS[section][1])


def detected_photons(band: Passband, led: int, section: str, mission: MissionConfiguration) -> Float:
    """Relative number of an LED's photons that a band detects, by wavelength.

    Parameters
    ----------
    band : Passband
        Passband.
    led : int
        Number of the LED, from 1.
    section : str
        Camera in the mission database, "vis" or "nisp".
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    float64 array, shape (n,)
        Detected photons at the wavelengths of `band` (steps of 1 Angstrom), in arbitrary units.

    Raises
    ------
    OutOfRange
        If the camera has no LED with this number.
    """
    leds, _ = LAMPS[section]
    if not 1 <= led <= leds:
        raise OutOfRange("LED", led, 1, leds)
    offset = (band.wavelength - 10.0 * mission.value(f"{section}.flat.led_{led}", "nm")) / _width(section, mission)
    return np.asarray(band.response * np.exp(-0.5 * offset**2))


def _width(section: str, mission: MissionConfiguration) -> float:
    """Standard deviation of an LED's spectrum in Angstrom."""
    return float(10.0 * mission.value(f"{section}.flat.led_width", "nm") / _FWHM)


def _level(scene: Scene) -> float:
    level = scene.value("flat.signal", "electron")
    return level * efficiency_of_scene(scene, scene.lamp) if scene.section in LAMPS else level


def _parameters(scene: Scene) -> tuple[float, Frame, Frame]:
    return _level(scene), *pattern(scene, scene.lamp, scene.nx, scene.ny)


EFFECT = Effect("calibration_lamp", apply, _parameters, _level, cost=1e-2)
