"""Halos that lens: all halos above a fixed mass, independent of the limit and the redshifts of a request.

Notes
-----
Halos are spherical and end at R_200m. Halos below the mass threshold or beyond a maximum redshift do not lens.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lake_schema.arrays import Float
from lake_schema.ids import GENERATION_ORDER
from truesky.catalogue import parameters
from truesky.catalogue.halos import halo_catalogue, halos
from truesky.catalogue.halos.halos import Halos
from truesky.catalogue.halos.matching import Masses
from truesky.catalogue.halos.population import Population
from truesky.fluxes import cosmology


@dataclass(frozen=True, slots=True)
class Settings:
    """Selection and ranges of the lensing halos (lens_halos.toml; angles in arcmin, planes are redshifts)."""

    lowest: float
    z_max: float
    heavy: float
    span: float
    radii: float
    wide: float
    reach: float
    close_radii: float
    close: float
    step: float
    planes: tuple[float, ...]
    strip: float
    repeat_threshold: float
    least_determinant: float

    @property
    def max_distance(self) -> float:
        """Return the largest distance of lensing halos, Mpc/h."""
        return float(cosmology.comoving_distance(self.z_max))

    @property
    def wide_distance(self) -> float:
        """Return the distance beyond which no theta_c is larger than `wide`, Mpc/h."""
        return float(self.span / np.radians(self.wide / 60.0))


def settings() -> Settings:
    """Return the settings of the embedded universe."""
    return Settings(**parameters.section("lens_halos.toml", "lenses"))


def draw(population: Population, min_log_mass: float, max_distance: float, order: int, cell: int) -> Halos:
    """Return the lensing halos of one level in a cell, which are a subset of the halos of a deep request.

    Parameters
    ----------
    population : Population
        Halos and their model.
    min_log_mass : float
        Lower limit of log10 M_200m / (Msun/h).
    max_distance : float
        Largest distance, Mpc/h.
    order, cell : int
        Order and nested index of the cell.

    Returns
    -------
    Halos
        The halos.
    """
    model = population.halos
    if population.light_cone is None:
        limits = np.where(model.steps.edge[:-1] < max_distance, min_log_mass, np.inf)
        drawn = halos.draw(model, population.seed, order, cell, limits)
    else:
        # Select by the limits of lensing instead of the limits of galaxies.
        deep = replace(model, limit=np.full(model.limit.shape, min_log_mass), max_distance=max_distance)
        cone, seed = population.light_cone, population.seed
        drawn = halo_catalogue.draw(deep, population.masses, cone, seed, order, cell)
    return drawn.select((drawn.log_mass >= min_log_mass) & (drawn.chi < max_distance))


def sizes(masses: Masses, chosen: Settings, order: int, z: Float, chi: Float, log_mass: Float) -> Float:
    """Return the lensing strength and the angles of halos.

    Parameters
    ----------
    masses : Masses
        Tables of halos by mass.
    chosen : Settings
        Ranges of the lensing.
    order : int
        Order of the level.
    z : float array, shape (n,)
        Redshift.
    chi : float array, shape (n,)
        Comoving distance, Mpc/h.
    log_mass : float array, shape (n,)
        log10 M_200m / (Msun/h).

    Returns
    -------
    float array, shape (5, n)
        Amplitude; theta_200, theta_s and theta_c in rad; concentration.

    Notes
    -----
    The convergence of a halo is the amplitude times 1 - chi / chi_source times a function of angle. The mean of this
    function inside theta is 1 / theta^2 if the circle contains the whole mass.

    theta_200 is the angle of R_200m. Halos are summed for each source within theta_s; the rest of their lensing is
    smooth. The mass of a halo is compensated by an equal negative mass within theta_c, so that the mean density does
    not change and there is no lensing beyond.
    """
    # c^2 / (4 pi G) in Msun / Mpc, from the critical density of `masses`.
    bending = masses.shape.critical_density * cosmology.HUBBLE_DISTANCE**2 / 1.5
    amplitude = 10.0**log_mass * (1.0 + z) / (np.pi * chi * bending)
    radius = masses.radius(log_mass) / chi
    wide, close = np.radians([chosen.wide / 60.0, chosen.close / 60.0])
    circle = np.where(
        log_mass >= chosen.heavy, np.maximum(chosen.span / chi, wide), np.minimum(chosen.radii * radius, wide)
    )
    circle = np.minimum(circle, max_circle(chosen, order))
    close_circle = np.minimum(np.maximum(chosen.close_radii * radius, close), circle)
    return np.stack(
        [amplitude, radius, close_circle, circle, masses.interpolate_pairs(masses.concentration, z, log_mass)]
    )


def max_circle(chosen: Settings, order: int) -> float:
    """Return the largest theta_c of a level (rad), limited by the neighbouring cells that are searched."""
    if order == GENERATION_ORDER:
        return float(np.radians(chosen.reach / 60.0))
    return float(halos.reach(order) - np.radians(chosen.strip / 60.0))
