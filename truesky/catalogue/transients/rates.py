"""Rates of supernovae in galaxies, such that all galaxies together have the observed rates per volume.

A galaxy has a weight, which depends on its mass and star formation rate. The rate in a galaxy is its share of the
weights of all galaxies at its redshift, times the observed rate per volume. The mean weights per volume are from deep
simulated catalogues (supernova_hosts.csv, by scripts/supernova_hosts.py).
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from lake_schema.arrays import Float
from truesky.catalogue import parameters
from truesky.cosmology import FIDUCIAL

FILE = "transients.toml"
HOSTS = Path(__file__).with_name("supernova_hosts.csv")
# Hubble parameter h of the rates in transients.toml.
_HUBBLE = 0.7
# Coefficients of the star formation rate per volume: Madau & Dickinson 2014, eq. 15.
_EARLY, _PEAK, _LATE = 2.7, 2.9, 5.6


@dataclass(frozen=True, slots=True)
class Rates:
    """Parameters of the rates; explained in transients.toml, [rates]."""

    ia_rate: float
    ia_slope: float
    z_break: float
    ia_far_slope: float
    ia_by_mass: float
    ia_by_star_formation: float
    core_collapse_rate: float
    core_collapse_z: float


@lru_cache(maxsize=1)
def rates() -> Rates:
    """Return the built-in parameters of the rates."""
    return Rates(**parameters.section(FILE, "rates"))


def type_ia_per_volume(law: Rates, z: Float, hubble: float) -> Float:
    """Return the rate of type Ia supernovae per volume.

    Parameters
    ----------
    law : Rates
        Parameters of the rates.
    z : float array, shape (n,)
        Redshift.
    hubble : float
        Parameter h of the cosmology in which volumes are measured.

    Returns
    -------
    float array, shape (n,)
        Supernovae per comoving Mpc^3 and year of their rest frame.
    """
    nearby_growth = (1.0 + np.minimum(z, law.z_break)) ** law.ia_slope
    distant_growth = ((1.0 + np.maximum(z, law.z_break)) / (1.0 + law.z_break)) ** law.ia_far_slope
    return np.asarray(law.ia_rate * nearby_growth * distant_growth * (hubble / _HUBBLE) ** 3)


def core_collapse_per_volume(law: Rates, z: Float, hubble: float) -> Float:
    """Return the rate of core-collapse supernovae per volume.

    Parameters
    ----------
    law : Rates
        Parameters of the rates.
    z : float array, shape (n,)
        Redshift.
    hubble : float
        Parameter h of the cosmology in which volumes are measured.

    Returns
    -------
    float array, shape (n,)
        Supernovae per comoving Mpc^3 and year of their rest frame.
    """
    evolution = _star_formation(z) / _star_formation(np.array(law.core_collapse_z))
    return np.asarray(law.core_collapse_rate * evolution * (hubble / _HUBBLE) ** 3)


def _star_formation(z: Float) -> Float:
    """Return the star formation rate per volume on any scale."""
    return np.asarray((1.0 + z) ** _EARLY / (1.0 + ((1.0 + z) / _PEAK) ** _LATE))


def type_ia_weight(law: Rates, log_mass: Float, log_sfr: Float) -> Float:
    """Return the weights of galaxies as hosts of type Ia supernovae.

    Parameters
    ----------
    law : Rates
        Parameters of the rates.
    log_mass : float array, shape (n,)
        log10 of the mass of stars, Msun.
    log_sfr : float array, shape (n,)
        log10 of the star formation rate, Msun/yr.

    Returns
    -------
    float array, shape (n,)
        Weights, per year.
    """
    return np.asarray(law.ia_by_mass * 10.0**log_mass + law.ia_by_star_formation * 10.0**log_sfr)


def expected_rates(log_mass: Float, log_sfr: Float, z: Float) -> tuple[Float, Float]:
    """Return the rates of type Ia and of core-collapse supernovae in galaxies.

    Parameters
    ----------
    log_mass : float array, shape (n,)
        log10 of the mass of stars, Msun.
    log_sfr : float array, shape (n,)
        log10 of the star formation rate, Msun/yr.
    z : float array, shape (n,)
        Cosmological redshift.

    Returns
    -------
    (float array, float array), shape (n,)
        Rates per year of the rest frame.

    Notes
    -----
    The rate in a galaxy does not depend on the cosmology of the request. In the default cosmology, all galaxies
    together have the observed rates.
    """
    law, (nodes, ia_density, sfr_density) = rates(), _weights_per_volume()
    ia = type_ia_per_volume(law, nodes, FIDUCIAL.h) / ia_density
    core_collapse = core_collapse_per_volume(law, nodes, FIDUCIAL.h) / sfr_density
    ia_factor, sfr_factor = (np.exp(np.interp(z, nodes, np.log(factor))) for factor in (ia, core_collapse))
    return ia_factor * type_ia_weight(law, log_mass, log_sfr), sfr_factor * 10.0**log_sfr


@lru_cache(maxsize=1)
def _weights_per_volume() -> tuple[Float, Float, Float]:
    """Return redshifts, weights of hosts of type Ia supernovae per year and Mpc^3, and Msun/yr of stars per Mpc^3."""
    with HOSTS.open(newline="", encoding="utf-8") as file:
        rows = [[float(row[name]) for name in ("z", "type_ia", "star_formation")] for row in csv.DictReader(file)]
    z, type_ia, star_formation = np.array(rows).T
    return z, type_ia, star_formation
