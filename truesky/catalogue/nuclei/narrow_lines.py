"""Fluxes of the narrow emission lines of active nuclei.

[O III] follows from the bolometric luminosity, and the other lines follow from it by line ratios. Seyferts have larger
[O III] / H beta than LINERs, which have low accretion rates. The parameters are in active_nuclei.toml.

References
----------
Lamastra et al. 2009, A&A 504, 73; Kewley et al. 2006, MNRAS 372, 961
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lake_schema.arrays import Float
from truesky.catalogue import parameters
from truesky.catalogue.nuclei.accretion import Nuclei, has_nucleus
from truesky.cosmology import Cosmology
from truesky.randomness.per_source import AnyGenerator

_CM_PER_MPC = 3.0856775814913673e24


@dataclass(frozen=True, slots=True)
class NarrowLines:
    """Parameters of narrow lines; explained in active_nuclei.toml, [narrow_lines]."""

    log_oiii: tuple[float, ...]
    log_correction: tuple[float, ...]
    scatter: float
    log_rates: tuple[float, float]
    r3: tuple[float, float]
    r3_scatter: float
    n2: tuple[float, float]
    n2_scatter: float
    n2_mass: float
    mass: float
    s2: tuple[float, float]
    s2_scatter: float
    r2: tuple[float, float]
    r2_scatter: float
    halpha: float
    a_halpha: float
    siii: float
    siii_pair: float
    hei: float
    hei_5877: float


@dataclass(frozen=True, slots=True)
class LineTables:
    """Numbers of the lines of galaxies that narrow lines share.

    Attributes
    ----------
    hydrogen : mapping of str to float
        Ratio of each hydrogen line to H beta without dust, by name such as "halpha".
    dust : mapping of str to float
        Extinction coefficient at the wavelength of each line relative to H alpha, by column such as "flux_oiii".
    """

    hydrogen: Mapping[str, float]
    dust: Mapping[str, float]


def laws() -> NarrowLines:
    """Return the built-in parameters."""
    return NarrowLines(**parameters.section("active_nuclei.toml", "narrow_lines"))


def log_oiii(law: NarrowLines, log_luminosity: Float) -> Float:
    """Return log10 of the mean [O III] 5008 luminosity without dust, from log10 of the bolometric one (both erg/s)."""
    nodes, correction = np.array(law.log_oiii), np.array(law.log_correction)
    return np.asarray(log_luminosity - np.interp(log_luminosity, nodes + correction, correction))


def fluxes(
    law: NarrowLines,
    tables: LineTables,
    cosmology: Cosmology,
    nuclei: Nuclei,
    z: Float,
    log_mass: Float,
    rng: AnyGenerator,
) -> dict[str, Float]:
    """Return the fluxes that narrow lines add to the lines of galaxies.

    Parameters
    ----------
    law : NarrowLines
        Parameters.
    tables : LineTables
        Ratios of hydrogen lines and dust at the lines.
    cosmology : Cosmology
        Parameters of the universe, for the distances.
    nuclei : Nuclei
        Nuclei of n galaxies.
    z : float array, shape (n,)
        True redshift.
    log_mass : float array, shape (n,)
        log10 of the stellar mass, Msun.
    rng : AnyGenerator
        Random numbers of the scatter.

    Returns
    -------
    dict of str to float array, shape (n,)
        Flux by column of table `galaxies`, erg s-1 cm-2: one line per doublet, after the dust of the galaxy. It is 0
        without a nucleus.
    """
    normals = [rng.standard_normal(z.size) for _ in range(5)]
    seyfert = np.clip((nuclei.log_rate - law.log_rates[0]) / (law.log_rates[1] - law.log_rates[0]), 0.0, 1.0)

    def ratio(pair: tuple[float, float], scatter: float, normal: Float) -> Float:
        return pair[0] + (pair[1] - pair[0]) * seyfert + scatter * normal

    oiii = log_oiii(law, nuclei.log_luminosity) + law.scatter * normals[0]
    hbeta = oiii - ratio(law.r3, law.r3_scatter, normals[1])
    halpha = hbeta + np.log10(law.halpha)
    sii = halpha + ratio(law.s2, law.s2_scatter, normals[3])
    log_l = {
        **{f"flux_{line}": hbeta + np.log10(value) for line, value in tables.hydrogen.items()},
        "flux_halpha": halpha,
        "flux_hbeta": hbeta,
        "flux_oiii": oiii,
        "flux_nii": halpha + ratio(law.n2, law.n2_scatter, normals[2]) + law.n2_mass * (log_mass - law.mass),
        # The two lines of [S II] and of [O II] are equal in this model.
        "flux_sii": sii + np.log10(0.5),
        "flux_oii": hbeta + ratio(law.r2, law.r2_scatter, normals[4]) + np.log10(0.5),
        "flux_siii": sii + law.siii + np.log10(law.siii_pair / (1.0 + law.siii_pair)),
        "flux_hei": hbeta + np.log10(law.hei),
        "flux_hei_5877": hbeta + np.log10(law.hei_5877),
    }
    distance = cosmology.luminosity_distance(z) / cosmology.h * _CM_PER_MPC
    log_dilution = np.where(has_nucleus(nuclei), -np.log10(4.0 * np.pi) - 2.0 * np.log10(distance), -np.inf)
    return {name: 10.0 ** (log_l[name] - 0.4 * k * law.a_halpha + log_dilution) for name, k in tables.dust.items()}
