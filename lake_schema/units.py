"""Convert units of light: AB magnitudes, flux densities (microjansky or cgs) and detected electrons per second."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Float
from lake_schema.errors import OutOfRange

# Speed of light (km/s and angstrom/s), Planck constant (erg s) and Boltzmann constant (erg/K). They are exact by
# definition: SI Brochure (BIPM 2019).
LIGHT_KM_S = 299_792.458
LIGHT_ANGSTROM_S = 2.99792458e18
PLANCK_ERG_S = 6.62607015e-27
BOLTZMANN_ERG_K = 1.380649e-16

# Zero point of AB magnitudes: m_AB = -2.5 log10(f_nu / erg s-1 cm-2 Hz-1) - 48.6 (Oke & Gunn 1983).
AB_CGS = 48.6
# One microjansky in erg s-1 cm-2 Hz-1.
UJY_CGS = 1e-29
# Zero point of AB magnitudes for flux densities in microjansky, 72.5 - 48.6.
AB_UJY = 23.9
# Zero point AB_UJY as the difference 24.0 - 0.1. The binary number 24.0 is exact, so f_nu_of_mag loses no digits.
_AB_UJY_WHOLE, _AB_UJY_REST = 24.0, 0.1

# Smallest and largest AB magnitude that is accepted; a magnitude beyond them is a mistake. They correspond to 4e29 and
# 4e-31 microjansky, which single precision can represent.
MAG_LO, MAG_HI = -50.0, 100.0


def f_nu_of_mag(mag_ab: npt.ArrayLike) -> Float:
    """Convert AB magnitudes (any shape) to flux densities f_nu in microjansky, with a relative error of 4e-15.

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
    # Split the exponent into an integer and a rest of at most 0.5, so that the relative error of the flux density does
    # not increase with the magnitude.
    decades = np.rint((_AB_UJY_WHOLE - mag) / 2.5)
    rest = (_AB_UJY_WHOLE - 2.5 * decades) - mag - _AB_UJY_REST
    return np.asarray(10.0**decades * 10.0 ** (rest / 2.5))


def mag_of_f_nu(f_nu: npt.ArrayLike) -> Float:
    """Convert flux densities f_nu in microjansky (any shape) to AB magnitudes; a flux density of 0 gives +inf.

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
    """Convert flux densities (any shape) from microjansky to erg s-1 cm-2 Hz-1; nothing is checked."""
    return np.asarray(f_nu, float) * UJY_CGS


def ujy_of_cgs(f_nu: npt.ArrayLike) -> Float:
    """Convert flux densities (any shape) from erg s-1 cm-2 Hz-1 to microjansky; nothing is checked."""
    return np.asarray(f_nu, float) / UJY_CGS


def electron_rate(f_nu: npt.ArrayLike, collecting_area: float, log_width: float) -> Float:
    """Return the detected electrons per second of sources with a given band-averaged flux density.

    Parameters
    ----------
    f_nu : float array, any shape
        Flux density in microjansky, averaged over the band as int f_nu T dln(lambda) / int T dln(lambda). T is the
        total throughput of the band in electrons per arriving photon. Values are not checked.
    collecting_area : float
        Collecting area of the telescope in cm2, above 0.
    log_width : float
        Integral of the throughput, int T dln(lambda), above 0.

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
    """Return the AB magnitude of a source that gives one detected electron per second.

    `collecting_area` is in cm2. `log_width` is int T dln(lambda) with the throughput T in electrons per photon.
    OutOfRange is raised if one of them is not positive and finite.
    """
    return float(AB_UJY + 2.5 * np.log10(electron_rate(1.0, collecting_area, log_width)))
