"""Transfer function of turbulent air (von Karman turbulence) in long exposures, and atmospheric refraction."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import scipy

from lake_schema.arrays import Float
from lake_schema.errors import OutOfRange

# Radian per arcsec.
_ARCSEC = np.pi / 180.0 / 3600.0
# Smallest Fried length that is allowed (the worst seeing), divided by the outer scale of the turbulence. A seeing
# outside the range raises OutOfRange.
_SHORTEST = 1e-5
# Largest Fried length that is allowed (the best seeing), divided by the outer scale of the turbulence.
_LONGEST = 0.05
# Half of the FWHM of the best seeing that is allowed, in units of wavelength / Fried length. It is the root that `fwhm`
# finds for a Fried length of `_LONGEST` times the outer scale, with which scipy.optimize is not imported for checks.
_SHARPEST = 0.2409324370068859
# Upper limit, in Fried lengths, of the integral over distances in the pupil by which the FWHM of the seeing is
# computed. At larger distances the air transmits practically nothing.
_FARTHEST = 6.0
# Number of steps of the integral over distances in the pupil by which the FWHM of the seeing is computed.
_STEPS = 600
# Height over which the air pressure falls by the factor e, m.
_SCALE_HEIGHT = 8400.0
# Air pressure at sea level, mm Hg.
_SEA_LEVEL_PRESSURE = 760.0
# Temperature on mountain tops at night, deg C (Filippenko 1982).
TEMPERATURE = 7.0
# Pressure of water vapour on mountain tops at night, mm Hg (Filippenko 1982).
_VAPOUR = 8.0


def transfer(distance: Float, fried: float, outer: float) -> Float:
    """Return the transfer function exp(-D / 2) of turbulent air in a long exposure.

    D is the structure function of the phase for von Karman turbulence: the mean square difference of the phase between
    two points in the pupil, as a function of their distance.

    Parameters
    ----------
    distance : float array
        Distance of two points in the pupil, m: wavelength times spatial frequency. The sign is ignored.
    fried : float
        Fried length at this wavelength, m.
    outer : float
        Outer scale of the turbulence, m.

    Returns
    -------
    float array
        Transfer function in the shape of `distance`, 1 at distance 0.

    References
    ----------
    Tokovinin 2002, PASP 114, 1156, eq. 8.
    """
    x = np.maximum(2.0 * np.pi * np.abs(distance) / outer, 1e-12)
    # Factor by which (outer scale / Fried length)^(5/3) is multiplied in D / 2.
    strength = (
        (24.0 * scipy.special.gamma(1.2) / 5.0) ** (5.0 / 6.0)
        * scipy.special.gamma(11.0 / 6.0)
        / (2.0 ** (5.0 / 6.0) * np.pi ** (8.0 / 3.0))
    )
    # Limit of x^(5/6) K_5/6(x) for x = 0, where K_5/6 is the modified Bessel function of the second kind, of order 5/6.
    at_one_place = scipy.special.gamma(5.0 / 6.0) / 2.0 ** (1.0 / 6.0)
    lost = (
        strength * (outer / fried) ** (5.0 / 3.0) * (at_one_place - x ** (5.0 / 6.0) * scipy.special.kv(5.0 / 6.0, x))
    )
    return np.asarray(np.exp(-np.maximum(lost, 0.0)))


def fwhm(wavelength: float, fried: float, outer: float) -> float:
    """Return the FWHM of the image of a point source through turbulent air, for a very large telescope.

    Parameters
    ----------
    wavelength : float
        Wavelength, Angstrom.
    fried : float
        Fried length at this wavelength, m, between 1e-5 and 0.05 times the outer scale; this is not checked.
    outer : float
        Outer scale of the turbulence, m.

    Returns
    -------
    float
        FWHM, arcsec, with a relative error of 2e-5, or of 1e-3 for a Fried length above 0.03 times the outer scale:
        the air then transmits some light over more than 6 Fried lengths.
    """
    at = fried * _FARTHEST * (np.arange(_STEPS) + 0.5) / _STEPS
    passed = transfer(at, fried, outer) * at
    # The root r is half of the FWHM, in units of wavelength / Fried length: the surface brightness at the angle r is
    # half of that in the centre.
    half = scipy.optimize.brentq(
        lambda r: float((passed * (scipy.special.j0(2.0 * np.pi * r * at / fried) - 0.5)).sum()), 0.02, 0.6, xtol=1e-9
    )
    return 2.0 * float(half) * wavelength * 1e-10 / fried / _ARCSEC


def finest_seeing(wavelength: float, outer: float) -> float:
    """Return the smallest seeing (FWHM in arcsec) that this module can compute at a wavelength in Angstrom.

    It is the seeing through air whose Fried length is 0.05 times the outer scale of the turbulence. `outer` is this
    outer scale in m.
    """
    return 2.0 * _SHARPEST * wavelength * 1e-10 / (_LONGEST * outer) / _ARCSEC


@lru_cache(maxsize=256)
def fried_length(seeing: float, wavelength: float, outer: float) -> float:
    """Return the Fried length of turbulent air with a given seeing.

    Parameters
    ----------
    seeing : float
        FWHM of a point source at this wavelength, arcsec.
    wavelength : float
        Wavelength, Angstrom.
    outer : float
        Outer scale of the turbulence, m.

    Returns
    -------
    float
        Fried length at this wavelength, m.

    Raises
    ------
    OutOfRange
        If the Fried length would be outside 1e-5 to 0.05 times the outer scale.
    """
    ends = tuple(ratio * outer for ratio in (_SHORTEST, _LONGEST))
    worst, best = (fwhm(wavelength, end, outer) for end in ends)
    if not best <= seeing <= worst:
        raise OutOfRange("seeing, arcsec", seeing, best, worst)
    # `estimate` is the Fried length for an infinite outer scale. With a finite outer scale, the Fried length lies
    # between 0.4 and 1.02 times this value.
    estimate = 0.976 * wavelength * 1e-10 / (seeing * _ARCSEC)
    low, high = (max(ends[0], 0.4 * estimate), min(ends[1], 1.02 * estimate))
    length = scipy.optimize.brentq(
        lambda fried: np.log(fwhm(wavelength, float(fried), outer) / seeing), low, high, rtol=1e-7
    )
    return float(length)


def pressure(height: float) -> float:
    """Return the mean air pressure in mm Hg at a height above sea level in metres."""
    return float(_SEA_LEVEL_PRESSURE * np.exp(-height / _SCALE_HEIGHT))


def refraction(wavelength: Float, height: float) -> Float:
    """Return the atmospheric refraction of a source at a zenith distance of 45 deg.

    Parameters
    ----------
    wavelength : float array
        Vacuum wavelength, Angstrom.
    height : float
        Height of the observatory above sea level, m.

    Returns
    -------
    float array
        Angle by which the source appears displaced towards the zenith, arcsec, in the shape of `wavelength`. To get the
        angle at another zenith distance z, multiply it by tan(z). The error is 1 %, because the weather is neglected.

    References
    ----------
    Filippenko 1982, PASP 94, 715, eqs. 1 to 4.
    """
    wave_number2 = (1e4 / wavelength) ** 2
    air, warm = pressure(height), 1.0 + 0.003661 * TEMPERATURE
    dry = 64.328 + 29498.1 / (146.0 - wave_number2) + 255.4 / (41.0 - wave_number2)
    dry *= air * (1.0 + (1.049 - 0.0157 * TEMPERATURE) * 1e-6 * air) / (720.883 * warm)
    wet = _VAPOUR * (0.0624 - 0.000680 * wave_number2) / warm
    return np.asarray((dry - wet) * 1e-6 / _ARCSEC)
