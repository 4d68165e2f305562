"""Compute dust extinction: five laws for the dust inside galaxies, and the law of the Milky Way.

Laws are curves k(lambda) = A(lambda) / E(B-V). Their codes are 0 for no dust, 1 for Prevot, 2 for Calzetti, and 3 and 4
for Calzetti with a 2175 A bump. The law of the Milky Way is O'Donnell 1994 with R_V = 3.1.

References
----------
Serrano et al. 2024, appendix B, eq. f_ext; Ilbert et al. 2009. Fluxes are averaged over bands after extinction. Serrano
et al. scale a band's extinction linearly from E(B-V) = 0.2, which is wrong by up to 0.06 mag.
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Float
from truesky.numerics import matrices

LAW_COUNT = 5
PREVOT, CALZETTI = 1, 2
# Cardelli, Clayton & Mathis 1989: the mean of the diffuse Milky Way. A(V) = R_V E(B-V).
MILKY_WAY_R_V = 3.1
# Range of wavelengths of the law of O'Donnell 1994, A (0.3 to 10 per micrometre).
_MILKY_WAY_RANGE = (1000.0, 33333.0)

# Prevot et al. 1984, table 2 (Small Magellanic Cloud; 3704 A as in LePhare): E(lambda - V) / E(B-V).
# R_V of Bouchet et al. 1985.
PREVOT_TABLE = Path(__file__).with_name("prevot1984.csv")
_PREVOT_R_V = 2.72
_PREVOT_INFRARED = 1.6

# Calzetti et al. 2000, eq. 4: k = slope * polynomial(1 / um) + R_V, with one polynomial on each side of 0.63 um.
_CALZETTI_R_V = 4.05
_CALZETTI_SLOPE = 2.659
_CALZETTI_BLUE = (-2.156, 1.509, -0.198, 0.011)
_CALZETTI_RED = (-1.857, 1.040)
_CALZETTI_SPLIT = 6300.0
_CALZETTI_FIRST = 1200.0

# Fitzpatrick & Massa 1986: Drude profile of the 2175 A bump. The heights in the two laws are adopted, about one third
# and two thirds of the height in the Milky Way.
_BUMP_CENTRE, _BUMP_WIDTH = 2175.0, 350.0
_BUMP_HEIGHTS = (1.26, 2.52)


def laws(wavelength: npt.ArrayLike) -> Float:
    """Return k(lambda) of each law by code, float64[5, n], at rest-frame wavelengths (A, above 0) of shape (n,)."""
    lam = np.asarray(wavelength, float)
    calzetti = _calzetti(lam)
    bump = _bump(lam)
    return np.stack(
        [np.zeros_like(lam), _prevot(lam), calzetti, *(calzetti + height * bump for height in _BUMP_HEIGHTS)]
    )


def milky_way(wavelength: npt.ArrayLike) -> Float:
    """Return A(lambda) / A(V) of the Milky Way for R_V = 3.1, constant below 1000 A; `wavelength` is in A.

    Notes
    -----
    Serrano et al. 2024, appendix B, give A(lambda) = E(B-V) R_V, without the curve.

    References
    ----------
    O'Donnell 1994; Cardelli, Clayton & Mathis 1989 outside the optical.
    """
    # The import is slow, and the other laws do not need it.
    import astropy.units as u
    from dust_extinction.parameter_averages import O94

    lam = np.clip(np.asarray(wavelength, float), *_MILKY_WAY_RANGE)
    curve: Any = O94(Rv=MILKY_WAY_R_V)
    return np.asarray(curve(1e4 / lam / u.um), float)


def transmission(k: npt.ArrayLike, ebv: npt.ArrayLike) -> Any:
    """Return the transmission 10^(-0.4 k E(B-V)) in the precision of the arguments."""
    return np.exp(_LN_PER_MAG * np.asarray(k) * np.asarray(ebv))


# A Python float, so that float32 arrays stay float32.
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
    # Below its first wavelength the law is continued along its tangent.
    x0 = 1e4 / _CALZETTI_FIRST
    tangent = -_CALZETTI_SLOPE * np.polyval(np.polyder(np.array(_CALZETTI_BLUE[::-1])), x0) * x0 / _CALZETTI_FIRST
    k = np.where(lam < _CALZETTI_SPLIT, blue, red) + tangent * np.minimum(lam - _CALZETTI_FIRST, 0.0)
    return np.asarray(np.maximum(k, 0.0))


def _bump(lam: Float) -> Float:
    width = (lam * _BUMP_WIDTH) ** 2
    return np.asarray(width / ((lam**2 - _BUMP_CENTRE**2) ** 2 + width))
