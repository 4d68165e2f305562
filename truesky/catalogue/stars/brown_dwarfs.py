"""Draw L and T dwarfs, and compute their expected numbers along lines of sight.

The templates are from truesky.fluxes.libraries.brown_dwarfs. The parameters and their sources are in milky_way.toml.
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
    """Model from which L and T dwarfs are drawn.

    Attributes
    ----------
    law : Exponential
        Density law in the Milky Way.
    log_g : float
        log10 of the surface gravity, cm s-2.
    metallicity : tuple of float
        Mean and scatter of [M/H].
    boost : float
        Ratio of the drawn to the natural number density.
    first_template : int
        Index of the first template spectrum of a dwarf in the stellar library.
    local_density : float array, shape (365,)
        Natural number density near the Sun of the dwarfs with each template, pc^-3.
    teff : float array, shape (365,)
        Temperature of each template, K.
    m_h : float array, shape (365,)
        Absolute H magnitude (Vega) of each template.
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
    """Random sample of n dwarfs: index of the template spectrum (0 to 364) and distance (pc) of each dwarf."""

    template: Int
    distance: Float


def brown_dwarfs(boost: float) -> BrownDwarfs:
    """Return the model of L and T dwarfs with the built-in parameters and a boost of the number density.

    All templates of a spectral subtype have the same number density.
    """
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
    """Return the expected number of dwarfs in sky cells, without extinction and with the boost.

    Parameters
    ----------
    dwarfs : BrownDwarfs
        Model of the dwarfs.
    galaxy : MilkyWay
        Model of the Milky Way, of which the Sun's position and the shells of distance are used.
    lon, lat : float array, shape (n,)
        Galactic coordinates of the cells' centres, deg.
    area : float
        Area of a cell, deg2.
    h_limit : float array, shape (n,)
        Faintest H magnitude (Vega).

    Returns
    -------
    float array, shape (n,)
        Expected number.
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
    """Draw a Poisson sample of the dwarfs in a sky cell that may be brighter than a limit without extinction.

    Parameters
    ----------
    dwarfs : BrownDwarfs
        Model of the dwarfs.
    galaxy : MilkyWay
        Model of the Milky Way, of which the Sun's position and the shells of distance are used.
    lon, lat : float
        Galactic coordinates of the cell's centre, deg.
    area : float
        Area of the cell, deg2.
    h_limit : float
        Faintest H magnitude (Vega).
    rng : Generator
        Random numbers.

    Returns
    -------
    Sample
        The dwarfs. A few are fainter than the limit, because shells of distance are selected as a whole.
    """
    r, z, _ = milky_way.cylindrical(galaxy, lon, lat, milky_way.shell_distances(galaxy))
    per_shell = dwarfs.boost * density(dwarfs.law, galaxy.sun, r, z) * milky_way.shell_volumes(galaxy, area)
    mean = _is_bright_enough(dwarfs, galaxy, h_limit) * dwarfs.local_density[:, None] * per_shell
    template, distance = milky_way.draw_in_shells(galaxy, mean, rng)
    return Sample(template, distance)


def _is_bright_enough(dwarfs: BrownDwarfs, galaxy: MilkyWay, h_limit: float) -> Bool:
    """Return True for templates that are brighter than H = h_limit at the near edge of a shell, shape (365, s)."""
    return np.asarray(dwarfs.m_h[:, None] + 5.0 * np.log10(galaxy.distance[:-1]) - 5.0 < h_limit)
