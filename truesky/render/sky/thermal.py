"""Thermal light of a telescope and its instrument: grey bodies, scaled to the level in the mission database.

A grey body of temperature T and emissivity e emits e B(lambda, T). A pixel detects, in electrons per second::

    e A omega int R(lambda) 2 c / lambda^4 / (exp(h c / (lambda k T)) - 1) dlambda

where A is the collecting area, omega the solid angle of the pixel and R the passband. At the wavelengths of the bands
this doubles within 2 K. The level at a reference temperature, which includes the emissivity, is therefore a parameter,
and the equation scales it to other temperatures.
"""

from __future__ import annotations

import numpy as np
from scipy.special import logsumexp

from lake_schema.arrays import Float
from lake_schema.errors import OutOfRange
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.units import LIGHT_ANGSTROM_S
from truesky.fluxes.passbands import Passband

# Constant h c / k, Angstrom K (CODATA 2018).
_SECOND_RADIATION = 1.438776877e8
# Emitting bodies: the mirrors, and everything between them and the detectors.
_BODIES = ("telescope", "instrument")


def brightness(band: Passband, temperature: float) -> float:
    """Natural logarithm of the photons that a black body emits through a passband, s-1 A-2 sr-1.

    At 95 K the number itself is too small for a float in a band at 1 um.

    Raises
    ------
    OutOfRange
        If the temperature is not between 1 and 1000 K.
    """
    if not 1.0 <= temperature <= 1000.0:
        raise OutOfRange("temperature", temperature, 1.0, 1000.0)
    occupied, weight = _spectrum(band, temperature)
    return float(logsumexp(occupied, b=weight))


def _spectrum(band: Passband, temperature: float) -> tuple[Float, Float]:
    """Arrays a and b [n] with exp(a) b photons of a black body at a band's wavelengths, in the unit of `brightness`."""
    x = _SECOND_RADIATION / (band.wavelength * temperature)
    # This is log(1 / (exp(x) - 1)), without overflow for any x.
    occupied = -x - np.log(-np.expm1(-x))
    step = np.gradient(band.wavelength)
    return occupied, band.response * step * 2.0 * LIGHT_ANGSTROM_S / band.wavelength**4


def rate(section: str, name: str, band: Passband, mission: MissionConfiguration) -> float:
    """Thermal electrons per second and pixel of a band, for the temperatures of telescope and instrument.

    Parameters
    ----------
    section : str
        Prefix of the camera in the mission database.
    name : str
        Name of the band.
    band : Passband
        The passband.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    float
        Electrons per second and pixel.
    """
    return _level(section, name, mission) * sum(part for part, _ in _body_levels(section, band, mission))


def photons(section: str, name: str, band: Passband, mission: MissionConfiguration) -> Float:
    """Thermal electrons per second and pixel at the wavelengths of a band, which are 1 Angstrom apart.

    Parameters
    ----------
    section : str
        Prefix of the camera in the mission database.
    name : str
        Name of the band.
    band : Passband
        The passband.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    float array, shape (n,)
        Electrons per second and pixel; the sum is `rate`.
    """
    total = np.zeros(len(band.wavelength))
    for part, now in _body_levels(section, band, mission):
        occupied, weight = _spectrum(band, now)
        total += part * np.exp(occupied - logsumexp(occupied, b=weight)) * weight
    return np.asarray(_level(section, name, mission) * total)


def _level(section: str, name: str, mission: MissionConfiguration) -> float:
    return mission.value(f"{section}.{name}.thermal", "electron / (s pix)")


def _body_levels(section: str, band: Passband, mission: MissionConfiguration) -> list[tuple[float, float]]:
    """Contribution to the level, and temperature in K, of each body."""
    telescope_fraction, levels = mission.value(f"{section}.thermal.telescope_part", ""), []
    for body, part in zip(_BODIES, (telescope_fraction, 1.0 - telescope_fraction), strict=True):
        now, then = (mission.value(f"{section}.thermal.{body}_{key}", "K") for key in ("temperature", "reference"))
        levels.append((part * float(np.exp(brightness(band, now) - brightness(band, then))), now))
    return levels
