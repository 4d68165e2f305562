"""Select the halos that lens: all halos above a fixed mass, independent of the limits of the galaxy catalogue.

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
from truesky.cosmology import HUBBLE_DISTANCE, Cosmology


@dataclass(frozen=True, slots=True)
class Settings:
    """Limits in mass, redshift and angle of the halos that lens; explained in lens_halos.toml.

    The masses `lowest` and `heavy` are log10 M_200m / (Msun/h), and `planes` are redshifts. The unit of `span` is
    comoving Mpc/h, and the unit of `radii` and `close_radii` is R_200m. Angles are in arcmin: `wide`, `reach`, `close`,
    `step` and `strip`.
    """

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

    def max_distance(self, cosmology: Cosmology) -> float:
        """Return the largest comoving distance of halos that lens, Mpc/h."""
        return float(cosmology.comoving_distance(self.z_max))

    @property
    def wide_distance(self) -> float:
        """Return the comoving distance (Mpc/h) beyond which no halo lenses at angles larger than `wide` (arcmin)."""
        return float(self.span / np.radians(self.wide / 60.0))


def settings() -> Settings:
    """Return the built-in limits in mass, redshift and angle of the halos that lens."""
    return Settings(**parameters.section("lens_halos.toml", "lenses"))


def draw(population: Population, min_log_mass: float, max_distance: float, order: int, cell: int) -> Halos:
    """Return all halos above a mass and nearer than a distance that are drawn in a HEALPix cell.

    They do not depend on the magnitude limit and the redshift range of the galaxy catalogue.

    Parameters
    ----------
    population : Population
        Model from which halos are drawn, or the user's halos.
    min_log_mass : float
        Lower limit of log10 M_200m / (Msun/h).
    max_distance : float
        Largest comoving distance, Mpc/h.
    order, cell : int
        Order (8, 5 or 2) and nested index of the cell. Halos with larger angular radii are drawn in larger cells.

    Returns
    -------
    Halos
        The halos, sorted by position.
    """
    model = population.halos
    if population.light_cone is None:
        limits = np.where(model.steps.edge[:-1] < max_distance, min_log_mass, np.inf)
        drawn = halos.draw(model, population.seed, order, cell, limits)
    else:
        # Replace the limits of the galaxy catalogue by the limits of lensing, because `halo_catalogue.draw` selects the
        # user's halos by the limits of its model.
        deep = replace(model, limit=np.full(model.limit.shape, min_log_mass), max_distance=max_distance)
        cone, seed = population.light_cone, population.seed
        drawn = halo_catalogue.draw(deep, population.masses, cone, seed, order, cell)
    return drawn.select((drawn.log_mass >= min_log_mass) & (drawn.chi < max_distance))


def sizes(masses: Masses, chosen: Settings, order: int, z: Float, chi: Float, log_mass: Float) -> Float:
    """Return the lensing strength, the angles and the concentration of halos.

    Parameters
    ----------
    masses : Masses
        Tables of radius and concentration of halos.
    chosen : Settings
        Angles to which halos lens.
    order : int
        HEALPix order (8, 5 or 2) of the cells in which the halos are drawn; it limits theta_c.
    z : float array, shape (n,)
        Redshift.
    chi : float array, shape (n,)
        Comoving distance, Mpc/h.
    log_mass : float array, shape (n,)
        log10 M_200m / (Msun/h).

    Returns
    -------
    float array, shape (5, n)
        Amplitude (rad^2), theta_200, theta_s and theta_c (rad), and concentration c_200m.

    Notes
    -----
    The convergence of a halo is the amplitude times 1 - chi / chi_source times a function of angle. The mean of this
    function inside a circle of radius theta that contains the whole mass is 1 / theta^2.

    theta_200 is the angle of R_200m. Halos are summed for each source within theta_s; the rest of their lensing is
    smooth. The mass of a halo is compensated by an equal negative mass within theta_c, so that the mean density does
    not change and there is no lensing beyond.
    """
    # c^2 / (4 pi G) in Msun / Mpc, from the critical density of `masses`.
    bending = masses.shape.critical_density * HUBBLE_DISTANCE**2 / 1.5
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
    """Return the largest angle (rad) at which the halos of a level (order 8, 5 or 2) may lens.

    For orders 5 and 2, the halos that lens a source are searched only in the cell of the source and the neighbouring
    cells. A larger angle would reach beyond these cells.
    """
    if order == GENERATION_ORDER:
        return float(np.radians(chosen.reach / 60.0))
    return float(halos.reach(order) - np.radians(chosen.strip / 60.0))
