"""Stellar masses and star formation rates of galaxies.

log_stellar_mass    from luminosity, colour and redshift
main_sequence       the median rate of galaxies that form stars, from mass and redshift
log_sfr             drawn about it, by sequence and colour

Luminosities are physical here: M = M_r + 5 log10 h, h = 0.67. Masses and rates are of the initial mass functions of
Chabrier 2003 and Kroupa 2001, which give the same ones.
Ref: Davidzon et al. 2017, Leja et al. 2020, Popesso et al. 2023; the numbers are in stellar_mass.toml.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lake_schema.arrays import Float, Int
from truesky.catalogue import parameters
from truesky.catalogue.galaxies.sequences import GREEN, RED
from truesky.fluxes import cosmology
from truesky.randomness.per_source import AnyGenerator

_FILE = "stellar_mass.toml"


@dataclass(frozen=True, slots=True)
class MassToLight:
    """Colour to mass-to-light ratio (stellar_mass.toml, [mass_to_light])."""

    sun: float
    intercept: float
    intercept_l: float
    intercept_l2: float
    slope: float
    slope_l: float
    z_last: float
    to_rest: float
    limits: tuple[float, float]


@dataclass(frozen=True, slots=True)
class StarFormation:
    """The main sequence, and the galaxies about and below it (stellar_mass.toml, [star_formation])."""

    sequence: float
    sequence_t: float
    bend: float
    bend_mass: float
    bend_mass_t: float
    median: float
    blue_scatter: float
    blue_colour: float
    blue_own: float
    green: float
    green_scatter: float
    red: float
    red_scatter: float
    omega_m: float
    hubble: float


def mass_to_light() -> MassToLight:
    """The mass-to-light ratios of the embedded universe."""
    return MassToLight(**parameters.section(_FILE, "mass_to_light"))


def star_formation() -> StarFormation:
    """The star formation rates of the embedded universe."""
    return StarFormation(**parameters.section(_FILE, "star_formation"))


def log_stellar_mass(law: MassToLight, m_r: Float, colour: Float, z: Float) -> Float:
    """log10 of the stellar mass[n] / Msun, Chabrier.

    m_r : float[n] M_r mag;  colour : float[n] 0.1(g - r) mag;  z : float[n];  law : constants
    Ref: Bell et al. 2003, appendix 2
    """
    g_r = np.clip(colour - law.to_rest, *law.limits)
    log_1pz = np.log10(1.0 + np.minimum(z, law.z_last))
    zero = law.intercept + law.intercept_l * log_1pz + law.intercept_l2 * log_1pz**2
    light = -0.4 * (m_r + 5.0 * np.log10(cosmology.HUBBLE) - law.sun)
    return np.asarray(light + zero + (law.slope + law.slope_l * log_1pz) * g_r)


def main_sequence(law: StarFormation, log_mass: Float, z: Float) -> Float:
    """log10 of the median star formation rate[n] / (Msun/yr) of star-forming galaxies.

    log_mass : float[n] log10 Msun;  z : float[n];  law : constants
    Ref: Popesso et al. 2023, eq. 10
    """
    age = cosmology.age(z, law.omega_m, law.hubble)
    below = law.bend * (law.bend_mass - law.bend_mass_t * age - log_mass)
    bend_term = np.logaddexp(0.0, np.log(10.0) * below) / np.log(10.0)
    return np.asarray(law.sequence - law.sequence_t * age - bend_term + law.median)


def log_sfr(law: StarFormation, main: Float, sequence: Int, deviate: Float, rng: AnyGenerator) -> Float:
    """log10 of the star formation rate[n] / (Msun/yr), Kroupa: bluer galaxies of the blue sequence form more.

    main     : float[n] of `main_sequence`;  sequence : int[n];  deviate : float[n] of the colour on it
    law      : constants;  rng : of the scatter
    """
    normal = rng.standard_normal(main.size)
    blue = law.blue_scatter * (law.blue_own * normal - law.blue_colour * deviate)
    green, red = law.green + law.green_scatter * normal, law.red + law.red_scatter * normal
    return np.asarray(main + np.where(sequence == RED, red, np.where(sequence == GREEN, green, blue)))
