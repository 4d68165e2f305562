"""Density laws of stars in the Milky Way's components, relative to the density at the Sun.

Exponential (discs) and PowerLaw (halo) are from Juric et al. 2008. OldDisc and YoungDisc (thin disc), Parabolic (thick
disc) and CoredPowerLaw (halo) are from the Besancon model of Robin et al. 2003. Bar is the bulge of Robin et al. 2012,
relative to the density at its centre.

Lengths are in pc; R, azimuth and z are Galactocentric cylindrical coordinates. The parameters are in milky_way.toml.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Float


@dataclass(frozen=True, slots=True)
class Sun:
    """Distance of the Sun from the Galactic centre, and height above the plane, pc."""

    radius: float
    height: float


@dataclass(frozen=True, slots=True)
class Exponential:
    """Density exp(-R / length - |z| / height) in Galactocentric cylindrical coordinates R and z, pc."""

    length: float
    height: float


@dataclass(frozen=True, slots=True)
class PowerLaw:
    """Density (R^2 + (z / flattening)^2 + core^2)^(slope / 2) in Galactocentric cylindrical coordinates R and z, pc."""

    flattening: float
    slope: float
    core: float


@dataclass(frozen=True, slots=True)
class OldDisc:
    """Density exp(-sqrt(1/4 + a^2 / outer^2)) - exp(-sqrt(1/4 + a^2 / inner^2)).

    Here a^2 = R^2 + (z / flattening)^2 in Galactocentric cylindrical coordinates R and z, pc.
    """

    flattening: float
    outer: float
    inner: float


@dataclass(frozen=True, slots=True)
class YoungDisc:
    """Density exp(-a^2 / outer^2) - exp(-a^2 / inner^2).

    Here a^2 = R^2 + (z / flattening)^2 in Galactocentric cylindrical coordinates R and z, pc.
    """

    flattening: float
    outer: float
    inner: float


@dataclass(frozen=True, slots=True)
class Parabolic:
    """Density exp(-R / length) times a function of z: a parabola up to |z| = joint, then an exponential.

    R and z are Galactocentric cylindrical coordinates, pc. The function of z and its derivative are continuous. The
    exponential has the scale height `height`.
    """

    length: float
    height: float
    joint: float


@dataclass(frozen=True, slots=True)
class CoredPowerLaw:
    """Density max(a, core)^slope.

    Here a^2 = R^2 + (z / flattening)^2 in Galactocentric cylindrical coordinates R and z, pc.
    """

    flattening: float
    slope: float
    core: float


@dataclass(frozen=True, slots=True)
class Bar:
    """Density sech^2(s) of a bar, where s is a distance from the centre in units of the axes of the bar.

    As seen from the Galactic centre, the near end of the bar is `angle` deg from the Sun, towards positive Galactic
    longitudes.

    Notes
    -----
    With x along the bar and y across it in the Galactic plane::

        s^parallel = [(x / length)^perpendicular + (y / width)^perpendicular]^(parallel / perpendicular)
                     + (z / height)^parallel
    """

    angle: float
    length: float
    width: float
    height: float
    parallel: float
    perpendicular: float


Law = Bar | Exponential | PowerLaw | OldDisc | YoungDisc | Parabolic | CoredPowerLaw


def density(law: Law, sun: Sun, radius: npt.ArrayLike, height: npt.ArrayLike, azimuth: npt.ArrayLike = 0.0) -> Float:
    """Return the density of a component relative to its density at the Sun (for a bar, at the centre).

    Parameters
    ----------
    law : Law
        Density law of a component.
    sun : Sun
        Position of the Sun in the Milky Way.
    radius, height : float array, any shape
        Galactocentric cylindrical coordinates R and z, pc, broadcast against each other.
    azimuth : float array, any shape
        Angle from the Sun's direction, rad, positive towards positive Galactic longitudes; only bars use it.

    Returns
    -------
    float array, broadcast shape of the arguments
        Relative density, never negative.
    """
    r, z = np.asarray(radius, float), np.asarray(height, float)
    if isinstance(law, Bar):
        return _bar_density(law, r, z, np.asarray(azimuth, float))
    at_sun = _log_density(law, np.asarray(sun.radius), np.asarray(sun.height))
    # Subtract logarithms, because the densities underflow far from the centre.
    return np.asarray(np.exp(_log_density(law, r, z) - at_sun))


def _bar_density(law: Bar, r: Float, z: Float, azimuth: Float) -> Float:
    along = azimuth - np.radians(law.angle)
    flat = np.abs(r * np.cos(along) / law.length) ** law.perpendicular
    flat = flat + np.abs(r * np.sin(along) / law.width) ** law.perpendicular
    s = (flat ** (law.parallel / law.perpendicular) + np.abs(z / law.height) ** law.parallel) ** (1.0 / law.parallel)
    # Compute sech^2(s) with exp(-s), because exp(s) overflows at large s.
    falling = np.exp(-s)
    return np.asarray((2.0 * falling / (1.0 + falling**2)) ** 2)


def _log_density(law: Law, r: Float, z: Float) -> Float:
    match law:
        case Exponential():
            return np.asarray(-r / law.length - np.abs(z) / law.height)
        case PowerLaw():
            return np.asarray(0.5 * law.slope * np.log(_a2(law.flattening, r, z) + law.core**2))
        case CoredPowerLaw():
            return np.asarray(0.5 * law.slope * np.log(np.maximum(_a2(law.flattening, r, z), law.core**2)))
        case OldDisc():
            a2 = _a2(law.flattening, r, z)
            return _log_difference(np.sqrt(0.25 + a2 / law.outer**2), np.sqrt(0.25 + a2 / law.inner**2))
        case YoungDisc():
            a2 = _a2(law.flattening, r, z)
            return _log_difference(a2 / law.outer**2, a2 / law.inner**2)
        case Bar():
            return np.asarray(np.log(_bar_density(law, r, z, np.zeros(()))))
        case Parabolic():
            return np.asarray(-r / law.length + _log_parabolic(law, np.abs(z)))


def _a2(flattening: float, r: Float, z: Float) -> Float:
    return np.asarray(r**2 + (z / flattening) ** 2)


def _log_difference(small: Float, large: Float) -> Float:
    """Return ln(exp(-small) - exp(-large)) for large >= small without underflow; -inf if both are equal."""
    with np.errstate(divide="ignore"):
        return np.asarray(-small + np.log(-np.expm1(small - large)))


def _log_parabolic(law: Parabolic, z: Float) -> Float:
    x = law.joint / law.height
    inside = np.log1p(-(np.minimum(z, law.joint) ** 2) / (law.height * law.joint * (2.0 + x)))
    return np.asarray(inside - np.maximum(z - law.joint, 0.0) / law.height)
