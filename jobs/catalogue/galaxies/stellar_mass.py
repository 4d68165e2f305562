"""Stellar masses and star formation rates of galaxies.

log_stellar_mass    from luminosity and colour
light, log_sfr      from the template's ultraviolet light, internal dust undone

Luminosities are physical here: M = M_r + 5 log10 h, h = 0.67.
Ref: Bell et al. 2003, Kennicutt 1998; the numbers are in stellar_mass.toml.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jobs import sums
from jobs.catalogue import parameters
from jobs.catalogue.galaxies import band_ratios
from jobs.catalogue.galaxies.band_ratios import Sed
from jobs.fluxes.cosmology import HUBBLE
from jobs.fluxes.libraries.templates import Library
from lake_schema.arrays import Float, Int
from lake_schema.units import AB_CGS, LIGHT_ANGSTROM_S

_FILE = "stellar_mass.toml"
# 10 pc, IAU 2015 resolution B2.
_TEN_PARSEC_CM = 3.0856775814913673e19


@dataclass(frozen=True, slots=True)
class MassToLight:
    """Colour to mass-to-light ratio (stellar_mass.toml, [mass_to_light])."""

    sun: float
    intercept: float
    slope: float
    initial_mass: float
    to_rest: float
    limits: tuple[float, float]


@dataclass(frozen=True, slots=True)
class StarFormation:
    """Ultraviolet luminosity to star formation rate (stellar_mass.toml, [star_formation])."""

    per_luminosity: float
    first: float
    last: float
    calibration: float


@dataclass(frozen=True, slots=True, eq=False)
class Light:
    """What star formation rates are read from, made once by `light`.

    ultraviolet : [template] dust-free mean f_nu of the ultraviolet / f_nu in 0.1r
    dimming     : [4, template, e] ln of what laws 1 .. 4 let through in 0.1r, at E(B-V) nodes ebv
    """

    law: StarFormation
    ultraviolet: Float
    ebv: Float
    dimming: Float


def mass_to_light() -> MassToLight:
    """The mass-to-light ratios of the embedded universe."""
    return MassToLight(**parameters.section(_FILE, "mass_to_light"))


def light(library: Library, ebv: Float) -> Light:
    """Tables of a template library; ebv : nodes of E(B-V).

    ebv : float[e] mag
    """
    law = StarFormation(**parameters.section(_FILE, "star_formation"))
    spectra = library.flux.astype(np.float64)
    weights = band_ratios.band_weights(library, band_ratios.REFERENCE_BAND, 0.0)
    reference = sums.product(spectra, weights)
    inside = (library.wavelength >= law.first) & (library.wavelength <= law.last)
    f_nu = spectra[:, inside] * library.wavelength[inside] ** 2 / LIGHT_ANGSTROM_S
    through = sums.product(band_ratios.dusty(library, ebv) * weights, spectra.T)
    dimming = np.log(through / reference).transpose(0, 2, 1)
    return Light(law, f_nu.mean(1) / reference, ebv, np.ascontiguousarray(dimming))


def log_stellar_mass(law: MassToLight, m_r: Float, colour: Float) -> Float:
    """log10 of the stellar mass[n] / Msun.

    m_r : M_r[n]; colour : 0.1(g - r)[n]
    Ref: Bell et al. 2003, appendix 2
    """
    g_r = np.clip(colour - law.to_rest, *law.limits)
    return -0.4 * (_physical(m_r) - law.sun) + law.intercept + law.slope * g_r + law.initial_mass


def log_sfr(table: Light, m_r: Float, sed: Sed) -> Float:
    """log10 of the star formation rate[n] / (Msun/yr).

    m_r : float[n] M_r mag;  sed : n spectra
    Ref: Kennicutt 1998
    """
    total = sed.frac_1 * _undimmed(table, sed.template_1, sed) + sed.frac_2 * _undimmed(table, sed.template_2, sed)
    area = 4.0 * np.pi * _TEN_PARSEC_CM**2
    log_l_nu = -0.4 * (_physical(m_r) + AB_CGS) + np.log10(area * total)
    return np.asarray(np.log10(table.law.per_luminosity) + log_l_nu + table.law.calibration)


def _undimmed(table: Light, template: Int, sed: Sed) -> Float:
    """Dust-free ultraviolet f_nu for a unit flux in 0.1r that has passed the dust, [n]."""
    nodes = table.dimming[np.maximum(sed.law, 1) - 1, template]
    weights = band_ratios.ebv_weights(table.ebv, np.where(sed.law > 0, sed.ebv, 0.0))
    return np.asarray(table.ultraviolet[template] * np.exp(-np.sum(nodes * weights, axis=1)))


def _physical(m_r: Float) -> Float:
    return np.asarray(m_r + 5.0 * np.log10(HUBBLE))
