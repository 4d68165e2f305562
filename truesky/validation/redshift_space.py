"""Multipoles of the correlation function of galaxies in redshift space, measured and from linear theory.

Notes
-----
xi_0 is the mean of the correlation function over all angles to the line of sight, and xi_2 its quadrupole. Galaxies
fall towards overdense regions, so that xi_2 is negative at large separations.

References
----------
Landy & Szalay 1993, ApJ 412, 64
Kaiser 1987, MNRAS 227, 1; Hamilton 1992, ApJ 385, L5
"""

from __future__ import annotations

import numpy as np

from lake_schema.arrays import Float, Int
from truesky.cosmology import Cosmology
from truesky.validation import pairs, theory
from truesky.validation.two_points import landy_szalay

# Number of bins of the cosine of the angle to the line of sight.
ANGLES = 20
# Wave numbers, h/Mpc, of the integral over the power spectrum, and the one at which it is cut off smoothly. The cut-off
# changes xi above 10 Mpc/h by less than 1e-3.
_K = np.geomspace(1e-4, 20.0, 20_000)
_CUT = 3.0
# Distances at which the correlation function of matter is computed, Mpc/h.
_R = np.concatenate([np.linspace(0.25, 80.0, 320), np.linspace(81.0, 250.0, 170)])


def measure_multipoles(place: Float, kind: Int, patch: Int, edges: Float) -> tuple[Float, Float]:
    """Measure xi_0 and xi_2 of galaxies with the estimator of Landy & Szalay.

    Parameters
    ----------
    place : float array, shape (n, 3)
        Positions of galaxies and random points relative to the observer, Mpc/h.
    kind : int array, shape (n,)
        0 for galaxies, 1 for random points.
    patch : int array, shape (n,)
        Number of the jackknife patch of each position, from 0.
    edges : float array, shape (b + 1,)
        Edges of the bins of separation, Mpc/h.

    Returns
    -------
    value : float array, shape (2, b)
        xi_0 and xi_2; NaN in bins without random pairs at some angle.
    jackknife : float array, shape (patches, 2, b)
        The same without the positions of each patch.
    """
    counts = pairs.count_pairs_in_space(place, kind, patch, edges, ANGLES)
    n_patches = len(counts.jackknife)
    number = np.array([np.bincount(patch[kind == code], minlength=n_patches) for code in (0, 1)], float)
    total = number.sum(1)
    xi = landy_szalay(counts.total, total)
    without = landy_szalay(counts.jackknife, (total[:, None] - number).T)
    return _multipoles(xi), _multipoles(without)


def _multipoles(xi: Float) -> Float:
    """Return xi_0 and xi_2, shape (..., 2, b), from xi in bins of separation and angle, shape (..., b * ANGLES)."""
    by_angle = xi.reshape(*xi.shape[:-1], -1, ANGLES)
    mu = np.linspace(0.0, 1.0, ANGLES + 1)
    # Integral of the Legendre polynomial P_2 over each bin.
    quadrupole = np.diff(0.5 * (mu**3 - mu))
    return np.stack([by_angle.mean(-1), 5.0 * np.sum(by_angle * quadrupole, -1)], -2)


def expected_multipoles(cosmology: Cosmology, z: float, bias: float, edges: Float) -> Float:
    """Return xi_0 and xi_2 of linear theory in bins of separation.

    Parameters
    ----------
    cosmology : Cosmology
        Parameters of the universe.
    z : float
        Redshift of the galaxies.
    bias : float
        Linear bias of the galaxies.
    edges : float array, shape (b + 1,)
        Edges of the bins of separation, Mpc/h, from 1 to 250.

    Returns
    -------
    float array, shape (2, b)
        xi_0 and xi_2, averaged over the volume of each bin.
    """
    growth = float(cosmology.growth_rate(z))
    mono, quad = kaiser_factors(bias, growth)
    r, xi = matter_correlation(cosmology, z)
    step = np.diff(r, prepend=0.0)
    inner = 3.0 / r**3 * (np.cumsum(xi * r**2 * step) - 0.5 * xi * r**2 * step)
    fine = edges[:-1, None] + (np.arange(20) + 0.5) / 20.0 * np.diff(edges)[:, None]
    curves = (mono * xi, quad * (xi - inner))
    return np.stack([np.sum(np.interp(fine, r, curve) * fine**2, 1) / np.sum(fine**2, 1) for curve in curves])


def kaiser_factors(bias: float, growth_rate: float) -> tuple[float, float]:
    """Return xi_0 over xi of matter, and xi_2 over the difference of xi of matter and its mean within the distance."""
    b, f = bias, growth_rate
    return b**2 + 2.0 / 3.0 * b * f + f**2 / 5.0, 4.0 / 3.0 * b * f + 4.0 / 7.0 * f**2


def matter_correlation(cosmology: Cosmology, z: float) -> tuple[Float, Float]:
    """Return distances up to 250 Mpc/h, and the linear correlation function of matter at these distances."""
    power = theory.matter_power(cosmology, _K, z, is_linear=True) * np.exp(-((_K / _CUT) ** 2))
    weight = _K**3 * power / (2.0 * np.pi**2)
    xi = [np.trapezoid(weight * np.sinc(_K * r / np.pi), np.log(_K)) for r in _R]
    return _R, np.array(xi)
