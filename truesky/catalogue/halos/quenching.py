"""Quenching by halos: decide which galaxies are red, by the mass of their halo and their distance from its centre.

A fraction of the central galaxies of massive halos and of the satellites is quenched, that is red because of the halo.
Halos change which galaxies are red, but not how many: at every luminosity and redshift, the mean probability to be red
equals the given fraction of red galaxies, unless halos alone quench more. The parameters are in halos.toml,
[quenching].
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lake_schema.arrays import Float
from truesky.catalogue import parameters
from truesky.catalogue.halos import matching, satellites
from truesky.catalogue.halos.matching import Masses, Occupation
from truesky.catalogue.halos.population import SATELLITE, Members
from truesky.numerics import matrices

# Zero point of the quenched fraction of satellites, which is linear in log10 M - _PIVOT within limits. M is the mass of
# the halo in Msun/h.
_PIVOT = 13.0
# Concentrations at which the mean distance of satellites from the centre of their halo is computed.
_CONCENTRATIONS = np.geomspace(1.0, 60.0, 40)
# Fractions of the halo mass. The radii that enclose them are averaged to get the mean distance of satellites.
_ENCLOSED = np.asarray((np.arange(500) + 0.5) / 500.0, np.float64)


@dataclass(frozen=True, slots=True)
class Quenching:
    """Parameters of the fraction of galaxies that halos quench; explained in halos.toml, [quenching]."""

    central: float
    central_mass: float
    central_z: float
    central_width: float
    satellite: float
    satellite_rate: float
    satellite_limits: tuple[float, float]
    satellite_z: float
    inner: float
    outer: float
    projection: float
    highest: float


@dataclass(frozen=True, slots=True, eq=False)
class Shares:
    """Averages over all galaxies of the same redshift and proxy mass, that is of the same luminosity.

    The proxy mass is the mass of the halo or sub-halo with a scatter.

    Attributes
    ----------
    law : Quenching
        Parameters of the quenched fractions.
    masses : Masses
        Tables of halos, with the redshifts (z) and masses (m) of the arrays below.
    satellites : float array, shape (z, m)
        Fraction of galaxies that are satellites.
    quenched : float array, shape (z, m)
        Mean fraction of galaxies that their halos quench, among galaxies that are not red for other reasons.
    """

    law: Quenching
    masses: Masses
    satellites: Float
    quenched: Float


def model() -> Quenching:
    """Return the built-in parameters of the fraction of galaxies that halos quench."""
    return Quenching(**parameters.section("halos.toml", "quenching"))


def shares(law: Quenching, masses: Masses, occupation: Occupation) -> Shares:
    """Compute the mean fractions of satellites and of quenched galaxies, by redshift and luminosity.

    Parameters
    ----------
    law : Quenching
        Parameters of the quenched fractions.
    masses : Masses
        Tables of halo abundance and concentration.
    occupation : Occupation
        Number of satellites by halo mass, and scatter of the proxy masses (which determine luminosities).

    Returns
    -------
    Shares
        The averages.
    """
    step = float(masses.log_mass[1] - masses.log_mass[0])
    centrals = np.exp(masses.ln_density) * step
    above = matching.satellites_above(masses.log_mass, occupation)
    inside = np.concatenate([above[:-1] - above[1:], above[-1:]])
    z = np.repeat(masses.z, masses.log_mass.size)
    mass = np.tile(masses.log_mass, masses.z.size)
    radius = _mean_radius(occupation.concentration * masses.interpolate_pairs(masses.concentration, z, mass))
    red = quenched_central(law, z, mass), quenched_satellite(law, z, mass, radius)
    of_central, of_satellite = (share.reshape(centrals.shape) for share in red)
    evolution = matching.satellite_evolution(masses.z, occupation)[:, None]
    numbers = (
        centrals,
        evolution * matrices.matmul(centrals, inside.T),
        centrals * of_central,
        evolution * matrices.matmul(centrals * of_satellite, inside.T),
    )
    central, satellite, red_central, red_satellite = (matching.scatter_masses(n, step, occupation) for n in numbers)
    # Avoid a division by zero at the highest masses, at which there are no halos.
    total = np.maximum(central + satellite, 1e-30)
    return Shares(law, masses, satellite / total, (red_central + red_satellite) / total)


def satellite_share(average: Shares, members: Members) -> Float:
    """Return the fraction of satellites among all galaxies with the luminosity and redshift of each of `members`."""
    return average.masses.interpolate_pairs(average.satellites, members.z, members.proxy)


def odds(average: Shares, members: Members, share: Float) -> Float:
    """Return the probability of each galaxy to be red, given its halo.

    Parameters
    ----------
    average : Shares
        Mean quenched fractions from `shares`.
    members : Members
        Galaxies with their halos.
    share : float array, shape (n,)
        Fraction of red galaxies among all galaxies of the same luminosity and redshift.

    Returns
    -------
    float array, shape (n,)
        Probability, 0 to 1.
    """
    z, halo = members.z, members.host_mass
    mean = average.masses.interpolate_pairs(average.quenched, z, members.proxy)
    central = quenched_central(average.law, z, halo)
    satellite = quenched_satellite(average.law, z, halo, members.radius)
    return red_odds(share, np.where(members.kind == SATELLITE, satellite, central), mean)


def quenched_central(law: Quenching, z: Float, log_mass: Float) -> Float:
    """Return the fraction of otherwise blue central galaxies that their halo quenches.

    Parameters
    ----------
    law : Quenching
        Parameters of the quenched fractions.
    z : float array, any shape
        Redshift.
    log_mass : float array, any shape
        log10 M_200m / (Msun/h) of the halo.

    Returns
    -------
    float array, broadcast shape of the arguments
        Fraction, 0 to 1.
    """
    x = (log_mass - (law.central_mass + law.central_z * z)) / law.central_width
    return np.asarray(np.minimum(law.central / (1.0 + np.exp(-np.clip(x, -100.0, 100.0))), law.highest))


def quenched_satellite(law: Quenching, z: Float, log_mass: Float, radius: Float) -> Float:
    """Return the fraction of otherwise blue satellites that their halo quenches.

    Parameters
    ----------
    law : Quenching
        Parameters of the quenched fractions.
    z : float array, any shape
        Redshift.
    log_mass : float array, any shape
        log10 M_200m / (Msun/h) of the halo.
    radius : float array, any shape
        Distance from the centre of the halo in units of R_200m.

    Returns
    -------
    float array, broadcast shape of the arguments
        Fraction, 0 to 1.
    """
    max_share = np.clip(law.satellite + law.satellite_rate * (log_mass - _PIVOT), *law.satellite_limits)
    inside = law.inner - law.outer * np.minimum(law.projection * radius, 1.0)
    return np.asarray(np.minimum(max_share * (1.0 + z) ** law.satellite_z * inside, law.highest))


def red_odds(share: Float, quenched: Float | float = 0.0, mean: Float | float = 0.0) -> Float:
    """Return the probability of galaxies to be red, from the red fraction and the quenching by their halos.

    Parameters
    ----------
    share : float array, shape (n,)
        Fraction of red galaxies among all galaxies of the same luminosity and redshift.
    quenched : float or float array, shape (n,)
        Probability that the galaxy's halo quenches it, if it is not red for other reasons.
    mean : float or float array, shape (n,)
        Mean of `quenched` over all galaxies of the same luminosity and redshift, below 1.

    Returns
    -------
    float array, shape (n,)
        Probability. Its mean over all galaxies of the same luminosity is `share`, or `mean` if this is larger.
    """
    red_before = np.clip((share - mean) / (1.0 - np.asarray(mean)), 0.0, 1.0)
    return np.asarray(red_before + quenched * (1.0 - red_before))


def _mean_radius(concentration: Float) -> Float:
    """Return the mean distance of satellites from the centre of their halo (R_200m), for each concentration.

    Concentrations are limited to 1 to 60.
    """
    grid = [satellites.nfw_radius(np.full(_ENCLOSED.size, float(c)), _ENCLOSED).mean() for c in _CONCENTRATIONS]
    return np.asarray(np.interp(np.log(np.clip(concentration, 1.0, 60.0)), np.log(_CONCENTRATIONS), grid))
