"""Decide which stars pulsate, and draw their periods and amplitudes.

RR Lyrae stars and classical Cepheids are giants inside the instability strip, and long-period variables are cool
giants near the tip of the giant branch. Periods follow from the luminosity, the temperature and the radius of a star,
which the catalogue contains; amplitudes are drawn around published relations. The random numbers are keyed by the star.

Notes
-----
The isochrones lose the same mass at all stars of an age and metallicity, so that their horizontal branch is inside the
instability strip only for [M/H] < -1.8 in the halo, and far outside it in the disc and the bulge. RR Lyrae stars are
therefore metal-poor, and all of them are halo stars. `RR_LYRAE_FRACTION` reduces their number to the observed one. The
isochrones end at the first thermal pulse, so that luminous Miras are missing.

References
----------
Marconi et al. 2015, ApJ 808, 50 (periods and masses of RR Lyrae stars); Cacciari et al. 2005, AJ 129, 267 (amplitudes);
Gieren et al. 1999, ApJ 512, 553 (radii of Cepheids); Whitelock et al. 2008, MNRAS 386, 313 (periods of Miras)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lake_schema.arrays import Bool, Float, Int
from truesky.randomness.per_source import AnyGenerator

CONSTANT, RR_AB, RR_C, CEPHEID, MIRA, SEMIREGULAR = range(6)
GIANT_STAGE = 1
# log10 of the surface gravity of the Sun (cm s-2), and its temperature (K): nominal values of IAU 2015.
_SUN_LOG_G, _SUN_TEFF = 4.438, 5772.0
# Metallicity of the Sun as a mass fraction (Asplund et al. 2009, bulk abundance).
_SUN_Z = 0.0142
# Temperatures (K) of the red edge of the strip, of the limit between RRab and RRc, and of the blue edge, at the
# luminosity of the horizontal branch; rounded after Marconi et al. 2015, Fig. 2.
_RR_TEFF = (6000.0, 6900.0, 7400.0)
# Range of log10 L / Lsun, and largest mass at birth (Msun), of RR Lyrae stars; adopted.
_RR_LOG_L, _RR_MASS = (1.5, 2.0), 1.0
# Fraction of the giants inside the strip that are RR Lyrae stars. It is set to the number of RR Lyrae stars at high
# Galactic latitude without those in streams: 80 % (Sesar et al. 2010, ApJ 708, 717) of 1372 in 840 deg2 (Zinn et al.
# 2014, ApJ 781, 22).
RR_LYRAE_FRACTION = 0.2
# Masses (Msun) on the zero-age horizontal branch by log10 of the metallicity Z; Marconi et al. 2015, Table 1.
_RR_LOG_Z = np.log10([0.0001, 0.0003, 0.0006, 0.001, 0.002, 0.004, 0.008])
_RR_MASSES = np.array([0.80, 0.716, 0.67, 0.64, 0.60, 0.59, 0.56])
# Scatter of the amplitude of RRab stars around its mean, mean and scatter for RRc stars, and limits, mag in V; adopted.
_RR_AB_SCATTER, _RR_C_AMPLITUDE = 0.12, (0.45, 0.08)
RR_AMPLITUDES = (0.2, 1.5)
# Stars below this [M/H] follow the relation of Oosterhoff type II, which has longer periods by 0.06 in log10.
_OOSTERHOFF_II, _OOSTERHOFF_SHIFT = -1.5, 0.06
# Lowest mass at birth (Msun) and log10 L / Lsun of Cepheids, the middle of the instability strip, log10 Teff = a + b
# (log10 L - 3.4), and its half width; adopted after Tammann et al. 2003, A&A 404, 423.
_CEPHEID_MASS, _CEPHEID_LOG_L = 3.0, 2.6
_CEPHEID_STRIP, _CEPHEID_WIDTH = (3.765, -0.075), 0.025
# Mean amplitudes of Cepheids (mag in V) by log10 of the period (d), scatter and limits; adopted after Klagyivik &
# Szabados 2009, A&A 504, 959.
_CEPHEID_LOG_PERIOD = np.array([0.4, 0.7, 0.95, 1.1, 1.4, 1.7])
_CEPHEID_AMPLITUDE = np.array([0.50, 0.70, 0.60, 0.75, 1.05, 0.90])
_CEPHEID_SCATTER, CEPHEID_AMPLITUDES = 0.15, (0.1, 1.4)
# Highest temperature (K), and faintest absolute K magnitude (Vega), of long-period variables, and of Miras among them;
# adopted. All cool giants near the tip of the giant branch vary (Kiss & Bedding 2003, MNRAS 343, L79).
_LPV_TEFF, _LPV_K = 4000.0, -5.5
_MIRA_TEFF, _MIRA_K, MIRA_FRACTION = 3600.0, -6.3, 0.1
# H - K of cool giants, mag (Bessell & Brett 1988, PASP 100, 1134, rounded).
_GIANT_H_K = 0.25
# Semi-regular variables pulsate in the first overtone, whose period is half as long; adopted.
_OVERTONE = 0.3
# Mean and scatter of the amplitude of Miras, mag in V; median amplitude of semi-regular variables with a period of
# 50 d, its power of the period, and its scatter in log10; adopted.
_MIRA_AMPLITUDE, MIRA_AMPLITUDES = (4.5, 1.0), (2.5, 8.0)
_SEMIREGULAR_AMPLITUDE, SEMIREGULAR_AMPLITUDES = (0.10, 1.2, 0.25), (0.01, 2.5)


@dataclass(frozen=True, slots=True, eq=False)
class StarProperties:
    """Properties of n stars from the columns of table `stars`; unknown values are NaN.

    Attributes
    ----------
    teff : float array, shape (n,)
        Effective temperature, K.
    log_g : float array, shape (n,)
        log10 of the surface gravity, cm s-2.
    mass : float array, shape (n,)
        Mass at birth, Msun, from which `log_g` was computed.
    metallicity : float array, shape (n,)
        [M/H].
    m_h : float array, shape (n,)
        Absolute H magnitude (Vega).
    is_giant : bool array, shape (n,)
        True for stars on the giant branch or later, until their death.
    """

    teff: Float
    log_g: Float
    mass: Float
    metallicity: Float
    m_h: Float
    is_giant: Bool

    def select(self, chosen: Int) -> StarProperties:
        """Return the stars with these indices."""
        return StarProperties(
            self.teff[chosen],
            self.log_g[chosen],
            self.mass[chosen],
            self.metallicity[chosen],
            self.m_h[chosen],
            self.is_giant[chosen],
        )


@dataclass(frozen=True, slots=True, eq=False)
class Pulsations:
    """Pulsations of n stars.

    Attributes
    ----------
    kind : int array, shape (n,)
        CONSTANT, RR_AB, RR_C, CEPHEID, MIRA or SEMIREGULAR.
    period : float array, shape (n,)
        Period, d; NaN for constant stars.
    amplitude : float array, shape (n,)
        Difference between minimum and maximum in V, mag; NaN for constant stars.
    """

    kind: Int
    period: Float
    amplitude: Float


def may_pulsate(stars: StarProperties) -> Int:
    """Return the indices of the stars that `draw` may make variable: giants near the strip, and cool giants."""
    with np.errstate(invalid="ignore"):
        is_cool = (stars.teff < _LPV_TEFF) & (stars.m_h - _GIANT_H_K < _LPV_K)
        is_warm = (stars.teff > 4000.0) & (stars.teff < _RR_TEFF[2]) & np.isfinite(stars.mass)
        return np.flatnonzero(stars.is_giant & np.isfinite(stars.log_g) & (is_cool | is_warm))


def draw(stars: StarProperties, rng: AnyGenerator) -> Pulsations:
    """Draw the pulsations of stars.

    Parameters
    ----------
    stars : StarProperties
        n stars.
    rng : AnyGenerator
        Random numbers, two per star; a star that does not pulsate uses as many as one that does.

    Returns
    -------
    Pulsations
        Pulsations of the n stars, most of which are constant.
    """
    n = stars.teff.size
    chance, deviate = rng.random(n), rng.standard_normal(n)
    log_l = log_luminosity(stars)
    with np.errstate(invalid="ignore", divide="ignore"):
        m_k = stars.m_h - _GIANT_H_K
        is_rr = stars.is_giant & (stars.mass < _RR_MASS) & (log_l > _RR_LOG_L[0]) & (log_l < _RR_LOG_L[1])
        is_rr &= (stars.teff >= _RR_TEFF[0]) & (stars.teff < _RR_TEFF[2]) & (chance < RR_LYRAE_FRACTION)
        middle = _CEPHEID_STRIP[0] + _CEPHEID_STRIP[1] * (log_l - 3.4)
        is_cepheid = stars.is_giant & (stars.mass >= _CEPHEID_MASS) & (log_l > _CEPHEID_LOG_L)
        is_cepheid &= np.abs(np.log10(stars.teff) - middle) < _CEPHEID_WIDTH
        is_long = stars.is_giant & (stars.teff < _LPV_TEFF) & (m_k < _LPV_K) & ~is_cepheid
        is_mira = is_long & (stars.teff < _MIRA_TEFF) & (m_k < _MIRA_K) & (chance < MIRA_FRACTION)
    kind = np.select(
        [is_rr & (stars.teff < _RR_TEFF[1]), is_rr, is_cepheid, is_mira, is_long],
        [RR_AB, RR_C, CEPHEID, MIRA, SEMIREGULAR],
        CONSTANT,
    )
    period, amplitude = np.full(n, np.nan), np.full(n, np.nan)
    for code, find_period, find_amplitude in (
        (RR_AB, rr_lyrae_period, _rr_ab_amplitude),
        (RR_C, rr_lyrae_overtone_period, _rr_c_amplitude),
        (CEPHEID, cepheid_period, _cepheid_amplitude),
        (MIRA, mira_period, _mira_amplitude),
        (SEMIREGULAR, semiregular_period, _semiregular_amplitude),
    ):
        members = np.flatnonzero(kind == code)
        chosen = stars.select(members)
        period[members] = find_period(chosen)
        amplitude[members] = find_amplitude(chosen, period[members], deviate[members])
    return Pulsations(kind, period, amplitude)


def log_luminosity(stars: StarProperties) -> Float:
    """Return log10 L / Lsun of stars from mass, gravity and temperature; NaN where one of these is unknown."""
    with np.errstate(invalid="ignore", divide="ignore"):
        log_mass, log_teff = np.log10(stars.mass), np.log10(stars.teff / _SUN_TEFF)
    return np.asarray(_SUN_LOG_G - stars.log_g + log_mass + 4.0 * log_teff)


def rr_lyrae_period(stars: StarProperties) -> Float:
    """Return the fundamental periods (d) of stars on the horizontal branch (Marconi et al. 2015, eq. 1)."""
    log_mass, log_z = _horizontal_branch(stars)
    log_p = 11.347 + 0.860 * log_luminosity(stars) - 0.58 * log_mass - 3.43 * np.log10(stars.teff) + 0.024 * log_z
    return np.asarray(10.0**log_p)


def rr_lyrae_overtone_period(stars: StarProperties) -> Float:
    """Return the first-overtone periods (d) of stars on the horizontal branch (Marconi et al. 2015, eq. 2)."""
    log_mass, log_z = _horizontal_branch(stars)
    log_p = 11.167 + 0.822 * log_luminosity(stars) - 0.56 * log_mass - 3.40 * np.log10(stars.teff) + 0.013 * log_z
    return np.asarray(10.0**log_p)


def _horizontal_branch(stars: StarProperties) -> tuple[Float, Float]:
    """Return log10 of the mass (Msun) on the horizontal branch, and log10 of the metallicity Z."""
    log_z = np.log10(_SUN_Z) + stars.metallicity
    return np.log10(np.interp(log_z, _RR_LOG_Z, _RR_MASSES)), log_z


def rr_lyrae_amplitude(period: Float, metallicity: Float) -> Float:
    """Return the mean amplitudes (mag in V) of RRab stars by period (d) and [M/H].

    The relation is the quadratic one of Cacciari et al. 2005 for regular stars of M3 (Oosterhoff type I). Metal-poor
    stars have the same amplitude at a period that is 0.06 longer in log10 (Oosterhoff type II).
    """
    log_p = np.log10(period) - np.where(metallicity < _OOSTERHOFF_II, _OOSTERHOFF_SHIFT, 0.0)
    # The parabola has its maximum at P = 0.44 d; shorter periods get its maximum.
    log_p = np.maximum(log_p, -22.046 / (2.0 * 30.876))
    return np.asarray(-2.627 - 22.046 * log_p - 30.876 * log_p**2)


def _rr_ab_amplitude(stars: StarProperties, period: Float, deviate: Float) -> Float:
    mean = rr_lyrae_amplitude(period, stars.metallicity)
    return np.clip(mean + _RR_AB_SCATTER * deviate, *RR_AMPLITUDES)


def _rr_c_amplitude(stars: StarProperties, period: Float, deviate: Float) -> Float:
    return np.clip(_RR_C_AMPLITUDE[0] + _RR_C_AMPLITUDE[1] * deviate, *RR_AMPLITUDES)


def cepheid_period(stars: StarProperties) -> Float:
    """Return the periods (d) of Cepheids from their radii, log R = 1.146 + 0.680 log P (Gieren et al. 1999)."""
    log_radius = 0.5 * (_SUN_LOG_G - stars.log_g + np.log10(stars.mass))
    return np.asarray(10.0 ** ((log_radius - 1.146) / 0.680))


def _cepheid_amplitude(stars: StarProperties, period: Float, deviate: Float) -> Float:
    mean = np.interp(np.log10(period), _CEPHEID_LOG_PERIOD, _CEPHEID_AMPLITUDE)
    return np.asarray(np.clip(mean + _CEPHEID_SCATTER * deviate, *CEPHEID_AMPLITUDES))


def mira_period(stars: StarProperties) -> Float:
    """Return the periods (d) of Miras, M_K = -7.25 - 3.51 (log P - 2.38) (Whitelock et al. 2008, Milky Way)."""
    return np.asarray(10.0 ** (2.38 - (stars.m_h - _GIANT_H_K + 7.25) / 3.51))


def semiregular_period(stars: StarProperties) -> Float:
    """Return the periods (d) of semi-regular variables: half of the period of a Mira with this luminosity."""
    return np.asarray(mira_period(stars) * 10.0**-_OVERTONE)


def _mira_amplitude(stars: StarProperties, period: Float, deviate: Float) -> Float:
    return np.clip(_MIRA_AMPLITUDE[0] + _MIRA_AMPLITUDE[1] * deviate, *MIRA_AMPLITUDES)


def _semiregular_amplitude(stars: StarProperties, period: Float, deviate: Float) -> Float:
    median, power, scatter = _SEMIREGULAR_AMPLITUDE
    amplitude = median * (period / 50.0) ** power * 10.0 ** (scatter * deviate)
    return np.asarray(np.clip(amplitude, *SEMIREGULAR_AMPLITUDES))
