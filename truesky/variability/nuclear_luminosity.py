"""Convert between bolometric luminosities and absolute magnitudes of active nuclei.

References
----------
Runnoe, Brotherton & Shang 2012, MNRAS 422, 478; Richards et al. 2006, AJ 131, 2766
"""

from __future__ import annotations

import numpy as np

from lake_schema.arrays import Float
from lake_schema.units import AB_CGS, LIGHT_ANGSTROM_S

# Ratio of the bolometric luminosity to lambda L_lambda at 1450 A: Runnoe et al. 2012, without their correction for the
# viewing angle (from memory).
_CORRECTION = 4.2
# M_1450 - M_i for the i band K-corrected to z = 2: Richards et al. 2006, eq. 3 (from memory).
_FROM_I = 1.486
_TEN_PARSEC_CM = 3.0856775814913673e19


def log_luminosity(m_1450: Float) -> Float:
    """Return log10 of the bolometric luminosity (erg/s) from the absolute AB magnitude at 1450 A."""
    area = np.log10(4.0 * np.pi) + 2.0 * np.log10(_TEN_PARSEC_CM)
    return np.asarray(area - 0.4 * (m_1450 + AB_CGS) + np.log10(_CORRECTION * LIGHT_ANGSTROM_S / 1450.0))


def ultraviolet_magnitude(log_l: Float) -> Float:
    """Return the absolute AB magnitude at 1450 A from log10 of the bolometric luminosity (erg/s)."""
    return np.asarray(2.5 * (log_luminosity(np.zeros(1)) - log_l))


def i_magnitude(m_1450: Float) -> Float:
    """Return the absolute i magnitude, K-corrected to z = 2, from the absolute AB magnitude at 1450 A."""
    return np.asarray(m_1450 - _FROM_I)
