"""Compute dust extinction: five laws for the dust inside galaxies, and the law of the Milky Way.

Laws are curves k(lambda) = A(lambda) / E(B-V). Their codes are 0 for no dust, 1 for Prevot, 2 for Calzetti, and 3 and 4
for Calzetti with a 2175 A bump, which is twice as high in 4 as in 3. The law of the Milky Way is O'Donnell 1994 with
R_V = 3.1. Extinction is applied at each wavelength, before fluxes are averaged over a band. Serrano et al. scale a
band's extinction linearly from E(B-V) = 0.2 instead, which is wrong by up to 0.06 mag.

References
----------
Serrano et al. 2024, appendix B, eq. f_ext; Ilbert et al. 2009.
"""

from __future__ import annotations

import csv
import importlib.metadata
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Float
from lake_schema.errors import OutOfRange
from truesky.numerics import cache, matrices
from truesky.numerics.code_fingerprints import code_key

# Number of laws, including code 0 (no dust).
LAW_COUNT = 5
# Codes of the laws of Prevot and of Calzetti without a bump.
PREVOT, CALZETTI = 1, 2
# R_V = A(V) / E(B-V), the mean of the diffuse Milky Way: Cardelli, Clayton & Mathis 1989.
MILKY_WAY_R_V = 3.1
# First and last wavelength (A) at which the law of O'Donnell 1994 is defined, 10 and 0.3 per micrometre.
_MILKY_WAY_RANGE = (1000.0, 33333.0)
# First and last wavelength (A) of the table of the law, which include those of all passbands.
_TABLE_FIRST, _TABLE_LAST = 600, 24000

# E(lambda - V) / E(B-V) of the Small Magellanic Cloud: Prevot et al. 1984, table 2. The row at 3704 A is that in the
# photometric-redshift code LePhare.
PREVOT_TABLE = Path(__file__).with_name("prevot1984.csv")
# R_V of the Small Magellanic Cloud: Bouchet et al. 1985.
_PREVOT_R_V = 2.72
# k falls as lambda^-1.6 beyond the red end of the table.
_PREVOT_INFRARED = 1.6

# Calzetti et al. 2000, eq. 4: k = slope * polynomial(1 / lambda) + R_V, lambda in micrometres. The coefficients, with
# the constant term first, are BLUE below 6300 A (SPLIT) and RED above. The law begins at 1200 A (FIRST).
_CALZETTI_R_V = 4.05
_CALZETTI_SLOPE = 2.659
_CALZETTI_BLUE = (-2.156, 1.509, -0.198, 0.011)
_CALZETTI_RED = (-1.857, 1.040)
_CALZETTI_SPLIT = 6300.0
_CALZETTI_FIRST = 1200.0

# Centre and width (A) of the Drude profile of the 2175 A bump: Fitzpatrick & Massa 1986.
_BUMP_CENTRE, _BUMP_WIDTH = 2175.0, 350.0
# Heights of the bump (k) in laws 3 and 4, adopted: about one and two thirds of the height in the Milky Way.
_BUMP_HEIGHTS = (1.26, 2.52)


def laws(wavelength: npt.ArrayLike) -> Float:
    """Return k(lambda) = A(lambda) / E(B-V) of the five laws for dust in galaxies, float64[5, n], in order of code.

    `wavelength` has rest-frame wavelengths in A, above 0 (not checked), shape (n,). Laws are extrapolated beyond their
    published range.
    """
    lam = np.asarray(wavelength, float)
    calzetti = _calzetti(lam)
    bump = _bump(lam)
    return np.stack(
        [np.zeros_like(lam), _prevot(lam), calzetti, *(calzetti + height * bump for height in _BUMP_HEIGHTS)]
    )


