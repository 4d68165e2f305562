"""Units of light: AB magnitudes, flux densities, detected photons.

f_nu_of_mag, mag_of_f_nu       AB magnitude <-> f_nu, microjansky
cgs_of_ujy, ujy_of_cgs         microjansky <-> erg s-1 cm-2 Hz-1
electron_rate, zero_point      band-averaged f_nu <-> detected electrons
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Float
from lake_schema.errors import OutOfRange

# SI Brochure (BIPM 2019): exact by definition.
LIGHT_KM_S = 299_792.458
LIGHT_ANGSTROM_S = 2.99792458e18
PLANCK_ERG_S = 6.62607015e-27
BOLTZMANN_ERG_K = 1.380649e-16

# Oke & Gunn 1983: m_AB = -2.5 log10(f_nu / erg s-1 cm-2 Hz-1) - 48.6.
AB_CGS = 48.6
UJY_CGS = 1e-29
# The same zero point for microjansky, 72.5 - 48.6. Whole part and rest apart, f_nu_of_mag loses no digits.
AB_UJY = 23.9
_AB_UJY_WHOLE, _AB_UJY_REST = 24.0, 0.1

# Beyond these a magnitude is a mistake (and f_nu would leave single precision).
MAG_LO, MAG_HI = -50.0, 100.0


def f_nu_of_mag(mag_ab: npt.ArrayLike) -> Float:
    """AB magnitude -> f_nu in microjansky: 10^(-0.4 (m + 48.6)) erg s-1 cm-2 Hz-1.

    Serrano et al. 2024 print 10^(-0.4 m + 48.6) (appendix B), which is 10^68 too large.

    Error  : 4e-15 relative
    Errors : OutOfRange for NaN and for anything outside [-50, 100]
    """
    mag = np.asarray(mag_ab, float)
    bad = ~((mag >= MAG_LO) & (mag <= MAG_HI))
    if bad.any():
        raise OutOfRange("mag_ab", float(mag[bad].ravel()[0]), MAG_LO, MAG_HI)
    # The whole decades come out first: the rounding of what remains does not grow with the magnitude.
    decades = np.rint((_AB_UJY_WHOLE - mag) / 2.5)
    rest = (_AB_UJY_WHOLE - 2.5 * decades) - mag - _AB_UJY_REST
    return np.asarray(10.0**decades * 10.0 ** (rest / 2.5))


def mag_of_f_nu(f_nu: npt.ArrayLike) -> Float:
    """f_nu in microjansky -> AB magnitude; 0 gives +inf.  Errors: OutOfRange for NaN and negatives"""
    flux = np.asarray(f_nu, float)
    bad = ~((flux >= 0.0) & (flux < np.inf))
    if bad.any():
        raise OutOfRange("f_nu", float(flux[bad].ravel()[0]), 0.0, np.finfo(float).max)
    with np.errstate(divide="ignore"):
        return np.asarray(AB_UJY - 2.5 * np.log10(flux))


def cgs_of_ujy(f_nu: npt.ArrayLike) -> Float:
    """Microjansky -> erg s-1 cm-2 Hz-1."""
    return np.asarray(f_nu, float) * UJY_CGS


def ujy_of_cgs(f_nu: npt.ArrayLike) -> Float:
    """erg s-1 cm-2 Hz-1 -> microjansky."""
    return np.asarray(f_nu, float) / UJY_CGS


def electron_rate(f_nu: npt.ArrayLike, collecting_area: float, log_width: float) -> Float:
    """Detected electrons per second of sources with band-averaged flux density f_nu.

    f_nu            : [any shape] microjansky, averaged as int f_nu T dln(lambda) / int T dln(lambda)
    collecting_area : cm2
    log_width       : int T dln(lambda), T = total throughput (electrons per photon that arrives)
    """
    for name, value in (("collecting_area", collecting_area), ("log_width", log_width)):
        if not 0.0 < value < np.inf:
            raise OutOfRange(name, value, 0.0, np.inf)
    return cgs_of_ujy(f_nu) * (collecting_area * log_width / PLANCK_ERG_S)


def zero_point(collecting_area: float, log_width: float) -> float:
    """AB magnitude of a source that gives one electron per second; arguments as in `electron_rate`."""
    return float(AB_UJY + 2.5 * np.log10(electron_rate(1.0, collecting_area, log_width)))
