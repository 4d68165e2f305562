"""Compute the mean transmission of intergalactic hydrogen over many lines of sight.

Two populations of clouds absorb: the Lyman alpha forest and damped systems. Each absorbs in the lines of the Lyman
series, at the redshift of the cloud, and in the continuum beyond the Lyman limit.

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
LYMAN_LIMIT = 911.8
# The number of clouds is a continuous broken power law of 1 + z: (powers, breaks). For lines, the depth at 1 + z = 1
# is in the file.
_FOREST_LINES, _DAMPED_LINES = ((1.2, 3.7, 5.5), (2.2, 5.7)), ((2.0, 3.0), (3.0,))
# For the continuum, (amplitude, powers, breaks) of the integrand over 1 + z. In the forest, the cross section varies as
# lambda^2.1 (amplitude 0.3248 x 0.9). Damped systems are opaque except for a term in lambda^-0.3.
_FOREST, _FOREST_CROSS_SECTION = (0.29232, (-1.9, 0.6, 2.4), (2.2, 5.7)), 2.1
_DAMPED_OPAQUE, _DAMPED_LEAK, _DAMPED_LEAK_CROSS_SECTION = (
    (0.4226, (1.0, 2.0), (3.0,)),
    (0.176203, (1.3, 2.3), (3.0,)),
    -0.3,
)
# With these laws a damped system at 1 + z would transmit more light than it receives below 912 A (1 + z) / 18.5.
# Nothing is absorbed there.
_TRANSPARENCY_LIMIT = (_DAMPED_LEAK[0] / _DAMPED_OPAQUE[0]) ** (1.0 / _DAMPED_LEAK_CROSS_SECTION)


def transmission(wavelength: npt.ArrayLike, z: npt.ArrayLike) -> Float:
    """Return the mean transmission, 1 if nothing absorbs.

    Parameters
    ----------
    wavelength : float array, shape (n_lambda,)
        Observed wavelengths in A, increasing, at the centres of bins of 1 A.
    z : float array, shape (n,)
        Redshifts of the sources.

    Returns
    -------
    float array, shape (n, n_lambda)
        Transmission.
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
        # Fraction of a bin with clouds between the observer and the source.
        inside = np.clip(line * stretch[:, None] - at[:count] + 0.5, 0.0, 1.0) * (cloud > 1.0)
        depth[:, :count] += cloud_depth * inside
    # Far below the limit the approximation gives a negative depth.
    return np.asarray(np.exp(-np.maximum(depth + _continuum_depth(at, stretch), 0.0)))


def is_absorbed(band: Passband, z: float) -> bool:
    """Return True if hydrogen absorbs light in the band for some source up to redshift `z`."""
    return bool(band.wavelength[0] < lyman_series()[0][0] * (1.0 + z))


@lru_cache(maxsize=1)
def lyman_series() -> tuple[tuple[float, ...], ...]:
    """Return wavelengths (A, decreasing) of the lines, and their depths in forest and damped systems at z = 0."""
    with TABLE.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    return tuple(tuple(float(row[name]) for row in rows) for name in ("wavelength", "forest", "damped"))


def _continuum_depth(at: Float, stretch: Float) -> Float:
    """Return the optical depth beyond the Lyman limit, float64[n, n_lambda]."""
    depth = np.zeros((stretch.size, at.size))
    count = int(np.searchsorted(at, LYMAN_LIMIT * stretch.max(initial=0.0) + 0.5))
    if not count:
        return depth
    x, upper = at[:count] / LYMAN_LIMIT, np.maximum(stretch, 1.0)[:, None]
    # Clouds in front of the source whose redshifted Lyman limit is redward of the wavelength.
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
    """Return a continuous broken power law that is 1 at u = 1."""
    value = u ** powers[0]
    for i, edge in enumerate(breaks):
        value *= np.maximum(u / edge, 1.0) ** (powers[i + 1] - powers[i])
    return np.asarray(value)


def _integral(u: Float, amplitude: float, powers: tuple[float, ...], breaks: tuple[float, ...]) -> Float:
    """Return the integral of amplitude times the broken power law from 1 to u >= 1."""
    total, lower = np.zeros(np.shape(u)), 1.0
    for power, upper in zip(powers, (*breaks, np.inf), strict=True):
        at_lower = float(_broken_power_law(np.array([lower]), powers, breaks)[0])
        reach = np.clip(u, lower, upper)
        total += at_lower * lower / (power + 1.0) * ((reach / lower) ** (power + 1.0) - 1.0)
        lower = upper
    return np.asarray(amplitude * total)
