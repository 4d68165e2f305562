"""Thermal light that a telescope and its instrument emit, as grey bodies scaled to a level in the mission database.

A grey body of temperature T and emissivity e emits e B(lambda, T). A pixel detects, in electrons per second::

    e A omega int R(lambda) 2 c / lambda^4 / (exp(h c / (lambda k T)) - 1) dlambda

where A is the collecting area, omega the solid angle of the pixel and R the passband. In the near-infrared bands this
light doubles within 2 K. The mission database therefore has the level (electrons per second and pixel) at a reference
temperature, which includes the emissivity. The equation scales the level to other temperatures.
"""

from __future__ import annotations

import numpy as np
import scipy

from lake_schema.arrays import Float
from lake_schema.errors import OutOfRange
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.units import LIGHT_ANGSTROM_S
from truesky.fluxes.passbands import Passband

# Second radiation constant h c / k in angstrom K (CODATA 2018).
_SECOND_RADIATION = 1.438776877e8
# Bodies that emit thermal light: the mirrors ("telescope"), and everything between them and the detectors.
_BODIES = ("telescope", "instrument")


def brightness(band: Passband, temperature: float) -> float:
    """Return the natural logarithm of the number of photons that a black body emits through a passband.

    The number is per second, square angstrom of surface and steradian (s-1 A-2 sr-1). `temperature` is in K. The
    logarithm avoids underflow: at 15 K and 1 um the number is too small for a float.

    Raises
    ------
    OutOfRange
        If the temperature is not between 1 and 1000 K.
    """
    if not 1.0 <= temperature <= 1000.0:
        raise OutOfRange("temperature", temperature, 1.0, 1000.0)
    occupied, weight = _spectrum(band, temperature)
    return float(scipy.special.logsumexp(occupied, b=weight))


def _spectrum(band: Passband, temperature: float) -> tuple[Float, Float]:
    """Return arrays a and b of shape (n,), so that exp(a) b are the black-body photons at each wavelength of a band.

    The numbers are per wavelength step and in s-1 A-2 sr-1 (A-2 is per square angstrom of surface). The logarithm of
    their sum is the result of `brightness`. `temperature` is in K.
    """
    x = _SECOND_RADIATION / (band.wavelength * temperature)
    # `occupied` is the natural logarithm of 1 / (exp(x) - 1) for x = h c / (lambda k T), in a form that does not
    # overflow for any x.
    occupied = -x - np.log(-np.expm1(-x))
    step = np.gradient(band.wavelength)
    return occupied, band.response * step * 2.0 * LIGHT_ANGSTROM_S / band.wavelength**4


def rate(section: str, name: str, band: Passband, mission: MissionConfiguration) -> float:
    """Return the rate of thermal light in a band, for the temperatures of telescope and instrument.

    Parameters
    ----------
    section : str
        Beginning of the camera's parameter names in the mission database, such as "nisp".
    name : str
        Name of the band in the mission database.
    band : Passband
        Response of the band as a function of wavelength.
    mission : MissionConfiguration
        Mission database, with the temperatures and the level at the reference temperatures.

    Returns
    -------
    float
        Electrons per second and pixel.
    """
    return _level(section, name, mission) * sum(part for part, _ in _body_levels(section, band, mission))


def photons(section: str, name: str, band: Passband, mission: MissionConfiguration) -> Float:
    """Return the spectrum of thermal light at the wavelengths of a band, which are 1 Angstrom apart.

    Parameters
    ----------
    section : str
        Beginning of the camera's parameter names in the mission database, such as "nisp".
    name : str
        Name of the band in the mission database.
    band : Passband
        Response of the band as a function of wavelength.
    mission : MissionConfiguration
        Mission database, with the temperatures and the level at the reference temperatures.

    Returns
    -------
    float array, shape (n,)
        Electrons per second and pixel in each Angstrom; their sum is the result of `rate`.
    """
    total = np.zeros(len(band.wavelength))
    for part, now in _body_levels(section, band, mission):
        occupied, weight = _spectrum(band, now)
        total += part * np.exp(occupied - scipy.special.logsumexp(occupied, b=weight)) * weight
    return np.asarray(_level(section, name, mission) * total)


def _level(section: str, name: str, mission: MissionConfiguration) -> float:
    return mission.value(f"{section}.{name}.thermal", "electron / (s pix)")


def _body_levels(section: str, band: Passband, mission: MissionConfiguration) -> list[tuple[float, float]]:
    """Return (relative thermal light, temperature in K) for the telescope, then for the instrument.

    The relative light is that of one of them at its present temperature. It is divided by the light of telescope and
    instrument together at the reference temperatures of the mission database.
    """
    telescope_fraction, levels = mission.value(f"{section}.thermal.telescope_part", ""), []
    for body, part in zip(_BODIES, (telescope_fraction, 1.0 - telescope_fraction), strict=True):
        now, then = (mission.value(f"{section}.thermal.{body}_{key}", "K") for key in ("temperature", "reference"))
        levels.append((part * float(np.exp(brightness(band, now) - brightness(band, then))), now))
    return levels
