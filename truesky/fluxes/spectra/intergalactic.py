"""Compute the mean transmission of intergalactic hydrogen over many lines of sight.

Two populations of clouds absorb: the Lyman alpha forest and damped systems. A cloud absorbs in the lines of the Lyman
series, at its own redshift, and in the continuum beyond the Lyman limit (912 A).

References
----------
Inoue et al. 2014, MNRAS 442, 1805, eqs. 20 to 29; the depths of the lines are in lyman_series.csv.
"""

from __future__ import annotations

import csv
from functools import lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Float
from truesky.fluxes.passbands import Passband

TABLE = Path(__file__).with_name("lyman_series.csv")
# Wavelength of the Lyman limit, A.
LYMAN_LIMIT = 911.8
# The optical depth of the lines of the forest and of damped systems is a continuous broken power law of 1 + z of the
# cloud: (exponents, values of 1 + z at which the exponent changes). lyman_series.csv has the depth of each line at
# 1 + z = 1.
_FOREST_LINES, _DAMPED_LINES = ((1.2, 3.7, 5.5), (2.2, 5.7)), ((2.0, 3.0), (3.0,))
# The optical depth of the continuum is an integral over 1 + z of the clouds. The integrand is a broken power law:
# (amplitude, exponents, breaks in 1 + z). In the forest it is multiplied by (lambda / 912 A)^2.1, the dependence of the
# cross section on wavelength; the amplitude is 0.3248 x 0.9.
_FOREST, _FOREST_CROSS_SECTION = (0.29232, (-1.9, 0.6, 2.4), (2.2, 5.7)), 2.1
# Integrands of the optical depth of damped systems, (amplitude, exponents, breaks in 1 + z). The depth is the integral
# of OPAQUE minus the integral of LEAK, which is multiplied by (lambda / 912 A)^-0.3.
_DAMPED_OPAQUE, _DAMPED_LEAK, _DAMPED_LEAK_CROSS_SECTION = (
    (0.4226, (1.0, 2.0), (3.0,)),
    (0.176203, (1.3, 2.3), (3.0,)),
    -0.3,
)
# Largest ratio (18.5) of a damped system's redshifted Lyman limit to the observed wavelength at which the system
# absorbs. At larger ratios the integrand LEAK would exceed OPAQUE, which would give a negative optical depth.
_TRANSPARENCY_LIMIT = (_DAMPED_LEAK[0] / _DAMPED_OPAQUE[0]) ** (1.0 / _DAMPED_LEAK_CROSS_SECTION)


def transmission(wavelength: npt.ArrayLike, z: npt.ArrayLike) -> Float:
    """Return the mean transmission of intergalactic hydrogen in front of sources.

    Parameters
    ----------
    wavelength : float array, shape (n_lambda,)
        Observed wavelengths in A, increasing, at the centres of bins of 1 A.
    z : float or float array, shape (n,)
        Redshifts of the sources; n is 1 for a number.

    Returns
    -------
    float array, shape (n, n_lambda)
        Transmission from 0 to 1; 1 redward of the redshifted Lyman alpha line.
    """
    at, stretch = np.asarray(wavelength, float), 1.0 + np.atleast_1d(np.asarray(z, float))
    depth = np.zeros((stretch.size, at.size))
    for line, forest, damped in zip(*lyman_series(), strict=True):
        count = int(np.searchsorted(at, line * stretch.max(initial=0.0) + 0.5))
        if not count:
            break
        cloud = at[:count] / line
        cloud_depth = forest * _broken_power_law(cloud, *_FOREST_LINES) + damped * _broken_power_law(
            cloud, *_DAMPED_LINES
        )
        # Fraction of each wavelength bin in which this line can be absorbed by a cloud between observer and source.
        inside = np.clip(line * stretch[:, None] - at[:count] + 0.5, 0.0, 1.0) * (cloud > 1.0)
        depth[:, :count] += cloud_depth * inside
    # Limit the depth to 0, because the approximation becomes negative far below the Lyman limit.
    return np.asarray(np.exp(-np.maximum(depth + _continuum_depth(at, stretch), 0.0)))


