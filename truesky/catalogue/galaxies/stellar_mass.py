"""Stellar masses and star formation rates of galaxies.

M_r is the absolute magnitude in 0.1r (SDSS r blueshifted to z = 0.1) for h = 1. Here it is converted to the h of
the universe: M = M_r + 5 log10 h. Masses are for the initial mass function of Chabrier 2003 and rates for Kroupa 2001,
which give about the same values. The parameters are in stellar_mass.toml.

References
----------
Davidzon et al. 2017, Leja et al. 2020, Popesso et al. 2023
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lake_schema.arrays import Float, Int
from truesky import cosmology
from truesky.catalogue import parameters
from truesky.catalogue.galaxies.sequences import GREEN, RED
from truesky.randomness.per_source import AnyGenerator

_FILE = "stellar_mass.toml"


@dataclass(frozen=True, slots=True)
class MassToLight:
    """Parameters of the mass-to-light ratio by colour and redshift; explained in stellar_mass.toml, [mass_to_light]."""

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
    """Parameters of the star formation rate by mass and redshift; explained in stellar_mass.toml, [star_formation]."""

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
    """Return the built-in parameters of the mass-to-light ratio."""
    return MassToLight(**parameters.section(_FILE, "mass_to_light"))


def star_formation() -> StarFormation:
    """Return the built-in parameters of the star formation rate."""
    return StarFormation(**parameters.section(_FILE, "star_formation"))


def log_stellar_mass(law: MassToLight, hubble: float, m_r: Float, colour: Float, z: Float) -> Float:
    """Return the stellar mass from luminosity, colour and redshift.

    Parameters
    ----------
    law : MassToLight
        Parameters of the relation.
    hubble : float
        Hubble parameter h of the universe.
    m_r : float array, shape (n,)
        Absolute magnitude in 0.1r (SDSS r blueshifted to z = 0.1) for h = 1, mag.
    colour : float array, shape (n,)
        Rest-frame 0.1(g - r) (SDSS bands blueshifted to z = 0.1), mag.
    z : float array, shape (n,)
        Redshift.

    Returns
    -------
    float array, shape (n,)
        log10 of the stellar mass in Msun (not Msun/h), for the initial mass function of Chabrier 2003.

    References
    ----------
    Bell et al. 2003, appendix 2
    """
    g_r = np.clip(colour - law.to_rest, *law.limits)
    log_1pz = np.log10(1.0 + np.minimum(z, law.z_last))
    zero = law.intercept + law.intercept_l * log_1pz + law.intercept_l2 * log_1pz**2
    light = -0.4 * (m_r + 5.0 * np.log10(hubble) - law.sun)
    return np.asarray(light + zero + (law.slope + law.slope_l * log_1pz) * g_r)


def main_sequence(law: StarFormation, log_mass: Float, z: Float) -> Float:
    """Return the median star formation rate of star-forming galaxies.

    Parameters
    ----------
    law : StarFormation
        Parameters of the relation.
    log_mass : float array, shape (n,)
        log10 of the stellar mass, Msun.
    z : float array, shape (n,)
        Redshift.

    Returns
    -------
    float array, shape (n,)
        log10 of the star formation rate, Msun/yr.

    References
    ----------
    Popesso et al. 2023, eq. 10
    """
    age = cosmology.age(z, law.omega_m, law.hubble)
    below = law.bend * (law.bend_mass - law.bend_mass_t * age - log_mass)
    bend_term = np.logaddexp(0.0, np.log(10.0) * below) / np.log(10.0)
    return np.asarray(law.sequence - law.sequence_t * age - bend_term + law.median)


def log_sfr(law: StarFormation, main: Float, sequence: Int, deviate: Float, rng: AnyGenerator) -> Float:
    """Draw star formation rates around the main sequence (blue galaxies) or below it (green and red galaxies).

    Parameters
    ----------
    law : StarFormation
        Parameters of the scatter.
    main : float array, shape (n,)
        log10 of the median rate of star-forming galaxies (Msun/yr), from `main_sequence`.
    sequence : int array, shape (n,)
        Colour sequence of the galaxy: BLUE, GREEN or RED.
    deviate : float array, shape (n,)
        Place of the colour on its sequence, as a standard normal deviate; the bluer a blue galaxy (negative values),
        the higher its rate.
    rng : AnyGenerator
        Random numbers of the scatter.

    Returns
    -------
    float array, shape (n,)
        log10 of the star formation rate, Msun/yr (Kroupa).
    """
    normal = rng.standard_normal(main.size)
    blue = law.blue_scatter * (law.blue_own * normal - law.blue_colour * deviate)
    green, red = law.green + law.green_scatter * normal, law.red + law.red_scatter * normal
    return np.asarray(main + np.where(sequence == RED, red, np.where(sequence == GREEN, green, blue)))
