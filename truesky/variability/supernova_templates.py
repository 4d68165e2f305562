"""Spectra of supernovae by kind, rest-frame phase and wavelength.

Type Ia supernovae have the spectral series of Hsiao et al. 2007. Core-collapse supernovae have the spectra of black
bodies whose luminosity and temperature change with time (core_collapse.csv), with less ultraviolet light.

References
----------
Hsiao et al. 2007, ApJ 663, 1187. The decline rates in core_collapse.csv follow Anderson et al. 2014, ApJ 786, 67 (II-P
and II-L), Nyholm et al. 2020, A&A 637, A73 (IIn) and Taddia et al. 2018, A&A 609, A136 (IIb, Ib and Ic); after the
plateau, the light declines as fast as 56Co decays, 0.98 mag in 100 days. Temperatures follow Faran et al. 2018,
MNRAS 473, 513 (II) and Taddia et al. 2018. All numbers between these are assumed.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import scipy

from lake_schema.arrays import Float, Int
from lake_schema.units import AB_CGS, BOLTZMANN_ERG_K, LIGHT_ANGSTROM_S, PLANCK_ERG_S
from truesky.fluxes import passbands
from truesky.fluxes.libraries.stellar import NORMALISATION_RANGE, planck

TYPE_IA_FILE = Path(__file__).with_name("hsiao_2007.npz")
_CORE_COLLAPSE = Path(__file__).with_name("core_collapse.csv")
# Codes of the kinds of supernovae in column `type` of table `transients`.
KINDS = {"Ia": 1, "II-P": 2, "II-L": 3, "IIn": 4, "IIb": 5, "Ib": 6, "Ic": 7}
TYPE_IA = KINDS["Ia"]
# Passband in which peak magnitudes are given.
PEAK_BAND = "bessell_b"
# Decline of type Ia supernovae after the last phase of their series, mag per day in the rest frame: Lair et al. 2006,
# AJ 132, 2024 (B and V, 1.4 mag in 100 days). The spectrum stays that of the last phase.
_LATE_DECLINE = 0.014
# Last phase of type Ia supernovae, days in the rest frame: 6 mag below the peak of B (assumed).
_LAST_PHASE = 260.0
# Rest-frame wavelengths of core-collapse supernovae, A.
_WAVELENGTH = np.arange(1000.0, 25001.0, 25.0)
# Below this wavelength (A), the light of core-collapse supernovae falls as the square of the wavelength, because metal
# lines absorb it. Assumed, after Dessart & Hillier 2005, A&A 437, 667.
_BLANKETED = 3800.0
_BLANKETING_EXPONENT = 2.0


@dataclass(frozen=True, slots=True, eq=False)
class Template:
    """Spectra of a supernova by phase and wavelength, at a distance of 10 pc.

    Attributes
    ----------
    phase : float array, shape (p,)
        Days in the rest frame after the peak in `PEAK_BAND`, increasing. There is no light before the first and after
        the last.
    wavelength : float array, shape (w,)
        Wavelengths in the rest frame, A, in equal steps. There is no light outside of them.
    flux : float array, shape (p, w)
        f_lambda in erg s-1 cm-2 A-1, such that the AB magnitude in `PEAK_BAND` at phase 0 is 0.
    """

    phase: Float
    wavelength: Float
    flux: Float

    def at_phases(self, phase: Float) -> tuple[Int, Float]:
        """Return the row of `flux` before each phase [...], and the weights [..., 2] of this and of the next row.

        Weights are 0 outside the range of phases.
        """
        row = np.clip(np.searchsorted(self.phase, phase, side="right") - 1, 0, len(self.phase) - 2)
        share = (phase - self.phase[row]) / (self.phase[row + 1] - self.phase[row])
        shines = (share >= 0.0) & (share <= 1.0)
        return row, np.where(shines[..., None], np.stack([1.0 - share, share], axis=-1), 0.0)


@lru_cache(maxsize=1)
def templates() -> Mapping[int, Template]:
    """Return the spectra of all kinds of supernovae by code (`KINDS`)."""
    knots: dict[str, list[tuple[float, float, float]]] = {}
    with _CORE_COLLAPSE.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            knots.setdefault(row["kind"], []).append(
                (float(row["day"]), float(row["magnitude"]), float(row["temperature"]))
            )
    with np.load(TYPE_IA_FILE) as file:
        series = (file[name].astype(float) for name in ("phase", "wavelength", "flux"))
        type_ia = normalise_template(*with_late_phases(*series))
    return {TYPE_IA: type_ia} | {
        KINDS[kind]: black_body_template(np.array(rows)) for kind, rows in sorted(knots.items())
    }


def black_body_template(knots: Float) -> Template:
    """Return the spectra of a supernova that radiates like a black body with blanketed ultraviolet light.

    Parameters
    ----------
    knots : float array, shape (k, 3)
        Days after the explosion in the rest frame, bolometric magnitude on any scale, and temperature in K.

    Returns
    -------
    Template
        The spectra, one per day. Cubic polynomials without overshoots join magnitudes and logarithms of temperatures.
    """
    day = np.arange(knots[0, 0], knots[-1, 0] + 0.5)
    magnitude, log_temperature = (
        np.asarray(scipy.interpolate.pchip_interpolate(knots[:, 0], values, day), float)
        for values in (knots[:, 1], np.log(knots[:, 2]))
    )
    temperature = np.exp(log_temperature)
    spectra = np.stack([_black_body(hot) for hot in temperature]) * 10.0 ** (-0.4 * magnitude[:, None])
    blanketing = np.minimum(_WAVELENGTH / _BLANKETED, 1.0) ** _BLANKETING_EXPONENT
    return normalise_template(day, _WAVELENGTH, spectra * blanketing)


def _black_body(temperature: float) -> Float:
    """Return f_lambda of a black body at `_WAVELENGTH`, with the same total light for all temperatures."""
    middle = float(np.mean(NORMALISATION_RANGE))
    at_middle = np.expm1(PLANCK_ERG_S * LIGHT_ANGSTROM_S / (BOLTZMANN_ERG_K * temperature * middle))
    # `planck` is 1 in the middle of NORMALISATION_RANGE, and the total light grows as temperature^4.
    return np.asarray(planck(_WAVELENGTH, temperature) / (at_middle * (temperature / 1e4) ** 4))


def with_late_phases(phase: Float, wavelength: Float, flux: Float) -> tuple[Float, Float, Float]:
    """Return a spectral series with an exponential decline after its last phase.

    Parameters
    ----------
    phase : float array, shape (p,)
        Days in the rest frame.
    wavelength : float array, shape (w,)
        Wavelengths, A.
    flux : float array, shape (p, w)
        f_lambda on any scale.

    Returns
    -------
    (float array, float array, float array)
        Phases with one more, wavelengths, and fluxes.
    """
    late = np.arange(phase[-1] + 1.0, _LAST_PHASE + 0.5)
    dimming = 10.0 ** (-0.4 * _LATE_DECLINE * (late - phase[-1]))
    return np.append(phase, late), wavelength, np.concatenate([flux, flux[-1] * dimming[:, None]])


def normalise_template(phase: Float, wavelength: Float, flux: Float) -> Template:
    """Return a template whose phase 0 is the peak in `PEAK_BAND`, with 0 mag (AB) there.

    Parameters
    ----------
    phase : float array, shape (p,)
        Days in the rest frame from any moment, increasing.
    wavelength : float array, shape (w,)
        Wavelengths in the rest frame, A, in equal steps; they cover `PEAK_BAND`.
    flux : float array, shape (p, w)
        f_lambda on any scale.

    Returns
    -------
    Template
        The template.
    """
    light = passbands.ab_flux(passbands.load(PEAK_BAND), wavelength, flux)
    peak = int(np.argmax(light))
    return Template(phase - phase[peak], wavelength, flux * (10.0 ** (-0.4 * AB_CGS) / light[peak]))