def milky_way(wavelength: npt.ArrayLike) -> Float:
    """Return A(lambda) / A(V) of the Milky Way for R_V = 3.1, at wavelengths in A.

    It is constant below 1000 A and above 33333 A.

    Notes
    -----
    Serrano et al. 2024, appendix B, give A(lambda) = E(B-V) R_V, without the dependence on wavelength.

    References
    ----------
    O'Donnell 1994; Cardelli, Clayton & Mathis 1989 outside the optical.
    """
    # Import here, because the import is slow and the laws of other functions do not need it.
    import astropy.units as u
    from dust_extinction.parameter_averages import O94

    lam = np.clip(np.asarray(wavelength, float), *_MILKY_WAY_RANGE)
    curve: Any = O94(Rv=MILKY_WAY_R_V)
    return np.asarray(curve(1e4 / lam / u.um), float)


def milky_way_table(first: int, count: int) -> Float:
    """Return A(lambda) / A(V) of the Milky Way at `count` wavelengths in steps of 1 A, from `first` in A.

    The values of `milky_way` are read from the cache. OutOfRange is raised for wavelengths outside 600 to
    24000 A.
    """
    start = first - _TABLE_FIRST
    if start < 0 or first + count - 1 > _TABLE_LAST:
        raise OutOfRange("wavelength (A)", first if start < 0 else first + count - 1, _TABLE_FIRST, _TABLE_LAST)
    return _milky_way_table()[start : start + count]


@lru_cache(maxsize=1)
def _milky_way_table() -> Float:
    key = cache.content_key(code_key(__name__), importlib.metadata.version("dust_extinction"))
    wavelengths = np.arange(_TABLE_FIRST, _TABLE_LAST + 1.0)
    return cache.cached_arrays("milky_way_law", key, lambda: {"curve": milky_way(wavelengths)})["curve"]


def transmission(k: npt.ArrayLike, ebv: npt.ArrayLike) -> Any:
    """Return the transmission of dust, 10^(-0.4 k E(B-V)), for arrays that can be broadcast against each other.

    `k` is A(lambda) / E(B-V) and `ebv` is E(B-V) in mag; a pair A(lambda) / A(V) and A(V) works as well. The result has
    the floating-point type of the arguments.
    """
    return np.exp(_LN_PER_MAG * np.asarray(k) * np.asarray(ebv))


# Natural logarithm of the transmission per magnitude. It is a Python float, because a NumPy float64 would convert
# float32 arrays to float64.
_LN_PER_MAG = float(-0.4 * np.log(10.0))


def _prevot(lam: Float) -> Float:
    with PREVOT_TABLE.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    at = np.array([float(row["wavelength"]) for row in rows])
    k = np.array([float(row["excess_ratio"]) for row in rows]) + _PREVOT_R_V
    slope = (k[0] - k[1]) / (1.0 / at[0] - 1.0 / at[1])
    ultraviolet = k[0] + slope * (1.0 / lam - 1.0 / at[0])
    infrared = k[-1] * (at[-1] / lam) ** _PREVOT_INFRARED
    return np.where(lam < at[0], ultraviolet, np.where(lam > at[-1], infrared, np.interp(lam, at, k)))


def _calzetti(lam: Float) -> Float:
    x = 1e4 / np.maximum(lam, _CALZETTI_FIRST)
    powers = x[None, :] ** np.arange(4)[:, None]
    blue = _CALZETTI_SLOPE * matrices.matmul(np.array(_CALZETTI_BLUE), powers) + _CALZETTI_R_V
    red = _CALZETTI_SLOPE * matrices.matmul(np.array(_CALZETTI_RED), powers[:2]) + _CALZETTI_R_V
    # Below 1200 A the law is continued along its tangent at 1200 A.
    x0 = 1e4 / _CALZETTI_FIRST
    tangent = -_CALZETTI_SLOPE * np.polyval(np.polyder(np.array(_CALZETTI_BLUE[::-1])), x0) * x0 / _CALZETTI_FIRST
    k = np.where(lam < _CALZETTI_SPLIT, blue, red) + tangent * np.minimum(lam - _CALZETTI_FIRST, 0.0)
    return np.asarray(np.maximum(k, 0.0))


def _bump(lam: Float) -> Float:
    width = (lam * _BUMP_WIDTH) ** 2
    return np.asarray(width / ((lam**2 - _BUMP_CENTRE**2) ** 2 + width))
