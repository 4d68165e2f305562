"""Halos that lens: all above one mass, whatever the limit of a request and its redshifts.

draw      those of one cell of one level
sizes     what they do to light: amplitude, radius, and the circles within which their mass is taken away again
farthest  how far they reach

Error: spherical, cut at R_200m; halos below the threshold do not lens, and none does beyond its redshift
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
    """Which halos lens, and how far (lens_halos.toml; angles arcmin, planes redshifts)."""

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
        """Mpc/h, to which halos lens."""
        return float(cosmology.comoving_distance(self.z_max))

    @property
    def wide_distance(self) -> float:
        """Mpc/h, beyond which no halo's theta_c is larger than `wide`."""
        return float(self.span / np.radians(self.wide / 60.0))


def settings() -> Settings:
    """The halos that lens in the embedded universe."""
    return Settings(**parameters.section("lens_halos.toml", "lenses"))


def draw(population: Population, min_log_mass: float, max_distance: float, order: int, cell: int) -> Halos:
    """Halos of one level in a nested cell of its order, down to a mass; they are among those of a deep request.

    population  : whose halos they are;  least : log10 M_200m / (Msun/h);  far : Mpc/h
    order, cell : of the nested cell
    """
    model = population.halos
    if population.light_cone is None:
        limits = np.where(model.steps.edge[:-1] < max_distance, min_log_mass, np.inf)
        drawn = halos.draw(model, population.seed, order, cell, limits)
    else:
        # Of halos whose central would be seen.
        deep = replace(model, limit=np.full(model.limit.shape, min_log_mass), max_distance=max_distance)
        cone, seed = population.light_cone, population.seed
        drawn = halo_catalogue.draw(deep, population.masses, cone, seed, order, cell)
    return drawn.select((drawn.log_mass >= min_log_mass) & (drawn.chi < max_distance))


def sizes(masses: Masses, chosen: Settings, order: int, z: Float, chi: Float, log_mass: Float) -> Float:
    """[5, n] amplitude, theta_200, theta_s, theta_c and concentration of halos; angles in rad.

    kappa of a halo is the amplitude times 1 - chi / chi_source times a function of angles, which has the mean
    1 / theta^2 inside theta where all of the mass is.
    masses : of halos by mass;  chosen : how far they lens;  order : of their level
    z, chi, log_mass : [n] redshift, distance in Mpc/h, log10 M_200m / (Msun/h)
    """
    # c^2 / (4 pi G), Msun / Mpc, of the matter that the box has.
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
    """Largest theta_c, rad, of a level: what the cells about one hold."""
    if order == GENERATION_ORDER:
        return float(np.radians(chosen.reach / 60.0))
    return float(halos.reach(order) - np.radians(chosen.strip / 60.0))
