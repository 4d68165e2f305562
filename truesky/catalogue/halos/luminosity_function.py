"""Luminosity function of galaxies by redshift, and its inverse.

Absolute magnitudes are M_r = M(0.1r) - 5 log10 h, where 0.1r is SDSS r blueshifted to z = 0.1. Volumes are comoving
(Mpc/h)^3. The parameters and their sources are in luminosity_function.toml.

References
----------
Schechter 1976, ApJ 203, 297
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from lake_schema.arrays import Float
from lake_schema.errors import OutOfRange
from truesky.catalogue import parameters
from truesky.catalogue.interpolation import bracket

# Factor between magnitudes and natural logarithms of the luminosity.
_LN10_04 = 0.4 * np.log(10.0)
# Largest redshift of galaxies with this luminosity function. Another one is used beyond (Serrano et al. 2024, "Galaxy
# catalogues").
_Z_MAX_LIMIT = 6.0

# Smallest distance of a, the first argument of the incomplete Gamma function Gamma(a, x), from 0 and -1. A closer a
# is moved to this distance above 0 or -1, because the recurrence in a divides by zero there.
_SMALLEST_A = 1e-5
# Value of a above which the incomplete Gamma function Gamma(a, x) is computed from Gamma(a + 1, x). For smaller a, it
# is computed from Gamma(a + 2, x).
_ONE_STEP = -0.95
# Number of values of a = alpha + 1 in the table of `inverse`; alpha is the slope of the Schechter function.
_A_NODES = 384
# The table of `inverse` extends beyond the largest a = alpha + 1 of the luminosity function by this margin.
_A_MARGIN = 0.01
# Range of ln x = ln(L / L*) of the table of `inverse`.
_LN_X_RANGE = (-20.0, 6.4)
# Number of values of ln x = ln(L / L*) at which Gamma(a, x) is computed for the table of `inverse`.
_X_NODES = 3001
# Step between the values of ln x that are used for the table of `inverse`: Gamma(a, x) is computed at `_X_NODES` values
# of ln x, and its logarithms at every fifth of them are the columns of the table.
_X_STEP = 5


@dataclass(frozen=True, slots=True)
class Schechter:
    """Schechter function whose parameters depend on redshift; explained in luminosity_function.toml, [schechter]."""

    z_anchor: float
    m_star: float
    m_star_rate: float
    m_star_scale: float
    phi_star: float
    phi_star_rate: float
    alpha: float
    alpha_rate: float
    alpha_z_max: float
    far_z: tuple[float, ...]
    far_m_star: tuple[float, ...]
    far_phi_star: tuple[float, ...]
    far_alpha: tuple[float, ...]

    def parameters_at(self, z: npt.ArrayLike) -> tuple[Float, Float, Float]:
        """Return the Schechter parameters M* (mag), phi* ((Mpc/h)^-3) and alpha at each redshift."""
        redshift = np.asarray(z, float)
        z_offset = redshift - self.z_anchor
        m_star = self.m_star + self.m_star_rate * self.m_star_scale * np.expm1(-z_offset / self.m_star_scale)
        phi_star = self.phi_star * 10.0 ** (-self.phi_star_rate * z_offset)
        alpha = self.alpha - self.alpha_rate * np.minimum(redshift, self.alpha_z_max)
        is_far = redshift > self.far_z[0]
        if not is_far.any():
            return m_star, phi_star, alpha
        knots = (self.far_m_star, np.log(self.far_phi_star), self.far_alpha)
        m_far, ln_phi_far, alpha_far = (np.interp(redshift, self.far_z, knot) for knot in knots)
        value_pairs = ((m_far, m_star), (np.exp(ln_phi_far), phi_star), (alpha_far, alpha))
        m_star, phi_star, alpha = (np.where(is_far, far_value, near_value) for far_value, near_value in value_pairs)
        return m_star, phi_star, alpha


@dataclass(frozen=True, slots=True)
class Volume:
    """Redshift range of galaxies in halos, and the faintest absolute magnitude M_r (mag) that is drawn."""

    z_min: float
    z_max: float
    m_faintest: float


@dataclass(frozen=True, slots=True, eq=False)
class Inverse:
    """Table of the luminosity above which galaxies have a given number density.

    It contains the solution x of Gamma(a, x) = g, the upper incomplete Gamma function, with x = L/L* and a = alpha + 1.

    Attributes
    ----------
    schechter : Schechter
        The luminosity function.
    a : float array, shape (k,)
        Values of a of the rows, with constant steps.
    ln_g : float array, shape (m,)
        Values of ln g of the columns, ascending; g is the number density divided by phi*.
    ln_x : float array, shape (k, m)
        Solutions ln x.
    """

    schechter: Schechter
    a: Float
    ln_g: Float
    ln_x: Float


def schechter() -> Schechter:
    """Return the built-in parameters of the luminosity function of galaxies."""
    return Schechter(**parameters.section("luminosity_function.toml", "schechter"))


def volume(z_max: float | None = None) -> Volume:
    """Return the redshift range of galaxies in halos, and the faintest absolute magnitude that is drawn.

    `z_max` is the largest redshift; None for the built-in value of 6. Raises OutOfRange if it is not above the smallest
    redshift (0.002) or above 6.
    """
    numbers = parameters.section("luminosity_function.toml", "volume")
    if z_max is not None:
        if not numbers["z_min"] < z_max <= _Z_MAX_LIMIT:
            raise OutOfRange("z_max", z_max, numbers["z_min"], _Z_MAX_LIMIT)
        numbers["z_max"] = z_max
    return Volume(**numbers)


def density(lf: Schechter, m: npt.ArrayLike, z: npt.ArrayLike) -> Float:
    """Return the luminosity function dn/dM.

    Parameters
    ----------
    lf : Schechter
        Parameters of the luminosity function.
    m : float array, shape (n,)
        Absolute magnitude M_r, mag.
    z : float array, shape (n,)
        Redshift.

    Returns
    -------
    float array, shape (n,)
        dn/dM, (Mpc/h)^-3 mag^-1.

    References
    ----------
    Schechter 1976
    """
    m_star, phi_star, alpha = lf.parameters_at(z)
    ln_x = -_LN10_04 * (np.asarray(m, float) - m_star)
    return np.asarray(_LN10_04 * phi_star * np.exp((alpha + 1.0) * ln_x - np.exp(ln_x)))


def number_density(lf: Schechter, m: npt.ArrayLike, z: npt.ArrayLike) -> Float:
    """Return the number density of galaxies brighter than an absolute magnitude.

    Parameters
    ----------
    lf : Schechter
        Parameters of the luminosity function.
    m : float array, shape (n,)
        Absolute magnitude M_r, mag.
    z : float array, shape (n,)
        Redshift.

    Returns
    -------
    float array, shape (n,)
        n(< M, z) = phi* Gamma(alpha + 1, L/L*), (Mpc/h)^-3.
    """
    m_star, phi_star, alpha = lf.parameters_at(z)
    x = np.exp(-_LN10_04 * (np.asarray(m, float) - m_star))
    return phi_star * upper_gamma(alpha + 1.0, x)


def upper_gamma(a: npt.ArrayLike, x: npt.ArrayLike) -> Float:
    """Return the upper incomplete Gamma function Gamma(a, x) for a > -2 and x > 0, because scipy requires a > 0.

    Raises OutOfRange if a <= -2. The function is not normalised by Gamma(a).

    Notes
    -----
    The relative error is 1e-9 if |a| and |a + 1| > 1e-2 and x < 300 (a > -0.9) or x < 30. It is 1e-4 if |a| or
    |a + 1| < 1e-5 (tests/truesky/catalogue/halos/test_luminosity_function.py).

    References
    ----------
    Abramowitz & Stegun 1972, 6.5.22: Gamma(a, x) = [Gamma(a + 1, x) - x^a e^-x] / a
    """
    order, at = np.asarray(a, float), np.asarray(x, float)
    if order.size and order.min() <= -2.0:
        raise OutOfRange("a", float(order.min()), -2.0, "infinity")
    # The recurrence from Gamma(a + 1, x) to Gamma(a, x) divides zero by zero at a = 0 and -1. Moving a by this small
    # step changes Gamma by less than 1e-4 (relative).
    order = np.where(np.abs(order) < _SMALLEST_A, _SMALLEST_A, order)
    order = np.where(np.abs(order + 1.0) < _SMALLEST_A, _SMALLEST_A - 1.0, order)
    # Each step of the recurrence from a + 1 to a loses digits at large x: use two steps only if one is not enough.
    second = order < _ONE_STEP
    start = np.where(second, order + 2.0, order + 1.0)
    above = scipy.special.gamma(start) * scipy.special.gammaincc(start, at)
    middle = np.where(second, order + 1.0, 1.0)
    above = np.where(second, (above - np.exp(middle * np.log(at) - at)) / middle, above)
    return np.asarray(np.maximum((above - np.exp(order * np.log(at) - at)) / order, 0.0))


def inverse(lf: Schechter, z_max: float = _Z_MAX_LIMIT) -> Inverse:
    """Return the table that `magnitude` interpolates: the luminosity above which galaxies have a given number density.

    The table covers redshifts from 0 to `z_max`.
    """
    alpha = lf.parameters_at(np.linspace(0.0, z_max, _A_NODES))[2]
    a = np.linspace(alpha.min(), alpha.max() + _A_MARGIN, _A_NODES) + 1.0
    ln_x = np.linspace(*_LN_X_RANGE, _X_NODES)
    with np.errstate(divide="ignore"):
        ln_g = np.log(upper_gamma(a[:, None], np.exp(ln_x)[None, :]))
    # `nodes` are the values of ln g in the first row (smallest a), whose range contains the ranges of all other rows.
    nodes = ln_g[0, ::-_X_STEP][np.isfinite(ln_g[0, ::-_X_STEP])]
    rows = [np.interp(nodes, row[::-1], ln_x[::-1]) for row in ln_g]
    return Inverse(lf, a, nodes, np.stack(rows))


def magnitude(table: Inverse, number: npt.ArrayLike, z: npt.ArrayLike) -> Float:
    """Return the magnitude at which the number density of brighter galaxies has a given value.

    Parameters
    ----------
    table : Inverse
        Table from `inverse`, which must cover the redshifts.
    number : float array, shape (n,)
        Comoving number density, (Mpc/h)^-3.
    z : float array, shape (n,)
        Redshift.

    Returns
    -------
    float array, shape (n,)
        Absolute magnitude M_r (mag) such that n(< M_r, z) = number. Beyond the table, the magnitude at its edge.

    Notes
    -----
    The error is below 0.003 mag for 1e-12 to 1 (Mpc/h)^-3 (tests/truesky/catalogue/halos/test_luminosity_function.py).
    """
    m_star, phi_star, alpha = table.schechter.parameters_at(z)
    row, above_row = bracket(table.a, alpha + 1.0)
    col, above_col = bracket(table.ln_g, np.log(np.asarray(number, float) / phi_star))
    low = table.ln_x[row, col] * (1.0 - above_col) + table.ln_x[row, col + 1] * above_col
    high = table.ln_x[row + 1, col] * (1.0 - above_col) + table.ln_x[row + 1, col + 1] * above_col
    return np.asarray(m_star - (low * (1.0 - above_row) + high * above_row) / _LN10_04)
