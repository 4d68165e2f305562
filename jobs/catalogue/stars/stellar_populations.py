"""Which stars there are at the Sun: masses to luminosities, giants, white dwarfs, temperatures.

dwarf_sequence, giant_sequence, white_dwarf_sequence    temperature, gravity, mass against M_H
luminosity                                              stars pc^-3 per bin of M_H, by stage and component
mass_below, giants_below, white_dwarfs_below            the distributions it is made of

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
from jobs.fluxes.libraries import stellar
from lake_schema.arrays import Float, Int

_FILE = "milky_way.toml"
# Of the cooling sequence.
_STEPS = 500
# Nominal values of the Sun (IAU 2015).
_SUN_TEFF, _SUN_M_BOL = 5772.0, 4.74


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


@dataclass(frozen=True, slots=True)
class WhiteDwarfs:
    """Luminosity function of white dwarfs (milky_way.toml, [white_dwarfs])."""

    local: float
    slope: float
    brightest: float
    faintest: float
    radius: float
    log_g: float


@dataclass(frozen=True, slots=True, eq=False)
class Sequence:
    """Temperature (K), log gravity (cm s-2) and log mass (Msun; dwarfs alone, else 0) against M_H (ascending)."""

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


def white_dwarf_sequence() -> Sequence:
    """Cooling white dwarfs of one radius, bright to faint."""
    numbers = WhiteDwarfs(**parameters.section(_FILE, "white_dwarfs"))
    m_bol, m_h = _white_dwarf_magnitudes(numbers)
    return Sequence(m_h, _white_dwarf_teff(numbers, m_bol), np.full(m_h.size, numbers.log_g), np.zeros(m_h.size))


def _white_dwarf_magnitudes(numbers: WhiteDwarfs) -> tuple[Float, Float]:
    """M_bol and M_H, both ascending."""
    m_bol = np.linspace(numbers.brightest, numbers.faintest, _STEPS)
    types = stellar.types()
    correction = np.interp(-_white_dwarf_teff(numbers, m_bol), -types.teff, types.bolometric_h)
    m_h = m_bol - correction
    return m_bol, np.maximum.accumulate(m_h)


def _white_dwarf_teff(numbers: WhiteDwarfs, m_bol: Float) -> Float:
    """Stefan and Boltzmann's law, K."""
    return np.asarray(_SUN_TEFF * 10.0 ** (-0.1 * (m_bol - _SUN_M_BOL)) / np.sqrt(numbers.radius))


def luminosity(m_h: Float, dwarfs: Sequence, share: Float, component: Int) -> Float:
    """Stars pc^-3 at the Sun in each bin of M_H, [3 n, b]: dwarfs of n laws of density, their giants, white dwarfs.

    m_h       : [b + 1] edges
    share     : [n] of each law in the density at the Sun, summing to 1
    component : [n] thin disc, thick disc or halo, 0 .. 2
    """
    masses = MassFunction(**parameters.section(_FILE, "mass_function"))
    giants = Giants(**parameters.section(_FILE, "giants"))
    mass = 10.0 ** np.interp(m_h, dwarfs.m_h, dwarfs.log_mass)
    main = [-np.diff(mass_below(masses, np.minimum(mass, masses.heaviest[k]))) for k in component]
    branch = np.diff(giants_below(giants, m_h))
    evolved = [giants.relative[k] * branch for k in component]
    cooling = np.diff(white_dwarfs_below(WhiteDwarfs(**parameters.section(_FILE, "white_dwarfs")), m_h))
    return np.stack([*main, *evolved, *[cooling] * len(component)]) * np.tile(share, 3)[:, None]


def mass_below(masses: MassFunction, m: npt.ArrayLike) -> Float:
    """Systems pc^-3 at the Sun lighter than m, all components together.

    m : float[n] Msun
    Ref: Kroupa 2001
    """
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
    """Giants pc^-3 at the Sun brighter than M_H, thin disc.

    m_h : float[n] mag, Vega
    """
    clump = ndtr((m_h - giants.clump_m_h) / giants.clump_scatter)
    rise = giants.slope * np.log(10.0)
    inside = np.clip(m_h, giants.brightest, giants.faintest) - giants.brightest
    branch = np.expm1(rise * inside) / np.expm1(rise * (giants.faintest - giants.brightest))
    return np.asarray(giants.local * (giants.clump_fraction * clump + (1.0 - giants.clump_fraction) * branch))


def white_dwarfs_below(numbers: WhiteDwarfs, m_h: Float) -> Float:
    """White dwarfs pc^-3 at the Sun brighter than M_H.

    m_h : float[n] mag, Vega
    """
    m_bol, at = _white_dwarf_magnitudes(numbers)
    rise = numbers.slope * np.log(10.0)
    share = np.expm1(rise * (m_bol - m_bol[0])) / np.expm1(rise * (m_bol[-1] - m_bol[0]))
    return np.asarray(numbers.local * np.interp(m_h, at, share))
