"""Isochrones: mass, luminosity and temperature along evolutionary phases, from a fit to published isochrones.

log L and log Teff of each point, and the initial mass of points from the end of the main sequence on, are quartic
polynomials in [M/H] whose coefficients are linear in log age between knots. The coefficients, their sources and the
residuals are in isochrones.csv, which is made by scripts/fit_isochrones.py.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Float, Int

TABLE = Path(__file__).with_name("isochrones.csv")
# Points of the main sequence: fixed initial masses (Msun), then fractions of the logarithm from the last of them up to
# the turn-off mass.
FIXED_MASSES = (0.5, 0.6)
UPPER_FRACTIONS = (0.2, 0.4, 0.55, 0.68, 0.78, 0.86, 0.91, 0.94, 0.96, 0.98, 1.0)
# Equivalent evolutionary points (Dotter 2016, ApJS 222, 8, Table 2): ends of the main sequence (454) and of the red
# giant branch (605), start and end of core helium burning (631, 707), the first thermal pulse (808), and between.
PHASES = (
    454, 462, 470, 480, 490, 500, 510, 522, 535, 550, 565, 580, 592, 600, 605, 631, 650, 670, 690, 707, 730, 760, 790,
    808,
)  # fmt: skip
# Point before the helium flash; there are no stars between it and the next point.
FLASH = PHASES.index(605)
AGES = (7.8, 8.2, 8.5, 8.75, 8.9, 9.0, 9.1, 9.2, 9.4, 9.6, 9.8, 10.0, 10.2)
# Ends of the fit in [M/H]; below 1 Gyr, the lower end is the second value.
METALLICITIES = (-2.5, -0.75, 0.5)
_YOUNG = 9.0
DEGREE = 4
# Nominal values of the Sun (IAU 2015).
_SUN_TEFF, _SUN_LOG_G = 5772.0, 4.438


@dataclass(frozen=True, slots=True, eq=False)
class Isochrones:
    """Isochrones in the order of increasing initial mass.

    Attributes
    ----------
    age : float array, shape (k,)
        Age, Gyr.
    metallicity : float array, shape (k,)
        [M/H].
    mass : float array, shape (k, p)
        Initial mass, Msun, ascending.
    log_l : float array, shape (k, p)
        log10 L / Lsun.
    log_teff : float array, shape (k, p)
        log10 Teff / K.
    log_g : float array, shape (k, p)
        log10 of the surface gravity, cm s-2.

    Notes
    -----
    log_g uses the initial mass, but a tenth of it is lost on the red giant branch.
    """

    age: Float
    metallicity: Float
    mass: Float
    log_l: Float
    log_teff: Float
    log_g: Float

    @property
    def main_sequence(self) -> int:
        """Return the number of points on the main sequence."""
        return len(FIXED_MASSES) + len(UPPER_FRACTIONS)


@lru_cache(maxsize=1)
def coefficients() -> dict[str, Float]:
    """Return the coefficients of `log_l`, `log_teff` and `mass`, shape (points, ages, powers of [M/H]).

    Coefficients of `mass` are NaN for points with a known mass.
    """
    with TABLE.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(line for line in file if not line.startswith("#")))
    names = ("log_l", "log_teff", "mass")
    shape = (point_count(), len(AGES), DEGREE + 1)
    return {
        name: np.array([[float(row[f"{name}_{k}"] or "nan") for k in range(DEGREE + 1)] for row in rows]).reshape(shape)
        for name in names
    }


def point_count() -> int:
    """Return the number of points of an isochrone."""
    return len(FIXED_MASSES) + len(UPPER_FRACTIONS) + len(PHASES) - 1


def isochrones(age: npt.ArrayLike, metallicity: npt.ArrayLike) -> Isochrones:
    """Return the isochrones of ages (Gyr) and metallicities, which are limited to the range of the fit."""
    ages, requested_metallicity = np.asarray(age, float), np.asarray(metallicity, float)
    log_age = np.log10(ages) + 9.0
    metals = np.clip(requested_metallicity, min_metallicity(log_age), METALLICITIES[-1])
    knots, weight = bracket_age(log_age)
    values = {name: _evaluate_fit(each, knots, weight, metals) for name, each in coefficients().items()}
    mass = initial_masses(values["mass"])
    log_g = _SUN_LOG_G + np.log10(mass) + 4.0 * (values["log_teff"] - np.log10(_SUN_TEFF)) - values["log_l"]
    return Isochrones(ages, metals, mass, values["log_l"], values["log_teff"], log_g)


def initial_masses(fitted: Float) -> Float:
    """Return initial masses (Msun), shape (k, p), from the fitted quantities.

    The fit gives log10 of the turn-off mass, and for each later point log10 of its difference from the previous point
    in units of the turn-off mass.
    """
    first = len(FIXED_MASSES) + len(UPPER_FRACTIONS) - 1
    turnoff_mass = 10.0 ** fitted[:, first]
    out = np.empty_like(fitted)
    out[:, : len(FIXED_MASSES)] = FIXED_MASSES
    out[:, len(FIXED_MASSES) : first + 1] = FIXED_MASSES[-1] * (turnoff_mass / FIXED_MASSES[-1])[:, None] ** np.array(
        UPPER_FRACTIONS
    )
    out[:, first + 1 :] = turnoff_mass[:, None] * (1.0 + np.cumsum(10.0 ** fitted[:, first + 1 :], 1))
    return out


def min_metallicity(log_age: Float) -> Float:
    """Return the lowest [M/H] of the fit at log10 of ages in yr."""
    return np.where(log_age < _YOUNG, METALLICITIES[1], METALLICITIES[0])


def bracket_age(log_age: Float) -> tuple[Int, Float]:
    """Return the knot before each log10 of an age in yr, and the weight of the knot after it."""
    at = np.clip(log_age, AGES[0], AGES[-1])
    lower_knot = np.clip(np.searchsorted(AGES, at, side="right") - 1, 0, len(AGES) - 2)
    low, high = np.array(AGES)[lower_knot], np.array(AGES)[lower_knot + 1]
    return lower_knot, (at - low) / (high - low)


def _evaluate_fit(table: Float, knot: Int, weight: Float, metallicity: Float) -> Float:
    powers = metallicity[:, None] ** np.arange(DEGREE + 1)
    at = (1.0 - weight)[:, None, None] * table[:, knot].swapaxes(0, 1)
    at += weight[:, None, None] * table[:, knot + 1].swapaxes(0, 1)
    return np.asarray(np.einsum("kpd,kd->kp", at, powers))
