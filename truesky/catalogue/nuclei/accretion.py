"""Draw which galaxies have an active nucleus, its luminosity, its type and the mass of its black hole.

The specific accretion rate is the bolometric luminosity per stellar mass, in units of the Eddington luminosity of a
black hole with 0.2 % of the stellar mass. It has a power law that is the same for all stellar masses and increases with
redshift. Galaxies below its smallest rate have no active nucleus. Nuclei of type 1 that are as luminous as the quasars
of table `galaxies` are left out, because the quasars are drawn separately. The parameters are in active_nuclei.toml.

References
----------
Aird et al. 2012, ApJ 746, 90; Merloni et al. 2014, MNRAS 437, 3550; Kormendy & Ho 2013, ARA&A 51, 511
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lake_schema.arrays import Bool, Float, Int
from truesky.catalogue import parameters
from truesky.randomness.per_source import PerSourceGenerator
from truesky.variability import nuclear_luminosity

_FILE = "active_nuclei.toml"
# Types of nuclei: the continuum and the broad lines of type 2 are hidden by dust.
NONE, TYPE_1, TYPE_2 = 0, 1, 2
# Redshift of the nearest quasars of table `galaxies` (high_redshift.toml).
_FIRST_QUASARS = 0.3


@dataclass(frozen=True, slots=True)
class Accretion:
    """Parameters of the distribution of accretion rates; explained in active_nuclei.toml, [accretion]."""

    log_share: float
    slope: float
    z_slope: float
    z_pivot: float
    z_last: float
    log_rates: tuple[float, float]
    largest_share: float
    least_log_mass: float
    mass_ratio: float
    eddington: float


@dataclass(frozen=True, slots=True)
class Types:
    """Parameters of the share of type 2; explained in active_nuclei.toml, [types]."""

    middle: float
    log_x: float
    width: float
    x_ray: float
    limits: tuple[float, float]


@dataclass(frozen=True, slots=True)
class BlackHoles:
    """Parameters of black-hole masses by bulge mass; explained in active_nuclei.toml, [black_holes]."""

    zero: float
    slope: float
    scatter: float
    least_bulge: float


@dataclass(frozen=True, slots=True)
class QuasarBlackHoles:
    """Parameters of black-hole masses of quasars; explained in active_nuclei.toml, [quasar_black_holes]."""

    zero: float
    slope: float
    scatter: float
    scatter_slope: float


@dataclass(frozen=True, slots=True)
class Laws:
    """Parameters from which nuclei are drawn.

    Attributes
    ----------
    accretion, types, black_holes, quasar_black_holes : Accretion, Types, BlackHoles, QuasarBlackHoles
        Tables of active_nuclei.toml.
    faintest_quasar : float
        Absolute AB magnitude at 1450 A of the faintest rows of quasars.
    """

    accretion: Accretion
    types: Types
    black_holes: BlackHoles
    quasar_black_holes: QuasarBlackHoles
    faintest_quasar: float


@dataclass(frozen=True, slots=True, eq=False)
class Nuclei:
    """Nuclei of n galaxies.

    Attributes
    ----------
    type : int array, shape (n,)
        NONE, TYPE_1 or TYPE_2.
    log_rate : float array, shape (n,)
        log10 of the specific accretion rate, without unit; meaningless without a nucleus.
    log_luminosity : float array, shape (n,)
        log10 of the bolometric luminosity, erg/s; meaningless without a nucleus.
    """

    type: Int
    log_rate: Float
    log_luminosity: Float


def laws() -> Laws:
    """Return the built-in parameters."""
    section = parameters.section
    return Laws(
        Accretion(**section(_FILE, "accretion")),
        Types(**section(_FILE, "types")),
        BlackHoles(**section(_FILE, "black_holes")),
        QuasarBlackHoles(**section(_FILE, "quasar_black_holes")),
        section(_FILE, "quasar_hosts")["faintest"],
    )


def draw(law: Laws, ids: Int, seed: int, z: Float, log_mass: Float) -> Nuclei:
    """Draw the nuclei of galaxies.

    Parameters
    ----------
    law : Laws
        Parameters.
    ids : int array, shape (n,)
        Identifiers of the galaxies.
    seed : int
        Seed of the request.
    z, log_mass : float array, shape (n,)
        True redshift, and log10 of the stellar mass in Msun. They are rounded to 32 bits as in table `galaxies`, so
        that the nuclei are the same when the columns are read from the table.

    Returns
    -------
    Nuclei
        The nuclei.
    """
    redshift, mass = (np.asarray(values, np.float32).astype(float) for values in (z, log_mass))
    rng = PerSourceGenerator(ids, seed, "active_nuclei")
    uniform = rng.random()
    log_rate = specific_rate(law.accretion, uniform, redshift)
    zero = np.log10(law.accretion.eddington * law.accretion.mass_ratio)
    log_luminosity = zero + mass + log_rate
    active = (log_rate >= law.accretion.log_rates[0]) & (uniform < law.accretion.largest_share)
    active &= mass >= law.accretion.least_log_mass
    nucleus_type = np.where(rng.random() < obscured_share(law.types, log_luminosity), TYPE_2, TYPE_1)
    is_quasar = (redshift >= _FIRST_QUASARS) & (
        nuclear_luminosity.ultraviolet_magnitude(log_luminosity) < law.faintest_quasar
    )
    active &= ~(is_quasar & (nucleus_type == TYPE_1))
    return Nuclei(np.where(active, nucleus_type, NONE), log_rate, log_luminosity)


def specific_rate(law: Accretion, uniform: Float, z: Float) -> Float:
    """Return log10 of the specific accretion rate above which a share `uniform` of galaxies is.

    Parameters
    ----------
    law : Accretion
        Parameters.
    uniform : float array, shape (n,)
        Numbers in (0, 1).
    z : float array, shape (n,)
        Redshift.

    Returns
    -------
    float array, shape (n,)
        log10 of the rate; below `law.log_rates[0]` for inactive galaxies.
    """
    growth = ((1.0 + np.minimum(z, law.z_last)) / (1.0 + law.z_pivot)) ** law.z_slope
    # The share above a rate x is amplitude (x^-slope - x_max^-slope).
    amplitude = 10.0**law.log_share * growth / (law.slope * np.log(10.0))
    x = uniform / amplitude + 10.0 ** (-law.slope * law.log_rates[1])
    return np.asarray(-np.log10(x) / law.slope)


def obscured_share(law: Types, log_luminosity: Float) -> Float:
    """Return the share of type 2 among nuclei, from log10 of the bolometric luminosity (erg/s)."""
    log_x_ray = log_luminosity - np.log10(law.x_ray)
    share = law.middle + np.arctan((law.log_x - log_x_ray) / law.width) / np.pi
    return np.asarray(np.clip(share, *law.limits))


def black_hole_mass(law: Laws, log_mass: Float, bulge_fraction: Float, log_luminosity: Float, normal: Float) -> Float:
    """Return the masses of black holes of active galaxies.

    Parameters
    ----------
    law : Laws
        Parameters.
    log_mass : float array, shape (n,)
        log10 of the stellar mass, Msun.
    bulge_fraction : float array, shape (n,)
        Share of the bulge in the galaxy.
    log_luminosity : float array, shape (n,)
        log10 of the bolometric luminosity, erg/s.
    normal : float array, shape (n,)
        Standard normal deviates, which give the scatter.

    Returns
    -------
    float array, shape (n,)
        log10 of the mass, Msun.
    """
    numbers = law.black_holes
    bulge = log_mass + np.log10(np.maximum(bulge_fraction, numbers.least_bulge))
    mass = numbers.zero + numbers.slope * (bulge - 11.0) + numbers.scatter * normal
    return np.asarray(np.maximum(mass, log_luminosity - np.log10(law.accretion.eddington)))


def quasar_black_hole_mass(law: Laws, m_1450: Float, normal: Float) -> Float:
    """Return the masses of quasars' black holes.

    Parameters
    ----------
    law : Laws
        Parameters.
    m_1450 : float array, shape (n,)
        Absolute AB magnitude at 1450 A.
    normal : float array, shape (n,)
        Standard normal deviates, which give the scatter.

    Returns
    -------
    float array, shape (n,)
        log10 of the mass, Msun.
    """
    numbers, m_i = law.quasar_black_holes, nuclear_luminosity.i_magnitude(m_1450)
    scatter = numbers.scatter + numbers.scatter_slope * m_i
    return np.asarray(numbers.zero + numbers.slope * m_i + np.maximum(scatter, 0.0) * normal)


def has_nucleus(nuclei: Nuclei) -> Bool:
    """Return True for galaxies with an active nucleus, shape (n,)."""
    return np.asarray(nuclei.type != NONE)
