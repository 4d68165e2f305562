"""Compute distances, volumes and ages in the flat Lambda-CDM universe of the Flagship simulation.

Distances are in Mpc/h, that is, in Mpc for H0 = 100 km/s/Mpc. Integrals use Gauss-Legendre quadrature in ln(1 + z), in
which the integrand is smooth. Results need no interpolation and are precise for small redshifts, too.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Float
from lake_schema.errors import OutOfRange
from lake_schema.units import LIGHT_KM_S
from truesky.numerics import matrices

# Parameters of the Flagship simulation (Potter, Stadel & Teyssier 2017; Serrano et al. 2024, section 4.1): density
# parameters today, Hubble parameter h, and amplitude and index of the power spectrum. It has no radiation and no
# massive neutrinos.
OMEGA_M = 0.319
OMEGA_B = 0.049
OMEGA_LAMBDA = 1.0 - OMEGA_M
HUBBLE = 0.67
SIGMA_8 = 0.83
SPECTRAL_INDEX = 0.96

HUBBLE_DISTANCE = LIGHT_KM_S / 100.0
Z_MAX = 20.0

# Nodes and weights of the quadrature. With 24 nodes the relative error of a distance is 1e-12 up to z = 20.
_NODES, _WEIGHTS = matrices.gauss_legendre(24)
# Hubble time for h = 1, 1 / (100 km/s/Mpc), in Gyr.
_HUBBLE_TIME_GYR = 9.777922
_ARCSEC = np.pi / 180.0 / 3600.0


def expansion_rate(z: npt.ArrayLike) -> Float:
    """Return E(z) = H(z) / H0 = sqrt(Om (1 + z)^3 + 1 - Om) for redshifts above -1, which are not checked."""
    a = 1.0 + np.asarray(z, float)
    return np.asarray(np.sqrt(OMEGA_M * a**3 + OMEGA_LAMBDA))


def comoving_separation(z1: npt.ArrayLike, z2: npt.ArrayLike) -> Float:
    """Return the radial comoving distance from z1 to z2 in Mpc/h, negative if z2 < z1; relative error 1e-12.

    Raises OutOfRange if a redshift is NaN or not in 0 to 20.
    """
    lo, hi = np.log1p(_check_redshift("z1", z1)), np.log1p(_check_redshift("z2", z2))
    # Half of ln((1 + z2) / (1 + z1)), from the difference of the redshifts: `hi - lo` would lose digits if they are
    # close.
    half = 0.5 * np.log1p((np.asarray(z2, float) - np.asarray(z1, float)) / (1.0 + np.asarray(z1, float)))
    middle = 0.5 * (lo + hi)
    total = np.zeros(np.broadcast(lo, hi).shape)
    for node, weight in zip(_NODES, _WEIGHTS, strict=True):
        a = np.exp(middle + half * node)
        total += weight * a / np.sqrt(OMEGA_M * a**3 + OMEGA_LAMBDA)
    return np.asarray(HUBBLE_DISTANCE * half * total)


def comoving_distance(z: npt.ArrayLike) -> Float:
    """Return the comoving distance in Mpc/h to redshift z; raises OutOfRange if z is NaN or not in 0 to 20."""
    return comoving_separation(0.0, z)


def luminosity_distance(z: npt.ArrayLike) -> Float:
    """Return the luminosity distance in Mpc/h (divide by h = 0.67 for Mpc).

    Raises OutOfRange if z is NaN or not in 0 to 20.
    """
    return (1.0 + np.asarray(z, float)) * comoving_distance(z)


def distance_modulus(z: npt.ArrayLike) -> Float:
    """Return the distance modulus 5 log10(d_L / 10 pc) for H0 = 100 km/s/Mpc; -inf at z = 0.

    Add it to an absolute magnitude M - 5 log10 h. Raises OutOfRange if z is NaN or not in 0 to 20.
    """
    with np.errstate(divide="ignore"):
        return np.asarray(5.0 * np.log10(luminosity_distance(z)) + 25.0)


def comoving_volume(z1: npt.ArrayLike, z2: npt.ArrayLike) -> Float:
    """Return the comoving volume per steradian between z1 and z2 in (Mpc/h)^3, negative if z2 < z1.

    Raises OutOfRange if a redshift is NaN or not in 0 to 20.
    """
    inner, depth = comoving_distance(z1), comoving_separation(z1, z2)
    outer = inner + depth
    return depth * (inner**2 + inner * outer + outer**2) / 3.0


def redshift(chi: npt.ArrayLike) -> Float:
    """Return the redshift at the comoving distance `chi` in Mpc/h, up to z = 20, with relative error 1e-10.

    Raises
    ------
    OutOfRange
        If a distance is negative, NaN or beyond z = 20.
    """
    distance = np.asarray(chi, float)
    limit = float(comoving_distance(Z_MAX))
    bad = ~((distance >= 0.0) & (distance <= limit * (1 + 1e-12)))
    if bad.any():
        raise OutOfRange("comoving distance", float(distance[bad].ravel()[0]), 0.0, limit)
    grid = np.expm1(np.linspace(0.0, np.log1p(Z_MAX), 512))
    z = np.interp(distance, comoving_distance(grid), grid)
    # Improve the interpolated redshifts, with errors up to 1e-3, by Newton's method: each iteration squares the error.
    for _ in range(2):
        error = comoving_distance(z) - distance
        z = np.clip(z - error / HUBBLE_DISTANCE * expansion_rate(z), 0.0, Z_MAX)
    return np.asarray(z)


def kpc_per_arcsec(z: npt.ArrayLike) -> Float:
    """Return the physical length in kpc (for h = 0.67) that one arcsec spans at redshift z, 0 at z = 0.

    Raises OutOfRange if z is NaN or not in 0 to 20.
    """
    angular = comoving_distance(z) / (1.0 + np.asarray(z, float))
    return angular * (1000.0 / HUBBLE * _ARCSEC)


def age(z: npt.ArrayLike, omega_m: float = OMEGA_M, hubble: float = HUBBLE) -> Float:
    """Return the age of a flat universe at redshift z in Gyr, in closed form.

    Parameters
    ----------
    z : array_like
        Redshift, above -1, which is not checked.
    omega_m : float, optional
        Matter density parameter today, by default that of the Flagship simulation.
    hubble : float, optional
        Hubble parameter h, by default that of the Flagship simulation.

    Returns
    -------
    float array
        Age in Gyr, in the shape of `z`.
    """
    rest = 1.0 - omega_m
    ratio = np.sqrt(rest / omega_m) * (1.0 + np.asarray(z, float)) ** -1.5
    return np.asarray(2.0 / (3.0 * np.sqrt(rest)) * np.arcsinh(ratio) * _HUBBLE_TIME_GYR / hubble)


def _check_redshift(name: str, z: npt.ArrayLike) -> Float:
    values = np.asarray(z, float)
    bad = ~((values >= 0.0) & (values <= Z_MAX))
    if bad.any():
        raise OutOfRange(name, float(values[bad].ravel()[0]), 0.0, Z_MAX)
    return values
