"""Red galaxies by halo: centrals of groups, and satellites by their halo's mass and their distance from its centre.

model, shares      what halos quench, and what the average galaxy of a luminosity owes to its halo: a table
satellite_share    how many of the galaxies of a luminosity are satellites
odds               the probability of being red of galaxies in their halos

Halos change who is red, not how many: at every luminosity and redshift the mean is the share of the red sequence,
wherever halos alone do not quench more than that.
Ref: the numbers are in halos.toml, [quenching].
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

# Shares of satellites are written in log10 M - 13.
_PIVOT = 13.0
# Of the mean radius of satellites, in concentration and enclosed mass.
_CONCENTRATIONS, _ENCLOSED = np.geomspace(1.0, 60.0, 40), np.asarray((np.arange(500) + 0.5) / 500.0, np.float64)


@dataclass(frozen=True, slots=True)
class Quenching:
    """What halos make red (halos.toml, [quenching])."""

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
    """Of galaxies by redshift and proxy mass (the nodes of `Masses`), [z, m].

    law : what halos quench
    satellites : how many are satellites;  quenched : mean of what halos make red of what is not red anyway
    """

    law: Quenching
    masses: Masses
    satellites: Float
    quenched: Float


def model() -> Quenching:
    """What the halos of the embedded universe quench."""
    return Quenching(**parameters.section("halos.toml", "quenching"))


def shares(law: Quenching, masses: Masses, occupation: Occupation) -> Shares:
    """The averages over halos and their satellites, scattered as the proxy masses are.

    law : what halos quench;  masses, occupation : tables of halos and their satellites
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
    # Beyond the mass function's end there is nothing to average.
    total = np.maximum(central + satellite, 1e-30)
    return Shares(law, masses, satellite / total, (red_central + red_satellite) / total)


def satellite_share(average: Shares, members: Members) -> Float:
    """Of all galaxies of each galaxy's luminosity, [n]: how many are satellites.

    average : of `shares`;  members : n galaxies
    """
    return average.masses.interpolate_pairs(average.satellites, members.z, members.proxy)


def odds(average: Shares, members: Members, share: Float) -> Float:
    """Probability[n] of being red.

    average : of `shares`;  members : n galaxies in their halos;  share : float[n] of their luminosity that are red
    """
    z, halo = members.z, members.host_mass
    mean = average.masses.interpolate_pairs(average.quenched, z, members.proxy)
    central = quenched_central(average.law, z, halo)
    satellite = quenched_satellite(average.law, z, halo, members.radius)
    return red_odds(share, np.where(members.kind == SATELLITE, satellite, central), mean)


def quenched_central(law: Quenching, z: Float, log_mass: Float) -> Float:
    """Share[...] of the centrals of halos that the halo makes red, of those that are not red anyway.

    z, log_mass : float[...] redshift, log10 M_200m / (Msun/h);  law : constants
    """
    x = (log_mass - (law.central_mass + law.central_z * z)) / law.central_width
    return np.asarray(np.minimum(law.central / (1.0 + np.exp(-np.clip(x, -100.0, 100.0))), law.highest))


def quenched_satellite(law: Quenching, z: Float, log_mass: Float, radius: Float) -> Float:
    """The same of satellites.

    radius : float[...] distance from the halo's centre / R_200m;  law, z, log_mass : as of `quenched_central`
    """
    max_share = np.clip(law.satellite + law.satellite_rate * (log_mass - _PIVOT), *law.satellite_limits)
    inside = law.inner - law.outer * np.minimum(law.projection * radius, 1.0)
    return np.asarray(np.minimum(max_share * (1.0 + z) ** law.satellite_z * inside, law.highest))


def red_odds(share: Float, quenched: Float | float = 0.0, mean: Float | float = 0.0) -> Float:
    """Probability[n] of being red in a halo; its mean over a luminosity's galaxies is `share`, unless `mean` is more.

    share    : float[n] of all galaxies of the luminosity that are red
    quenched : float[n] what the galaxy's halo quenches of what is not yet red;  mean : float[n] over all such galaxies
    """
    red_before = np.clip((share - mean) / (1.0 - np.asarray(mean)), 0.0, 1.0)
    return np.asarray(red_before + quenched * (1.0 - red_before))


def _mean_radius(concentration: Float) -> Float:
    """Of satellites of halos of a concentration, [n] / R_200m."""
    grid = [satellites.nfw_radius(np.full(_ENCLOSED.size, float(c)), _ENCLOSED).mean() for c in _CONCENTRATIONS]
    return np.asarray(np.interp(np.log(np.clip(concentration, 1.0, 60.0)), np.log(_CONCENTRATIONS), grid))
