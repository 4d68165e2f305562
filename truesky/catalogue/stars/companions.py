"""Draw the companions of stars in binaries: which stars have one, and the masses and separations of companions.

A companion has the age and the metallicity of its primary. The parameters and their sources are in milky_way.toml.

References
----------
Duchene & Kraus 2013
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from lake_schema.arrays import Float, Int
from truesky.catalogue import parameters
from truesky.catalogue.stars.stellar_populations import Pieces, Tracks

_FILE = "milky_way.toml"
# Quantiles of the distribution of mass ratios over which `expected_density` averages.
_RATIOS = (np.arange(16) + 0.5) / 16
_DAY_PER_YEAR = 365.25
# Number that is added to log10 mass per isochrone, so that one sorted array contains the masses of all isochrones.
_TRACK_SPACING = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class Companions:
    """Companions of stars in binaries.

    Attributes
    ----------
    primary : int array, shape (n,)
        Index of the primary star in the arrays of stars from which the companions are drawn.
    mass : float array, shape (n,)
        Mass at birth, Msun.
    m_h : float array, shape (n,)
        Absolute H magnitude (Vega).
    teff : float array, shape (n,)
        Temperature, K.
    log_g : float array, shape (n,)
        log10 of the surface gravity, cm s-2.
    """

    primary: Int
    mass: Float
    m_h: Float
    teff: Float
    log_g: Float


def expected_density(tracks: Tracks, pieces: Pieces, m_h: Float) -> Float:
    """Return the expected number density of companions by absolute H magnitude.

    Parameters
    ----------
    tracks : Tracks
        Isochrones.
    pieces : Pieces
        Stretches of the isochrones with the number density of primary stars; no white dwarfs.
    m_h : float array, shape (b + 1,)
        Edges of the bins of the companions' absolute H magnitude (Vega).

    Returns
    -------
    float array, shape (b,)
        Companions per bin, pc^-3.
    """
    law = _law()
    log_mass = pieces.log_mass.mean(0)
    number = pieces.number * _binary_fraction(law, log_mass) / _RATIOS.size
    total = np.zeros(m_h.size - 1)
    for chance in _RATIOS:
        second = log_mass + np.log10(_mass_ratio(law, log_mass, np.full(log_mass.size, chance)))
        living = second >= tracks.log_mass[0, 0]
        magnitudes = _main_sequence_values(tracks, pieces.track[living], second[living])[0]
        total += np.histogram(magnitudes, m_h, weights=number[living])[0]
    return total


def draw(tracks: Tracks, track: Int, mass: Float, rng: np.random.Generator) -> Companions:
    """Draw the companions of stars; companions below the lowest mass of the isochrones are left out.

    Parameters
    ----------
    tracks : Tracks
        Isochrones.
    track : int array, shape (n,)
        Index of each star's isochrone, -1 for stars that get no companion (white dwarfs).
    mass : float array, shape (n,)
        Mass of the star at birth, Msun; not used if `track` is -1.
    rng : Generator
        Random numbers.

    Returns
    -------
    Companions
        The companions.
    """
    law = _law()
    chance, ratio = rng.random((2, track.size))
    with np.errstate(invalid="ignore"):
        log_mass = np.log10(np.where(track < 0, 1.0, mass))
    has_companion = np.flatnonzero((track >= 0) & (chance < _binary_fraction(law, log_mass)))
    second = log_mass[has_companion] + np.log10(_mass_ratio(law, log_mass[has_companion], ratio[has_companion]))
    living = second >= tracks.log_mass[0, 0]
    has_companion, second = has_companion[living], second[living]
    m_h, log_teff, log_g = _main_sequence_values(tracks, track[has_companion], second)
    return Companions(has_companion, 10.0**second, m_h, 10.0**log_teff, log_g)


def draw_orbits(primary: Float, companion: Float, rng: np.random.Generator) -> tuple[Float, Float, Float]:
    """Draw the orbits of companions, and their projected offsets from their primaries.

    The separation is the drawn semi-major axis in a random direction in space; orbital phases are not drawn.

    Parameters
    ----------
    primary, companion : float array, shape (n,)
        Masses of the two stars, Msun.
    rng : Generator
        Random numbers.

    Returns
    -------
    axis : float array, shape (n,)
        Semi-major axes, AU.
    east, north : float array, shape (n,)
        Offsets of the companions on the sky, AU.
    """
    law = _law()
    n = primary.size
    deviate, cosine, angle = rng.standard_normal(n), rng.uniform(-1.0, 1.0, n), rng.uniform(0.0, 2.0 * np.pi, n)
    years = 10.0 ** (law["log_period"] + law["log_period_scatter"] * deviate) / _DAY_PER_YEAR
    # Kepler's third law in units of AU, years and solar masses.
    of_sun = np.cbrt((primary + companion) * years**2)
    of_dwarf = 10.0 ** (law["log_axis_dwarf"] + law["log_axis_dwarf_scatter"] * deviate)
    axis = np.minimum(np.where(primary < law["dwarf_below"], of_dwarf, of_sun), law["widest"])
    projected = axis * np.sqrt(1.0 - cosine**2)
    return axis, projected * np.sin(angle), projected * np.cos(angle)


@lru_cache(maxsize=1)
def _law() -> dict[str, Any]:
    return parameters.section(_FILE, "binaries")


def _binary_fraction(law: dict[str, Any], log_mass: Float) -> Float:
    return np.asarray(np.interp(log_mass, np.log10(law["mass"]), law["fraction"]))


def _mass_ratio(law: dict[str, Any], log_mass: Float, chance: Float) -> Float:
    """Return the mass ratio (companion / primary, in (0, 1]) at the quantile `chance` of a power-law distribution."""
    slope = np.interp(log_mass, np.log10(law["mass"]), law["ratio_slope"])
    return np.asarray(np.maximum(chance, 1e-12) ** (1.0 / (1.0 + slope)))


def _main_sequence_values(tracks: Tracks, track: Int, log_mass: Float) -> tuple[Float, Float, Float]:
    """Return M_H, log10 Teff and log10 g of stars with masses on the main sequences of isochrones.

    Heavier (lighter) stars get the values at the last (first) point of the main sequence.
    """
    last = tracks.evolved
    track_offset = _TRACK_SPACING * np.arange(tracks.age.size)[:, None]
    line = (tracks.log_mass[:, :last] + track_offset).ravel()
    at = np.clip(log_mass, tracks.log_mass[track, 0], tracks.log_mass[track, last - 1]) + _TRACK_SPACING * track
    low = np.clip(np.searchsorted(line, at, side="right") - 1, track * last, track * last + last - 2)
    part = (at - line[low]) / (line[low + 1] - line[low])
    values = (each[:, :last].ravel() for each in (tracks.m_h, tracks.log_teff, tracks.log_g))
    m_h, log_teff, log_g = (v[low] + (v[low + 1] - v[low]) * part for v in values)
    return m_h, log_teff, log_g
