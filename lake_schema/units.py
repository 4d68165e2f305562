"""Convert units of light: AB magnitudes, flux densities (microjansky or cgs) and detected electrons per second."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Float
from lake_schema.errors import OutOfRange

# Exact by definition: SI Brochure (BIPM 2019).
LIGHT_KM_S = 299_792.458
LIGHT_ANGSTROM_S = 2.99792458e18
PLANCK_ERG_S = 6.62607015e-27
BOLTZMANN_ERG_K = 1.380649e-16

# Oke & Gunn 1983: m_AB = -2.5 log10(f_nu / erg s-1 cm-2 Hz-1) - 48.6.
AB_CGS = 48.6
UJY_CGS = 1e-29
# The same zero point for microjansky, 72.5 - 48.6. It is split so that f_nu_of_mag loses no digits.
AB_UJY = 23.9
_AB_UJY_WHOLE, _AB_UJY_REST = 24.0, 0.1

# A magnitude outside these limits is a mistake, and f_nu would exceed the range of single precision.
MAG_LO, MAG_HI = -50.0, 100.0


def f_nu_of_mag(mag_ab: npt.ArrayLike) -> Float:
    """Convert AB magnitudes to f_nu in microjansky, with a relative error of 4e-15.

    Raises
    ------
    OutOfRange
        If a magnitude is NaN or outside [-50, 100].

    Notes
    -----
    The flux density is::

        f_nu = 10^(-0.4 (m + 48.6)) erg s-1 cm-2 Hz-1

    Serrano et al. 2024 (appendix B) print 10^(-0.4 m + 48.6), which is 10^68 too large.
    """
    mag = np.asarray(mag_ab, float)
    bad = ~((mag >= MAG_LO) & (mag <= MAG_HI))
    if bad.any():
        raise OutOfRange("mag_ab", float(mag[bad].ravel()[0]), MAG_LO, MAG_HI)
    # Separating whole decades keeps the rounding error of the rest independent of the magnitude.
    decades = np.rint((_AB_UJY_WHOLE - mag) / 2.5)
    rest = (_AB_UJY_WHOLE - 2.5 * decades) - mag - _AB_UJY_REST
    return np.asarray(10.0**decades * 10.0 ** (rest / 2.5))


def mag_of_f_nu(f_nu: npt.ArrayLike) -> Float:
    """Convert f_nu in microjansky to AB magnitudes; 0 gives +inf.

    Raises
    ------
    OutOfRange
        If a flux density is NaN, infinite or negative.
    """
    flux = np.asarray(f_nu, float)
    bad = ~((flux >= 0.0) & (flux < np.inf))
    if bad.any():
        raise OutOfRange("f_nu", float(flux[bad].ravel()[0]), 0.0, np.finfo(float).max)
    with np.errstate(divide="ignore"):
        return np.asarray(AB_UJY - 2.5 * np.log10(flux))


def cgs_of_ujy(f_nu: npt.ArrayLike) -> Float:
    """Convert microjansky to erg s-1 cm-2 Hz-1."""
    return np.asarray(f_nu, float) * UJY_CGS


def ujy_of_cgs(f_nu: npt.ArrayLike) -> Float:
    """Convert erg s-1 cm-2 Hz-1 to microjansky."""
    return np.asarray(f_nu, float) / UJY_CGS


def electron_rate(f_nu: npt.ArrayLike, collecting_area: float, log_width: float) -> Float:
    """Return the detected electrons per second of sources with a given band-averaged flux density.

    Parameters
    ----------
    f_nu : float array, any shape
        Flux density in microjansky, averaged as int f_nu T dln(lambda) / int T dln(lambda).
    collecting_area : float
        Collecting area in cm2, above 0.
    log_width : float
        int T dln(lambda), above 0, with the total throughput T in electrons per arriving photon.

    Returns
    -------
    float array, shape of `f_nu`
        Electrons per second.

    Raises
    ------
    OutOfRange
        If `collecting_area` or `log_width` is not positive and finite.
    """
    for name, value in (("collecting_area", collecting_area), ("log_width", log_width)):
        if not 0.0 < value < np.inf:
            raise OutOfRange(name, value, 0.0, np.inf)
    return cgs_of_ujy(f_nu) * (collecting_area * log_width / PLANCK_ERG_S)


def zero_point(collecting_area: float, log_width: float) -> float:
    """Return the AB magnitude of a source that gives one electron per second. Parameters: see `electron_rate`."""
    return float(AB_UJY + 2.5 * np.log10(electron_rate(1.0, collecting_area, log_width)))
