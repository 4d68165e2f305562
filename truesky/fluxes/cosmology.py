"""Distances in the flat Lambda-CDM universe of the Flagship simulation, in Mpc/h (H0 = 100 km/s/Mpc).

All by Gauss-Legendre quadrature in ln(1 + z), where the integrand is smooth: no table, and exact at small z.

expansion_rate          E(z) = H(z) / H0
comoving_distance       chi(z)
comoving_separation     chi(z2) - chi(z1), also for nearly equal redshifts
luminosity_distance     (1 + z) chi
distance_modulus        of d_L / 10 pc, with H0 = 100
comoving_volume         per steradian, between two redshifts
redshift                z of chi
kpc_per_arcsec          physical (h = 0.67)
age                     of a flat universe at z, Gyr
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Float
from lake_schema.errors import OutOfRange
from lake_schema.units import LIGHT_KM_S
from truesky.numerics import matrices

# Flagship simulation: Potter, Stadel & Teyssier 2017; Serrano et al. 2024, section 4.1. No radiation,
# no massive neutrinos.
OMEGA_M = 0.319
OMEGA_B = 0.049
OMEGA_LAMBDA = 1.0 - OMEGA_M
HUBBLE = 0.67
SIGMA_8 = 0.83
SPECTRAL_INDEX = 0.96

HUBBLE_DISTANCE = LIGHT_KM_S / 100.0
Z_MAX = 20.0

# 24 nodes: 1e-12 relative up to z = 20.
_NODES, _WEIGHTS = matrices.gauss_legendre(24)
# 1 / (100 km/s/Mpc).
_HUBBLE_TIME_GYR = 9.777922
_ARCSEC = np.pi / 180.0 / 3600.0


def expansion_rate(z: npt.ArrayLike) -> Float:
    """E(z) = sqrt(Om (1 + z)^3 + 1 - Om)."""
    a = 1.0 + np.asarray(z, float)
    return np.asarray(np.sqrt(OMEGA_M * a**3 + OMEGA_LAMBDA))


def comoving_separation(z1: npt.ArrayLike, z2: npt.ArrayLike) -> Float:
    """Radial comoving distance from z1 to z2, Mpc/h; negative if z2 < z1.  Error: 1e-12 relative."""
    lo, hi = np.log1p(_check_redshift("z1", z1)), np.log1p(_check_redshift("z2", z2))
    # ln((1 + z2) / (1 + z1)) from the difference of the redshifts, which is exact for close ones.
    half = 0.5 * np.log1p((np.asarray(z2, float) - np.asarray(z1, float)) / (1.0 + np.asarray(z1, float)))
    middle = 0.5 * (lo + hi)
    total = np.zeros(np.broadcast(lo, hi).shape)
    for node, weight in zip(_NODES, _WEIGHTS, strict=True):
        a = np.exp(middle + half * node)
        total += weight * a / np.sqrt(OMEGA_M * a**3 + OMEGA_LAMBDA)
    return np.asarray(HUBBLE_DISTANCE * half * total)


def comoving_distance(z: npt.ArrayLike) -> Float:
    """Comoving distance, Mpc/h, 0 <= z <= 20."""
    return comoving_separation(0.0, z)


def luminosity_distance(z: npt.ArrayLike) -> Float:
    """Luminosity distance, Mpc/h (multiply by 1 / 0.67 for Mpc)."""
    return (1.0 + np.asarray(z, float)) * comoving_distance(z)


def distance_modulus(z: npt.ArrayLike) -> Float:
    """5 log10(d_L / 10 pc) for H0 = 100, to go with magnitudes M - 5 log10 h; -inf at z = 0."""
    with np.errstate(divide="ignore"):
        return np.asarray(5.0 * np.log10(luminosity_distance(z)) + 25.0)


def comoving_volume(z1: npt.ArrayLike, z2: npt.ArrayLike) -> Float:
    """Comoving volume per steradian between z1 and z2, (Mpc/h)^3."""
    inner, depth = comoving_distance(z1), comoving_separation(z1, z2)
    outer = inner + depth
    return depth * (inner**2 + inner * outer + outer**2) / 3.0


def redshift(chi: npt.ArrayLike) -> Float:
    """Redshift at comoving distance chi, Mpc/h, up to z = 20.  Error: 1e-10 relative."""
    distance = np.asarray(chi, float)
    limit = float(comoving_distance(Z_MAX))
    bad = ~((distance >= 0.0) & (distance <= limit * (1 + 1e-12)))
    if bad.any():
        raise OutOfRange("comoving distance", float(distance[bad].ravel()[0]), 0.0, limit)
    grid = np.expm1(np.linspace(0.0, np.log1p(Z_MAX), 512))
    z = np.interp(distance, comoving_distance(grid), grid)
    # Newton: the interpolation is good to 1e-3 at worst, and each step squares the error.
    for _ in range(2):
        error = comoving_distance(z) - distance
        z = np.clip(z - error / HUBBLE_DISTANCE * expansion_rate(z), 0.0, Z_MAX)
    return np.asarray(z)


def kpc_per_arcsec(z: npt.ArrayLike) -> Float:
    """Physical kpc (h = 0.67) that one arcsec spans at redshift z."""
    angular = comoving_distance(z) / (1.0 + np.asarray(z, float))
    return angular * (1000.0 / HUBBLE * _ARCSEC)


def age(z: npt.ArrayLike, omega_m: float = OMEGA_M, hubble: float = HUBBLE) -> Float:
    """Age of a flat universe at z, Gyr, in closed form: ours, or that of a study whose relations are used.

    omega_m, hubble : of that universe
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