def first_transparent(z: npt.ArrayLike) -> Float:
    """Return the wavelengths in A from which on the light of sources at redshifts `z` is not absorbed.

    Each is half a wavelength bin (0.5 A) above Lyman alpha, because a bin may be absorbed in part.
    """
    return np.asarray(lyman_series()[0][0] * (1.0 + np.asarray(z, float)) + 0.5)


def is_absorbed(band: Passband, z: float) -> bool:
    """Return True if the band begins blueward of Lyman alpha at redshift `z`, so that hydrogen absorbs light in it."""
    return bool(band.wavelength[0] < lyman_series()[0][0] * (1.0 + z))


@lru_cache(maxsize=1)
def lyman_series() -> tuple[tuple[float, ...], ...]:
    """Return three tuples with one value per line of the Lyman series, Lyman alpha first.

    They are the wavelength in A, and the optical depth at z = 0 of the forest and of damped systems.
    """
    with TABLE.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return tuple(tuple(float(row[name]) for row in rows) for name in ("wavelength", "forest", "damped"))


def _continuum_depth(at: Float, stretch: Float) -> Float:
    """Return the optical depth of continuum absorption beyond the Lyman limit, float64[n, n_lambda].

    `at` are observed wavelengths in A, increasing, and `stretch` is 1 + z of the sources.
    """
    depth = np.zeros((stretch.size, at.size))
    count = int(np.searchsorted(at, LYMAN_LIMIT * stretch.max(initial=0.0) + 0.5))
    if not count:
        return depth
    x, upper = at[:count] / LYMAN_LIMIT, np.maximum(stretch, 1.0)[:, None]
    # Lowest 1 + z of absorbing clouds: their redshifted Lyman limit must be redward of the observed wavelength.
    lower = np.minimum(np.maximum(x, 1.0), upper)
    damped = (
        np.maximum(np.minimum(upper, _TRANSPARENCY_LIMIT * x), lower)
        if _TRANSPARENCY_LIMIT * x[0] < upper.max()
        else upper
    )

    def depth_integral(law: tuple[float, tuple[float, ...], tuple[float, ...]], limit: Float) -> Float:
        return np.asarray(_integral(limit, *law) - _integral(lower, *law))

    depth[:, :count] = x**_FOREST_CROSS_SECTION * depth_integral(_FOREST, upper) + depth_integral(
        _DAMPED_OPAQUE, damped
    )
    depth[:, :count] -= x**_DAMPED_LEAK_CROSS_SECTION * depth_integral(_DAMPED_LEAK, damped)
    return depth


def _broken_power_law(u: Float, powers: tuple[float, ...], breaks: tuple[float, ...]) -> Float:
    """Return a continuous broken power law of u that is 1 at u = 1.

    `powers` has one exponent more than `breaks`, the values of u at which the exponent changes.
    """
    value = u ** powers[0]
    for i, edge in enumerate(breaks):
        value *= np.maximum(u / edge, 1.0) ** (powers[i + 1] - powers[i])
    return np.asarray(value)


def _integral(u: Float, amplitude: float, powers: tuple[float, ...], breaks: tuple[float, ...]) -> Float:
    """Return `amplitude` times the integral of `_broken_power_law` from 1 to u, for u of 1 or more."""
    total, lower = np.zeros(np.shape(u)), 1.0
    for power, upper in zip(powers, (*breaks, np.inf), strict=True):
        at_lower = float(_broken_power_law(np.array([lower]), powers, breaks)[0])
        reach = np.clip(u, lower, upper)
        total += at_lower * lower / (power + 1.0) * ((reach / lower) ** (power + 1.0) - 1.0)
        lower = upper
    return np.asarray(amplitude * total)
