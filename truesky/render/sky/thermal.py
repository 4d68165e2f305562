"""Thermal light of a telescope and its instrument: grey bodies, at the level of the mission database.

A grey body of temperature T shines with e B(lambda, T), e its emissivity, and a pixel counts of it

    e A omega int R(lambda) 2 c / lambda^4 / (exp(h c / (lambda k T)) - 1) dlambda

electrons a second (A the collecting area, omega the pixel's solid angle, R the passband).  At the wavelengths of the
bands this rises by a factor of two in 2 K: the level at a reference temperature is a parameter, in which the emissivity
stands, and the formula tells what another temperature makes of it.

brightness   photons of a black body through a passband, as a logarithm
rate         electrons a second in a pixel of a band;  photons : by wavelength
"""

from __future__ import annotations

import numpy as np
from scipy.special import logsumexp

from lake_schema.arrays import Float
from lake_schema.errors import OutOfRange
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.units import LIGHT_ANGSTROM_S
from truesky.fluxes.passbands import Passband

# h c / k, A K (CODATA 2018).
_SECOND_RADIATION = 1.438776877e8
# What shines: the mirrors, and what stands between them and the detectors.
_BODIES = ("telescope", "instrument")


def brightness(band: Passband, temperature: float) -> float:
    """Natural logarithm of the photons that a black body sends through a passband, s-1 A-2 sr-1.

    A logarithm: at 95 K a band at 1 um has less than a number can hold.
    """
    if not 1.0 <= temperature <= 1000.0:
        raise OutOfRange("temperature", temperature, 1.0, 1000.0)
    occupied, weight = _spectrum(band, temperature)
    return float(logsumexp(occupied, b=weight))


def _spectrum(band: Passband, temperature: float) -> tuple[Float, Float]:
    """(a, b), [n]: exp(a) b photons of a black body at the wavelengths of a band, as of `brightness`."""
    x = _SECOND_RADIATION / (band.wavelength * temperature)
    # log(1 / (exp(x) - 1)), for any x.
    occupied = -x - np.log(-np.expm1(-x))
    step = np.gradient(band.wavelength)
    return occupied, band.response * step * 2.0 * LIGHT_ANGSTROM_S / band.wavelength**4


def rate(section: str, name: str, band: Passband, mission: MissionConfiguration) -> float:
    """Electrons a second in a pixel of a band, of telescope and instrument at their temperatures.

    section, name : of the camera in the mission database, and the band's
    band, mission : the passband, and the database
    """
    return _level(section, name, mission) * sum(part for part, _ in _body_levels(section, band, mission))


def photons(section: str, name: str, band: Passband, mission: MissionConfiguration) -> Float:
    """float64[n] electrons a second in a pixel at the wavelengths of a band, which are 1 A apart; as of `rate`.

    section, name : of the camera in the mission database, and the band's
    band, mission : the passband, and the database
    """
    total = np.zeros(len(band.wavelength))
    for part, now in _body_levels(section, band, mission):
        occupied, weight = _spectrum(band, now)
        total += part * np.exp(occupied - logsumexp(occupied, b=weight)) * weight
    return np.asarray(_level(section, name, mission) * total)


def _level(section: str, name: str, mission: MissionConfiguration) -> float:
    return mission.value(f"{section}.{name}.thermal", "electron / (s pix)")


def _body_levels(section: str, band: Passband, mission: MissionConfiguration) -> list[tuple[float, float]]:
    """(part of the level, temperature K) of each body."""
    telescope_fraction, levels = mission.value(f"{section}.thermal.telescope_part", ""), []
    for body, part in zip(_BODIES, (telescope_fraction, 1.0 - telescope_fraction), strict=True):
        now, then = (mission.value(f"{section}.thermal.{body}_{key}", "K") for key in ("temperature", "reference"))
        levels.append((part * float(np.exp(brightness(band, now) - brightness(band, then))), now))
    return levels
