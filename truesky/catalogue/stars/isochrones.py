"""Isochrones: mass, luminosity and temperature of stars of one age and metallicity, from a fit to published isochrones.

An isochrone consists of points at fixed evolutionary phases. log L and log Teff of each point, and the initial mass of
points from the end of the main sequence on, are quartic polynomials in [M/H]. Their coefficients are interpolated
linearly in log age between the ages AGES. The coefficients, their sources and the residuals are in isochrones.csv,
which is made by scripts/fit_isochrones.py.
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
# Initial masses (Msun) of the first points of the main sequence.
FIXED_MASSES = (0.5, 0.6)
# Further points of the main sequence: fractions of the way from ln(0.6 Msun) to ln(turn-off mass).
UPPER_FRACTIONS = (0.2, 0.4, 0.55, 0.68, 0.78, 0.86, 0.91, 0.94, 0.96, 0.98, 1.0)
# Numbers of equivalent evolutionary points (Dotter 2016, ApJS 222, 8, Table 2) from the end of the main sequence on.
# 454 is the end of the main sequence, 605 the end of the red giant branch, 631 and 707 are start and end of core helium
# burning, and 808 is the first thermal pulse. All other numbers are points between these phases.
PHASES = (
    454, 462, 470, 480, 490, 500, 510, 522, 535, 550, 565, 580, 592, 600, 605, 631, 650, 670, 690, 707, 730, 760, 790,
    808,
)  # fmt: skip
# Index in PHASES of the last point before the helium flash; no stars are between this point and the next one.
FLASH = PHASES.index(605)
# log10 of the ages (yr) at which the fit has coefficients.
AGES = (7.8, 8.2, 8.5, 8.75, 8.9, 9.0, 9.1, 9.2, 9.4, 9.6, 9.8, 10.0, 10.2)
# Range of the fit in [M/H]: lowest value for ages of at least 1 Gyr, lowest value for younger stars, highest value.
METALLICITIES = (-2.5, -0.75, 0.5)
# log10 of the age (yr) below which the second value of METALLICITIES is the lowest one.
_YOUNG = 9.0
# Degree of the polynomials in [M/H].
DEGREE = 4
# Temperature (K) and log10 surface gravity (cm s-2) of the Sun (nominal values of IAU 2015).
_SUN_TEFF, _SUN_LOG_G = 5772.0, 4.438


@dataclass(frozen=True, slots=True, eq=False)
class Isochrones:
    """k isochrones with p points each, in the order of increasing initial mass.

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
    log_g is computed with the initial mass, although stars lose a tenth of it on the red giant branch.
    """

    age: Float
    metallicity: Float
    mass: Float
    log_l: Float
    log_teff: Float
    log_g: Float

    @property
    def main_sequence(self) -> int:
        """Return the number of points of each isochrone that are on the main sequence, including its end."""
        return len(FIXED_MASSES) + len(UPPER_FRACTIONS)


@lru_cache(maxsize=1)
def coefficients() -> dict[str, Float]:
    """Return the coefficients of the fits of "log_l", "log_teff" and "mass", shape (points, ages, powers of [M/H]).

    Coefficients of "mass" are NaN for the points of the main sequence before its end, whose masses are not fitted.
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
    """Return the number of points of each isochrone."""
    return len(FIXED_MASSES) + len(UPPER_FRACTIONS) + len(PHASES) - 1


def isochrones(age: npt.ArrayLike, metallicity: npt.ArrayLike) -> Isochrones:
    """Return the isochrones of k ages (Gyr) and metallicities [M/H], shape (k,) each.

    Ages and metallicities outside the range of the fit get the isochrone at the end of the range. The result contains
    the given ages, but metallicities that are limited to the range.
    """
    ages, requested_metallicity = np.asarray(age, float), np.asarray(metallicity, float)
    log_age = np.log10(ages) + 9.0
    metals = np.clip(requested_metallicity, min_metallicity(log_age), METALLICITIES[-1])
    knots, weight = bracket_age(log_age)
    values = {name: _evaluate_fit(each, knots, weight, metals) for name, each in coefficients().items()}
    mass = initial_masses(values["mass"])
    log_g = _SUN_LOG_G + np.log10(mass) + 4.0 * (values["log_teff"] - np.log10(_SUN_TEFF)) - values["log_l"]
    return Isochrones(ages, metals, mass, values["log_l"], values["log_teff"], log_g)


def initial_masses(fitted: Float) -> Float:
    """Return the initial masses (Msun) of all points, shape (k, p), from the fitted values of "mass", shape (k, p).

    At the end of the main sequence, the fitted value is log10 of the mass (turn-off mass). For each later point, it is
    log10 of the difference from the previous point in units of the turn-off mass. The fitted values of points before
    the end of the main sequence are not used.
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
    """Return the lowest [M/H] for which the fit is valid, for log10 of ages in yr."""
    return np.where(log_age < _YOUNG, METALLICITIES[1], METALLICITIES[0])


def bracket_age(log_age: Float) -> tuple[Int, Float]:
    """Return the index in AGES of the age before each log10 age (yr), and the weight (0 to 1) of the age after it."""
    at = np.clip(log_age, AGES[0], AGES[-1])
    lower_knot = np.clip(np.searchsorted(AGES, at, side="right") - 1, 0, len(AGES) - 2)
    low, high = np.array(AGES)[lower_knot], np.array(AGES)[lower_knot + 1]
    return lower_knot, (at - low) / (high - low)


def _evaluate_fit(table: Float, knot: Int, weight: Float, metallicity: Float) -> Float:
    powers = metallicity[:, None] ** np.arange(DEGREE + 1)
    at = (1.0 - weight)[:, None, None] * table[:, knot].swapaxes(0, 1)
    at += weight[:, None, None] * table[:, knot + 1].swapaxes(0, 1)
    return np.asarray(np.einsum("kpd,kd->kp", at, powers))
