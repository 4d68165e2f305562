"""Light through turbulent air: long-exposure transfer function of von Karman turbulence, and refraction.

transfer      what passes, by the distance of two points of the pupil
fried_length  that of a seeing;  fwhm : the seeing of it;  finest : the least that there is
refraction    how far a wavelength is lifted towards the zenith
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from scipy.optimize import brentq
from scipy.special import gamma, j0, kv

from lake_schema.arrays import Float
from lake_schema.errors import OutOfRange

_ARCSEC = np.pi / 180.0 / 3600.0
# Half the phase structure function at large distances over (outer / fried)^(5/3), and what the Bessel term tends to at
# small ones.
_STRENGTH = (24.0 * gamma(1.2) / 5.0) ** (5.0 / 6.0) * gamma(11.0 / 6.0) / (2.0 ** (5.0 / 6.0) * np.pi ** (8.0 / 3.0))
_AT_ONE_PLACE = gamma(5.0 / 6.0) / 2.0 ** (1.0 / 6.0)
# Fried lengths over the outer scale that are looked at.
_SHORTEST, _LONGEST = 1e-5, 0.05
# Of the integral over the pupil's distances: as far as fried lengths, and its steps.
_FARTHEST, _STEPS = 6.0, 600
# Scale height of the pressure, m, that at sea level, mm Hg; temperature in C and water vapour in mm Hg of mountain tops
# at night (Filippenko 1982).
_SCALE_HEIGHT, _PRESSURE, _TEMPERATURE, _VAPOUR = 8400.0, 760.0, 7.0, 8.0


def transfer(distance: Float, fried: float, outer: float) -> Float:
    """exp(-D / 2) with the structure function D of the phase, von Karman's: 1 at no distance.

    distance : [...] m;  fried, outer : Fried length and outer scale, m
    Ref      : Tokovinin 2002, PASP 114, 1156, eq. 8
    """
    x = np.maximum(2.0 * np.pi * np.abs(distance) / outer, 1e-12)
    lost = _STRENGTH * (outer / fried) ** (5.0 / 3.0) * (_AT_ONE_PLACE - x ** (5.0 / 6.0) * kv(5.0 / 6.0, x))
    return np.asarray(np.exp(-np.maximum(lost, 0.0)))


def fwhm(wavelength: float, fried: float, outer: float) -> float:
    """Of the image of a point, arcsec; wavelength : A;  fried, outer : m.  Error: 1e-5."""
    at = fried * _FARTHEST * (np.arange(_STEPS) + 0.5) / _STEPS
    passed = transfer(at, fried, outer) * at
    # In units of wavelength / fried.
    half = brentq(lambda r: float((passed * (j0(2.0 * np.pi * r * at / fried) - 0.5)).sum()), 0.02, 0.6, xtol=1e-9)
    return 2.0 * float(half) * wavelength * 1e-10 / fried / _ARCSEC


@lru_cache(maxsize=256)
def finest_seeing(wavelength: float, outer: float) -> float:
    """The least FWHM, arcsec, that is looked for; wavelength : A;  outer : outer scale, m."""
    return fwhm(wavelength, _LONGEST * outer, outer)


@lru_cache(maxsize=256)
def fried_length(seeing: float, wavelength: float, outer: float) -> float:
    """Fried length, m, of air through which a point has a FWHM of `seeing`.

    seeing : arcsec;  wavelength : A;  outer : outer scale, m
    Errors : OutOfRange for a seeing that the turbulence does not make
    """
    ends = tuple(ratio * outer for ratio in (_SHORTEST, _LONGEST))
    worst, best = fwhm(wavelength, ends[0], outer), finest_seeing(wavelength, outer)
    if not best <= seeing <= worst:
        raise OutOfRange("seeing, arcsec", seeing, best, worst)
    # Of an infinite outer scale the length would be this: it is between that and half of it but for the sharpest.
    estimate = 0.976 * wavelength * 1e-10 / (seeing * _ARCSEC)
    low, high = (max(ends[0], 0.4 * estimate), min(ends[1], 1.02 * estimate))
    length = brentq(lambda fried: np.log(fwhm(wavelength, float(fried), outer) / seeing), low, high, rtol=1e-7)
    return float(length)


def refraction(wavelength: Float, height: float) -> Float:
    """Refraction towards the zenith at a zenith distance of 45 deg, arcsec: it goes with the tangent.

    wavelength : [...] A, in vacuum;  height : of the observatory, m
    Error : 1 % from the weather
    Ref   : Filippenko 1982, PASP 94, 715, eqs. 1 to 4
    """
    wave_number2 = (1e4 / wavelength) ** 2
    pressure, warm = _PRESSURE * np.exp(-height / _SCALE_HEIGHT), 1.0 + 0.003661 * _TEMPERATURE
    dry = 64.328 + 29498.1 / (146.0 - wave_number2) + 255.4 / (41.0 - wave_number2)
    dry *= pressure * (1.0 + (1.049 - 0.0157 * _TEMPERATURE) * 1e-6 * pressure) / (720.883 * warm)
    wet = _VAPOUR * (0.0624 - 0.000680 * wave_number2) / warm
    return np.asarray((dry - wet) * 1e-6 / _ARCSEC)
