"""Which stars there are at the Sun: masses to luminosities, giants, temperatures.

dwarf_sequence, giant_sequence   temperature, gravity, mass against M_H
luminosity                       stars pc^-3 per bin of M_H: dwarfs and giants of thin disc, thick disc, halo
mass_below, giants_below         the distributions it is made of

Types later than M9 are brown dwarfs, a population of their own. Magnitudes are 2MASS H, Vega.
Ref: Kroupa 2001 (masses), Pecaut & Mamajek 2013 (mass to luminosity); numbers and their sources are in
milky_way.toml.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from jobs.catalogue import parameters
from jobs.fluxes import stellar

Float = npt.NDArray[np.float64]

_FILE = "milky_way.toml"


@dataclass(frozen=True, slots=True)
class MassFunction:
    """Broken power law of stellar systems (milky_way.toml, [mass_function])."""

    lightest: float
    reference: float
    breaks: tuple[float, ...]
    slopes: tuple[float, ...]
    local: float
    heaviest: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Giants:
    """Luminosity function of giants (milky_way.toml, [giants])."""

    local: float
    relative: tuple[float, ...]
    clump_fraction: float
    clump_m_h: float
    clump_scatter: float
    slope: float
    brightest: float
    faintest: float


@dataclass(frozen=True, slots=True, eq=False)
class Sequence:
    """Temperature (K), log gravity (cm s-2) and log mass (Msun; giants: 0) against M_H (ascending)."""

    m_h: Float
    teff: Float
    log_g: Float
    log_mass: Float


def dwarf_sequence() -> Sequence:
    """The main sequence, bright to faint.  Ref: Pecaut & Mamajek 2013, Table 5 and its updates."""
    types = stellar.types()
    order = np.argsort(types.abs_mag_h)
    log_mass = np.log10(types.mass[order])
    # Types of nearly equal mass are not in order: half-way between the two monotone envelopes.
    down = np.minimum.accumulate(log_mass)
    up = np.maximum.accumulate(log_mass[::-1])[::-1]
    return Sequence(types.abs_mag_h[order], types.teff[order], types.log_g[order], 0.5 * (down + up))


def giant_sequence() -> Sequence:
    """The giant branch and the red clump, bright to faint."""
    numbers = parameters.section(_FILE, "giant_sequence")
    m_h, teff, log_g = (np.array(numbers[name]) for name in ("m_h", "teff", "log_g"))
    return Sequence(m_h, teff, log_g, np.zeros(m_h.size))


def luminosity(m_h: Float, dwarfs: Sequence, share: Float) -> Float:
    """Stars pc^-3 at the Sun in each bin of M_H, [6, b]: dwarfs of the three components, then their giants.

    m_h : [b + 1] edges; share : [3] of each component in the density at the Sun, summing to 1
    """
    masses = MassFunction(**parameters.section(_FILE, "mass_function"))
    giants = Giants(**parameters.section(_FILE, "giants"))
    mass = 10.0 ** np.interp(m_h, dwarfs.m_h, dwarfs.log_mass)
    main = [-np.diff(mass_below(masses, np.minimum(mass, heaviest))) for heaviest in masses.heaviest]
    branch = np.diff(giants_below(giants, m_h))
    evolved = [times * branch for times in giants.relative]
    return np.stack([*main, *evolved]) * np.tile(share, 2)[:, None]


def mass_below(masses: MassFunction, m: npt.ArrayLike) -> Float:
    """Systems pc^-3 at the Sun lighter than m, all components together.  Ref: Kroupa 2001"""
    return masses.local * _power_law(masses, np.asarray(m, float)) / _power_law(masses, np.asarray(masses.reference))


def _power_law(masses: MassFunction, m: Float) -> Float:
    edges = (masses.lightest, *masses.breaks, np.inf)
    total, height = np.zeros(m.shape), 1.0
    for i, slope in enumerate(masses.slopes):
        low, rise = edges[i], slope + 1.0
        top = np.clip(m, low, edges[i + 1])
        total = total + height * low * np.expm1(rise * np.log(top / low)) / rise
        height *= (edges[i + 1] / low) ** slope if np.isfinite(edges[i + 1]) else 1.0
    return np.asarray(total)


def giants_below(giants: Giants, m_h: Float) -> Float:
    """Giants pc^-3 at the Sun brighter than M_H, thin disc."""
    clump = ndtr((m_h - giants.clump_m_h) / giants.clump_scatter)
    rise = giants.slope * np.log(10.0)
    inside = np.clip(m_h, giants.brightest, giants.faintest) - giants.brightest
    branch = np.expm1(rise * inside) / np.expm1(rise * (giants.faintest - giants.brightest))
    return np.asarray(giants.local * (giants.clump_fraction * clump + (1.0 - giants.clump_fraction) * branch))
