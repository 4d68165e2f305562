"""L and T dwarfs: numbers along a line of sight and draws of them, by the templates of
truesky.fluxes.libraries.brown_dwarfs.

brown_dwarfs   densities and magnitudes of the templates
numbers        dwarfs of many cells
draw           Poisson sample

Ref: the numbers and their sources are in milky_way.toml.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lake_schema.arrays import Bool, Float, Int
from truesky.catalogue import parameters
from truesky.catalogue.stars import milky_way
from truesky.catalogue.stars.density_laws import Exponential, density
from truesky.catalogue.stars.milky_way import MilkyWay
from truesky.fluxes.libraries import brown_dwarfs as spectra
from truesky.fluxes.libraries import stellar
from truesky.numerics import matrices

_FILE = "milky_way.toml"


@dataclass(frozen=True, slots=True, eq=False)
class BrownDwarfs:
    """Everything that they are drawn from.

    law         : of density; log_g : of cm s-2; metallicity : mean and scatter of [M/H]
    boost       : how many times denser than in nature
    first       : index of the first template in the stellar library
    local       : [365] pc^-3 at the Sun, before the boost; teff : [365] K; m_h : [365] mag, Vega
    """

    law: Exponential
    log_g: float
    metallicity: tuple[float, float]
    boost: float
    first_template: int
    local_density: Float
    teff: Float
    m_h: Float


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """n dwarfs: template[n] among the 365, distance[n] pc."""

    template: Int
    distance: Float


def brown_dwarfs(boost: float) -> BrownDwarfs:
    """The L and T dwarfs of the embedded universe; each realisation of a subtype is as frequent as the others."""
    numbers = parameters.section(_FILE, "brown_dwarfs")
    templates = spectra.templates()
    share = 1.0 / np.bincount(templates.subtype)
    local_density = (np.array(numbers["local"]) * share)[templates.subtype]
    law = Exponential(np.inf, numbers["height"])
    first_template = len(stellar.types().names)
    return BrownDwarfs(
        law,
        numbers["log_g"],
        numbers["metallicity"],
        boost,
        first_template,
        local_density,
        templates.teff,
        templates.abs_mag_h,
    )


def expected_counts(
    dwarfs: BrownDwarfs, galaxy: MilkyWay, lon: Float, lat: Float, area: float, h_limit: Float
) -> Float:
    """Dwarfs[n] of cells before their dust; arguments as milky_way.numbers.

    lon, lat : float[n] deg, Galactic;  area : deg2;  h_limit : float[n] mag, Vega
    dwarfs, galaxy : densities and magnitudes by type, and the components of the Milky Way
    """
    total = np.zeros(lon.size)
    for limit in np.unique(h_limit):
        chosen = np.flatnonzero(h_limit == limit)
        per_shell = (_is_bright_enough(dwarfs, galaxy, float(limit)) * dwarfs.local_density[:, None]).sum(0)
        r, z, _ = milky_way.cylindrical(galaxy, lon[chosen, None], lat[chosen, None], milky_way.shell_distances(galaxy))
        total[chosen] = matrices.matmul(
            density(dwarfs.law, galaxy.sun, r, z), per_shell * milky_way.shell_volumes(galaxy, area)
        )
    return dwarfs.boost * total


def draw(
    dwarfs: BrownDwarfs, galaxy: MilkyWay, lon: float, lat: float, area: float, h_limit: float, rng: np.random.Generator
) -> Sample:
    """Poisson sample of the dwarfs of a cell that are brighter than the limit but for their dust.

    lon, lat : Galactic, of the cell's centre, deg; area : deg2
    dwarfs, galaxy : as of `numbers`;  h_limit : mag, Vega;  rng : random numbers
    """
    r, z, _ = milky_way.cylindrical(galaxy, lon, lat, milky_way.shell_distances(galaxy))
    per_shell = dwarfs.boost * density(dwarfs.law, galaxy.sun, r, z) * milky_way.shell_volumes(galaxy, area)
    mean = _is_bright_enough(dwarfs, galaxy, h_limit) * dwarfs.local_density[:, None] * per_shell
    template, distance = milky_way.draw_in_shells(galaxy, mean, rng)
    return Sample(template, distance)


def _is_bright_enough(dwarfs: BrownDwarfs, galaxy: MilkyWay, h_limit: float) -> Bool:
    """[365, s] whether a template is brighter than the limit at the near edge of a shell."""
    return np.asarray(dwarfs.m_h[:, None] + 5.0 * np.log10(galaxy.distance[:-1]) - 5.0 < h_limit)
