"""Which stars there are: masses and ages to luminosities, temperatures, gravities, and their numbers.

Population     ages and metallicities of a component
Pieces         short stretches of isochrones and of the cooling sequence of white dwarfs, each inside a bin of M_H
Tracks         the isochrones' main sequences, for companions
tracks, pieces_of, white_dwarfs   made of populations
white_dwarfs_below                cumulative luminosity function of white dwarfs

Above 0.7 Msun stars lie on isochrones, below 0.5 Msun on the mean sequence of nearby dwarfs, where metal-poor ones are
hotter by as much as isochrones have them at 0.5 Msun; in between the two go over into one another. Types later than M9
are brown dwarfs, a population of their own. Magnitudes are 2MASS H, Vega.
Ref: Kroupa 2001 (masses), Pecaut & Mamajek 2013 (nearby dwarfs); numbers and their sources are in milky_way.toml.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from lake_schema.arrays import Bool, Float, Int
from truesky.catalogue import parameters
from truesky.catalogue.stars import isochrones
from truesky.fluxes import passbands
from truesky.fluxes.calibration import STAR_BAND
from truesky.fluxes.libraries import model_stars, stellar
from truesky.fluxes.libraries.vega import vega_magnitude

DWARF, GIANT, WHITE_DWARF, BROWN_DWARF, SUBGIANT = range(5)
_FILE = "milky_way.toml"
# Of the cooling sequence.
_STEPS = 500
# Nominal values of the Sun (IAU 2015).
_SUN_TEFF, _SUN_M_BOL = 5772.0, 4.74
# Masses, Msun, between which nearby dwarfs go over into isochrones.
_NEARBY_MASS, _MODEL_MASS = 0.5, 0.7
# An evolved star is a subgiant as long as log g is larger.
_GIANT_LOG_G = 3.5
# Cells of a normal distribution of metallicity reach to so many standard deviations.
_REACH = 3.0


@dataclass(frozen=True, slots=True)
class MassFunction:
    """Broken power law of stellar systems as they are born (milky_way.toml, [mass_function])."""

    lightest: float
    reference: float
    breaks: tuple[float, ...]
    slopes: tuple[float, ...]
    local: float


@dataclass(frozen=True, slots=True)
class WhiteDwarfs:
    """Luminosity function of white dwarfs (milky_way.toml, [white_dwarfs])."""

    local: float
    slope: float
    brightest: float
    faintest: float
    radius: float
    log_g: float


@dataclass(frozen=True, slots=True)
class Population:
    """k cells of age and metallicity of a component.

    age, metallicity : [k] Gyr, [M/H];  width : [k] of the cell in [M/H];  share : [k] of the systems born, sum 1
    """

    age: Float
    metallicity: Float
    width: Float
    share: Float


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """k isochrones of q points by ascending initial mass.

    age, metallicity : [k] Gyr, [M/H];  evolved : first point after the main sequence
    log_mass, log_teff, log_g, m_h : [k, q] log10 Msun, log10 K, cm s-2, mag
    """

    age: Float
    metallicity: Float
    evolved: int
    log_mass: Float
    log_teff: Float
    log_g: Float
    m_h: Float


@dataclass(frozen=True, slots=True, eq=False)
class Pieces:
    """n stretches, along which log mass, log Teff, log g and M_H are linear; [2, n] at both ends.

    track  : [n] index of the isochrone, -1 of white dwarfs;  stage : [n] DWARF, ..;  bin : [n] of M_H
    number : [n] pc^-3
    """

    track: Int
    stage: Int
    bin: Int
    number: Float
    log_mass: Float
    log_teff: Float
    log_g: Float
    m_h: Float

    def take(self, chosen: Int | Bool) -> Pieces:
        return Pieces(*(getattr(self, field.name)[..., chosen] for field in fields(self)))


def concatenate(parts: list[Pieces]) -> Pieces:
    """All of them, one after another."""
    return Pieces(*(np.concatenate([getattr(part, f.name) for part in parts], -1) for f in fields(Pieces)))


def build_population(ages: Float, shares: Float, mean: Float, scatter: Float, cells: int) -> Population:
    """Ages[a] Gyr with their shares, and about each mean[a] of [M/H] a normal law, cut at 3 sigma, in cells.

    ages, shares   : float[a] Gyr, and of the systems born;  cells : of each age
    mean, scatter  : float[a] of [M/H]
    """
    edges = np.linspace(-_REACH, _REACH, cells + 1)
    middle, step = 0.5 * (edges[1:] + edges[:-1]), edges[1] - edges[0]
    normal = np.exp(-0.5 * middle**2)
    metals = mean[:, None] + scatter[:, None] * middle
    share = (shares / shares.sum())[:, None] * normal / normal.sum()
    return Population(np.repeat(ages, cells), metals.ravel(), np.repeat(scatter * step, cells), share.ravel())


def build_tracks(age: Float, metallicity: Float) -> Tracks:
    """Of ages[k] Gyr and metallicities[k]."""
    model, types = isochrones.isochrones(age, metallicity), stellar.types()
    solar = isochrones.isochrones(age, np.zeros(age.size))
    nearby = _nearby_dwarfs(types)
    is_low_mass = nearby.log_mass[0] < np.log10(_NEARBY_MASS) - 1e-9
    quantities = (nearby.log_mass, nearby.log_teff, nearby.log_g, nearby.m_h)
    low = [np.tile(values[0, is_low_mass], (age.size, 1)) for values in quantities]
    log_mass = np.log10(model.mass)
    # What is known of nearby dwarfs at the isochrones' masses, and its share.
    nearby_weight = np.clip((_MODEL_MASS - model.mass) / (_MODEL_MASS - _NEARBY_MASS), 0.0, 1.0)
    hotter = (model.log_teff - solar.log_teff)[:, :1]
    nearby_values = [
        np.interp(log_mass, nearby.log_mass[0], values[0]) for values in (nearby.log_teff, nearby.log_g, nearby.m_h)
    ]
    vega = vega_magnitude(passbands.load(STAR_BAND))
    shape = log_mass.shape
    correction = model_stars.bolometric_h(
        types, vega, 10.0 ** model.log_teff.ravel(), model.log_g.ravel(), np.repeat(metallicity, shape[1])
    )
    m_h = _SUN_M_BOL - 2.5 * model.log_l - correction.reshape(shape)
    log_teff = nearby_weight * (nearby_values[0] + hotter) + (1.0 - nearby_weight) * model.log_teff
    parts = (
        log_mass,
        log_teff,
        nearby_weight * nearby_values[1] + (1.0 - nearby_weight) * model.log_g,
        nearby_weight * nearby_values[2] + (1.0 - nearby_weight) * m_h,
    )
    low[1] = low[1] + hotter
    values = [np.concatenate(pair, 1) for pair in zip(low, parts, strict=True)]
    return Tracks(age, metallicity, int(is_low_mass.sum()) + model.main_sequence, *values)


def _nearby_dwarfs(types: stellar.StellarTypes) -> Tracks:
    """The mean dwarf sequence.  Ref: Pecaut & Mamajek 2013, Table 5 and its updates."""
    order = np.argsort(-types.abs_mag_h)
    log_mass = np.log10(types.mass[order])
    # Types of nearly equal mass are not in order: half-way between the two monotone envelopes.
    up = np.maximum.accumulate(log_mass)
    down = np.minimum.accumulate(log_mass[::-1])[::-1]
    mass = 0.5 * (up + down) + 1e-9 * np.arange(order.size)
    values = (mass, np.log10(types.teff[order]), types.log_g[order], types.abs_mag_h[order])
    return Tracks(np.zeros(1), np.zeros(1), order.size, *(v[None, :] for v in values))


def build_pieces(tracks: Tracks, share: Float, masses: MassFunction, m_h: Float) -> Pieces:
    """Stretches of isochrones, with the systems of a mass function whose integral below `reference` is 1 if all live.

    found : k isochrones;  share : [k] of the systems that each has
    masses : the mass function;  m_h : [b + 1] edges of the bins, ascending
    """
    born = _power_law(masses, np.maximum(10.0**tracks.log_mass, masses.lightest))
    number = np.diff(born, axis=1) / _power_law(masses, np.asarray(masses.reference)) * share[:, None]
    q = number.shape[1]
    step = np.arange(q)
    living = np.broadcast_to(step != tracks.evolved - 1 + isochrones.FLASH, number.shape) & (number > 0.0)
    row, at = np.nonzero(living)
    along = (tracks.log_mass, tracks.log_teff, tracks.log_g, tracks.m_h)
    ends = [np.stack([values[row, at], values[row, at + 1]]) for values in along]
    stage = np.where(at >= tracks.evolved - 1, GIANT, DWARF)
    cut = _in_bins(Pieces(row, stage, np.zeros(row.size, np.int64), number[row, at], *ends), m_h)
    young = (cut.stage == GIANT) & (cut.log_g.mean(0) > _GIANT_LOG_G)
    return replace(cut, stage=np.where(young, SUBGIANT, cut.stage))


def _in_bins(pieces: Pieces, edges: Float) -> Pieces:
    """The stretches cut at the edges of the bins; what lies outside of all is left out."""
    step, first = edges[1] - edges[0], edges[0]
    place = (pieces.m_h - first) / step
    low, high = place.min(0), place.max(0)
    start = np.floor(low).astype(np.int64)
    count = np.maximum(np.ceil(high).astype(np.int64) - start, 1)
    piece_index = np.repeat(np.arange(start.size), count)
    bin_index = start[piece_index] + np.arange(piece_index.size) - np.repeat(np.cumsum(count) - count, count)
    span = np.maximum(high - low, 1e-12)[piece_index]
    # Along the stretch, from its fainter or brighter end.
    part = np.clip((np.stack([bin_index, bin_index + 1]) - low[piece_index]) / span, 0.0, 1.0)
    part[:, count[piece_index] == 1] = np.array([0.0, 1.0])[:, None]
    falling = place[0, piece_index] > place[1, piece_index]
    along = np.where(falling, 1.0 - part, part)
    ends = [
        values[0, piece_index] + (values[1, piece_index] - values[0, piece_index]) * along
        for values in (pieces.log_mass, pieces.log_teff, pieces.log_g, pieces.m_h)
    ]
    out = Pieces(
        pieces.track[piece_index],
        pieces.stage[piece_index],
        bin_index,
        pieces.number[piece_index] * (part[1] - part[0]),
        *ends,
    )
    return out.take((bin_index >= 0) & (bin_index < edges.size - 1) & (out.number > 0.0))


def white_dwarf_pieces(m_h: Float) -> Pieces:
    """Cooling white dwarfs of one radius, in bins of M_H with these edges[b + 1]."""
    numbers = WhiteDwarfs(**parameters.section(_FILE, "white_dwarfs"))
    m_bol, at = _white_dwarf_magnitudes(numbers)
    number = np.diff(cumulative_white_dwarfs(numbers, m_h))
    bins = np.flatnonzero(number > 0.0)
    edges = np.stack([m_h[bins], m_h[bins + 1]])
    log_teff = np.log10(np.interp(edges, at, _white_dwarf_teff(numbers, m_bol)))
    zeros, g = np.zeros(edges.shape), np.full(edges.shape, numbers.log_g)
    stage = np.full(bins.size, WHITE_DWARF)
    return Pieces(np.full(bins.size, -1), stage, bins, number[bins], zeros, log_teff, g, edges)


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


def _power_law(masses: MassFunction, m: Float) -> Float:
    """Integral of the mass function below m[n] Msun, not normalised.  Ref: Kroupa 2001"""
    edges = (masses.lightest, *masses.breaks, np.inf)
    total, height = np.zeros(m.shape), 1.0
    for i, slope in enumerate(masses.slopes):
        low, rise = edges[i], slope + 1.0
        top = np.clip(m, low, edges[i + 1])
        total = total + height * low * np.expm1(rise * np.log(top / low)) / rise
        height *= (edges[i + 1] / low) ** slope if np.isfinite(edges[i + 1]) else 1.0
    return np.asarray(total)


def cumulative_white_dwarfs(numbers: WhiteDwarfs, m_h: Float) -> Float:
    """White dwarfs pc^-3 at the Sun brighter than M_H.

    m_h : float[n] mag, Vega
    """
    m_bol, at = _white_dwarf_magnitudes(numbers)
    rise = numbers.slope * np.log(10.0)
    share = np.expm1(rise * (m_bol - m_bol[0])) / np.expm1(rise * (m_bol[-1] - m_bol[0]))
    return np.asarray(numbers.local * np.interp(m_h, at, share))
