"""Long-exposure transfer function of von Karman turbulence, and atmospheric refraction."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.optimize import brentq
from scipy.special import gamma, j0, kv

from lake_schema.arrays import Float
from lake_schema.errors import OutOfRange

_ARCSEC = np.pi / 180.0 / 3600.0
# Half the phase structure function at large distances, divided by (outer / fried)^(5/3); and the limit of the Bessel
# term at small distances.
_STRENGTH = (24.0 * gamma(1.2) / 5.0) ** (5.0 / 6.0) * gamma(11.0 / 6.0) / (2.0 ** (5.0 / 6.0) * np.pi ** (8.0 / 3.0))
_AT_ONE_PLACE = gamma(5.0 / 6.0) / 2.0 ** (1.0 / 6.0)
# Smallest and largest Fried length, divided by the outer scale.
_SHORTEST, _LONGEST = 1e-5, 0.05
# Integral over distances in the pupil: upper limit in Fried lengths, and number of steps.
_FARTHEST, _STEPS = 6.0, 600
# Scale height of the pressure, m, and pressure at sea level, mm Hg; temperature in deg C and water vapour pressure in
# mm Hg of mountain tops at night (Filippenko 1982).
_SCALE_HEIGHT, _PRESSURE, _TEMPERATURE, _VAPOUR = 8400.0, 760.0, 7.0, 8.0


def transfer(distance: Float, fried: float, outer: float) -> Float:
    """Transfer function exp(-D / 2) of turbulent air, with von Karman's structure function D of the phase.

    Parameters
    ----------
    distance : float array
        Distance in the pupil, m.
    fried : float
        Fried length, m.
    outer : float
        Outer scale, m.

    Returns
    -------
    float array
        Transfer function, 1 at distance 0.

    References
    ----------
    Tokovinin 2002, PASP 114, 1156, eq. 8.
    """
    x = np.maximum(2.0 * np.pi * np.abs(distance) / outer, 1e-12)
    lost = _STRENGTH * (outer / fried) ** (5.0 / 3.0) * (_AT_ONE_PLACE - x ** (5.0 / 6.0) * kv(5.0 / 6.0, x))
    return np.asarray(np.exp(-np.maximum(lost, 0.0)))


def fwhm(wavelength: float, fried: float, outer: float) -> float:
    """FWHM of the image of a point source through turbulent air.

    Parameters
    ----------
    wavelength : float
        Wavelength, Angstrom.
    fried : float
        Fried length, m.
    outer : float
        Outer scale, m.

    Returns
    -------
    float
        FWHM, arcsec, with an error of 1e-5.
    """
    at = fried * _FARTHEST * (np.arange(_STEPS) + 0.5) / _STEPS
    passed = transfer(at, fried, outer) * at
    # Half the FWHM in units of wavelength / fried.
    half = brentq(lambda r: float((passed * (j0(2.0 * np.pi * r * at / fried) - 0.5)).sum()), 0.02, 0.6, xtol=1e-9)
    return 2.0 * float(half) * wavelength * 1e-10 / fried / _ARCSEC


@lru_cache(maxsize=256)
def finest_seeing(wavelength: float, outer: float) -> float:
    """Smallest FWHM that is allowed for a wavelength (Angstrom) and an outer scale (m), arcsec."""
    return fwhm(wavelength, _LONGEST * outer, outer)


@lru_cache(maxsize=256)
def fried_length(seeing: float, wavelength: float, outer: float) -> float:
    """Fried length of air with a given seeing.

    Parameters
    ----------
    seeing : float
        FWHM of a point source, arcsec.
    wavelength : float
        Wavelength, Angstrom.
    outer : float
        Outer scale, m.

    Returns
    -------
    float
        Fried length, m.

    Raises
    ------
    OutOfRange
        If turbulence of this outer scale cannot cause the seeing.
    """
    ends = tuple(ratio * outer for ratio in (_SHORTEST, _LONGEST))
    worst, best = fwhm(wavelength, ends[0], outer), finest_seeing(wavelength, outer)
    if not best <= seeing <= worst:
        raise OutOfRange("seeing, arcsec", seeing, best, worst)
    # For an infinite outer scale this is the Fried length. The true length lies between it and half of it, except in
    # the best seeing.
    estimate = 0.976 * wavelength * 1e-10 / (seeing * _ARCSEC)
    low, high = (max(ends[0], 0.4 * estimate), min(ends[1], 1.02 * estimate))
    length = brentq(lambda fried: np.log(fwhm(wavelength, float(fried), outer) / seeing), low, high, rtol=1e-7)
    return float(length)


def refraction(wavelength: Float, height: float) -> Float:
    """Refraction towards the zenith at a zenith distance of 45 deg; it is proportional to the tangent.

    Parameters
    ----------
    wavelength : float array
        Vacuum wavelength, Angstrom.
    height : float
        Height of the observatory, m.

    Returns
    -------
    float array
        Refraction, arcsec, to 1 % because the weather is neglected.

    References
    ----------
    Filippenko 1982, PASP 94, 715, eqs. 1 to 4.
    """
    wave_number2 = (1e4 / wavelength) ** 2
    pressure, warm = _PRESSURE * np.exp(-height / _SCALE_HEIGHT), 1.0 + 0.003661 * _TEMPERATURE
    dry = 64.328 + 29498.1 / (146.0 - wave_number2) + 255.4 / (41.0 - wave_number2)
    dry *= pressure * (1.0 + (1.049 - 0.0157 * _TEMPERATURE) * 1e-6 * pressure) / (720.883 * warm)
    wet = _VAPOUR * (0.0624 - 0.000680 * wave_number2) / warm
    return np.asarray((dry - wet) * 1e-6 / _ARCSEC)
