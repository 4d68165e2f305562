"""Stellar populations: luminosities, temperatures, gravities and numbers of stars by mass and age.

Stars above 0.7 Msun are on isochrones. Stars below 0.5 Msun are on the mean sequence of nearby dwarfs, which is made
hotter for low metallicities by the difference of the isochrones at 0.5 Msun. Both are blended between 0.5 and 0.7 Msun.
Types later than M9 are a separate population, the brown dwarfs. Magnitudes are 2MASS H in the Vega system. The
parameters and their sources are in milky_way.toml.

References
----------
Kroupa 2001 (masses), Pecaut & Mamajek 2013 (nearby dwarfs)
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from lake_schema.arrays import Array, Bool, Float, Int
from truesky.catalogue import parameters
from truesky.catalogue.stars import isochrones
from truesky.fluxes import passbands
from truesky.fluxes.calibration import STAR_BAND
from truesky.fluxes.libraries import model_stars, stellar
from truesky.fluxes.libraries.vega import vega_magnitude
from truesky.numerics import cache
from truesky.numerics.code_fingerprints import code_key

DWARF, GIANT, WHITE_DWARF, BROWN_DWARF, SUBGIANT = range(5)
_FILE = "milky_way.toml"
# Number of magnitudes at which the cooling sequence of white dwarfs is tabulated.
_STEPS = 500
# Temperature (K) and absolute bolometric magnitude of the Sun (nominal values of IAU 2015).
_SUN_TEFF, _SUN_M_BOL = 5772.0, 4.74
# Masses (Msun) between which the sequence of nearby dwarfs and the isochrones are blended.
_NEARBY_MASS, _MODEL_MASS = 0.5, 0.7
# Stars after the main sequence are subgiants if their log g (cm s-2) is larger, and giants if it is smaller.
_GIANT_LOG_G = 3.5
# Fields of `Tracks` that are stored in the cache.
_TRACK_ARRAYS = ("evolved", "log_mass", "log_teff", "log_g", "m_h")
# Largest distance from the mean of the normal distribution of metallicity, standard deviations.
_REACH = 3.0


@dataclass(frozen=True, slots=True)
class MassFunction:
    """Parameters of the mass function of stellar systems at birth (milky_way.toml, [mass_function])."""

    lightest: float
    reference: float
    breaks: tuple[float, ...]
    slopes: tuple[float, ...]
    local: float


@dataclass(frozen=True, slots=True)
class WhiteDwarfs:
    """Parameters of the luminosity function of white dwarfs; explained in milky_way.toml, [white_dwarfs]."""

    local: float
    slope: float
    brightest: float
    faintest: float
    radius: float
    log_g: float


@dataclass(frozen=True, slots=True)
class Population:
    """Ages and metallicities of a component of the Milky Way (such as the thin disc), divided into k cells.

    Attributes
    ----------
    age : float array, shape (k,)
        Age of each cell, Gyr.
    metallicity : float array, shape (k,)
        [M/H] in the middle of the cell.
    width : float array, shape (k,)
        Width of the cell in [M/H].
    share : float array, shape (k,)
        Fraction of the component's stellar systems that are born in the cell; the sum is 1.
    """

    age: Float
    metallicity: Float
    width: Float
    share: Float


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """k isochrones with q points each, in the order of increasing initial mass.

    Attributes
    ----------
    age : float array, shape (k,)
        Age, Gyr.
    metallicity : float array, shape (k,)
        [M/H].
    evolved : int
        Index of the first point after the main sequence.
    log_mass : float array, shape (k, q)
        log10 of the initial mass, Msun.
    log_teff : float array, shape (k, q)
        log10 Teff / K.
    log_g : float array, shape (k, q)
        log10 of the surface gravity, cm s-2.
    m_h : float array, shape (k, q)
        Absolute H magnitude (Vega).
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
    """Isochrones and the cooling sequence of white dwarfs, cut into short stretches at the edges of bins of M_H.

    M_H is the absolute H magnitude. Along a stretch, all values are linear.

    Attributes
    ----------
    track : int array, shape (n,)
        Index of the isochrone, -1 for white dwarfs.
    stage : int array, shape (n,)
        Evolutionary stage: DWARF, GIANT, WHITE_DWARF or SUBGIANT.
    bin : int array, shape (n,)
        Index of the bin of M_H that contains the stretch.
    number : float array, shape (n,)
        Number density of the stars on the stretch, pc^-3.
    log_mass, log_teff, log_g, m_h : float array, shape (2, n)
        Values at both ends of the stretch, in the units of `Tracks`.
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
        """Return some of the stretches, given as a bool mask of shape (n,) or as indices."""
        return Pieces(*(getattr(self, field.name)[..., chosen] for field in fields(self)))


def concatenate(parts: list[Pieces]) -> Pieces:
    """Return the stretches of all parts in one object, in the order of the list."""
    return Pieces(*(np.concatenate([getattr(part, f.name) for part in parts], -1) for f in fields(Pieces)))


def build_population(ages: Float, shares: Float, mean: Float, scatter: Float, cells: int) -> Population:
    """Divide a stellar population into cells of age and metallicity.

    Parameters
    ----------
    ages : float array, shape (a,)
        Ages, Gyr.
    shares : float array, shape (a,)
        Number of stellar systems that are born at each age, in any unit.
    mean, scatter : float array, shape (a,)
        Mean and standard deviation of the normal distribution of [M/H] at each age. It is cut at 3 standard deviations.
    cells : int
        Number of cells in [M/H] per age.

    Returns
    -------
    Population
        The a times `cells` cells; their fractions are normalised.
    """
    edges = np.linspace(-_REACH, _REACH, cells + 1)
    middle, step = 0.5 * (edges[1:] + edges[:-1]), edges[1] - edges[0]
    normal = np.exp(-0.5 * middle**2)
    metals = mean[:, None] + scatter[:, None] * middle
    share = (shares / shares.sum())[:, None] * normal / normal.sum()
    return Population(np.repeat(ages, cells), metals.ravel(), np.repeat(scatter * step, cells), share.ravel())


def build_tracks(age: Float, metallicity: Float) -> Tracks:
    """Return isochrones of ages (Gyr) and metallicities [M/H], shape (k,), with the sequence of nearby dwarfs.

    The sequence of nearby dwarfs replaces the isochrones below 0.5 Msun, and is blended with them up to 0.7 Msun. They
    are computed once and stored in the cache on disc.
    """
    key = cache.content_key(code_key(__name__), age, metallicity)
    arrays = cache.cached_arrays("isochrones", key, lambda: _compute_tracks(age, metallicity))
    evolved, *values = (arrays[name] for name in _TRACK_ARRAYS)
    return Tracks(age, metallicity, int(evolved[0]), *values)


def _compute_tracks(age: Float, metallicity: Float) -> dict[str, Array]:
    """Return the arrays `_TRACK_ARRAYS` of `Tracks`; `evolved` is an array with one element."""
    model, types = isochrones.isochrones(age, metallicity), stellar.types()
    solar = isochrones.isochrones(age, np.zeros(age.size))
    nearby = _nearby_dwarfs(types)
    is_low_mass = nearby.log_mass[0] < np.log10(_NEARBY_MASS) - 1e-9
    quantities = (nearby.log_mass, nearby.log_teff, nearby.log_g, nearby.m_h)
    low = [np.tile(values[0, is_low_mass], (age.size, 1)) for values in quantities]
    log_mass = np.log10(model.mass)
    # `nearby_weight` is the weight of the nearby dwarfs at the masses of the isochrones: 1 to 0 from 0.5 to 0.7 Msun.
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
    evolved = np.array([int(is_low_mass.sum()) + model.main_sequence])
    return dict(zip(_TRACK_ARRAYS, (evolved, *values), strict=True))


def _nearby_dwarfs(types: stellar.StellarTypes) -> Tracks:
    """Return the mean sequence of nearby dwarfs as one isochrone (Pecaut & Mamajek 2013, Table 5 and its updates)."""
    order = np.argsort(-types.abs_mag_h)
    log_mass = np.log10(types.mass[order])
    # Masses of neighbouring types are not always in order: use the mean of the two monotone envelopes of the masses.
    up = np.maximum.accumulate(log_mass)
    down = np.minimum.accumulate(log_mass[::-1])[::-1]
    mass = 0.5 * (up + down) + 1e-9 * np.arange(order.size)
    values = (mass, np.log10(types.teff[order]), types.log_g[order], types.abs_mag_h[order])
    return Tracks(np.zeros(1), np.zeros(1), order.size, *(v[None, :] for v in values))


def build_pieces(tracks: Tracks, share: Float, masses: MassFunction, m_h: Float) -> Pieces:
    """Cut isochrones into stretches at the edges of bins of the absolute H magnitude.

    Parameters
    ----------
    tracks : Tracks
        k isochrones.
    share : float array, shape (k,)
        Fraction of the stellar systems that belong to each isochrone.
    masses : MassFunction
        Mass function at birth. Numbers are per system that is born with a mass below `masses.reference`.
    m_h : float array, shape (b + 1,)
        Edges of the bins of the absolute H magnitude, ascending, with a constant step.

    Returns
    -------
    Pieces
        The stretches with their numbers of stars, without the parts outside the bins.
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
    """Cut stretches at the edges of bins of M_H, which have a constant step, and remove the parts outside the bins."""
    step, first = edges[1] - edges[0], edges[0]
    place = (pieces.m_h - first) / step
    low, high = place.min(0), place.max(0)
    start = np.floor(low).astype(np.int64)
    count = np.maximum(np.ceil(high).astype(np.int64) - start, 1)
    piece_index = np.repeat(np.arange(start.size), count)
    bin_index = start[piece_index] + np.arange(piece_index.size) - np.repeat(np.cumsum(count) - count, count)
    span = np.maximum(high - low, 1e-12)[piece_index]
    # `part` is where the two ends of each new stretch are along the old one: 0 at its brighter, 1 at its fainter end.
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
    """Return the cooling sequence of white dwarfs as one stretch per bin of the absolute H magnitude.

    `m_h` are the ascending edges of the bins, Vega magnitudes. All white dwarfs have the same radius and gravity, and
    `log_mass` is 0, a placeholder. Bins without white dwarfs have no stretch.
    """
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
    """Return absolute bolometric and absolute H magnitudes along the white dwarf sequence, both ascending."""
    m_bol = np.linspace(numbers.brightest, numbers.faintest, _STEPS)
    types = stellar.types()
    correction = np.interp(-_white_dwarf_teff(numbers, m_bol), -types.teff, types.bolometric_h)
    m_h = m_bol - correction
    return m_bol, np.maximum.accumulate(m_h)


def _white_dwarf_teff(numbers: WhiteDwarfs, m_bol: Float) -> Float:
    """Return the temperature (K) of white dwarfs with these absolute bolometric magnitudes (Stefan-Boltzmann law)."""
    return np.asarray(_SUN_TEFF * 10.0 ** (-0.1 * (m_bol - _SUN_M_BOL)) / np.sqrt(numbers.radius))


def _power_law(masses: MassFunction, m: Float) -> Float:
    """Return the integral of the mass function from the lightest mass to each mass m (Msun); it is not normalised."""
    edges = (masses.lightest, *masses.breaks, np.inf)
    total, height = np.zeros(m.shape), 1.0
    for i, slope in enumerate(masses.slopes):
        low, rise = edges[i], slope + 1.0
        top = np.clip(m, low, edges[i + 1])
        total = total + height * low * np.expm1(rise * np.log(top / low)) / rise
        height *= (edges[i + 1] / low) ** slope if np.isfinite(edges[i + 1]) else 1.0
    return np.asarray(total)


def cumulative_white_dwarfs(numbers: WhiteDwarfs, m_h: Float) -> Float:
    """Return the number of white dwarfs per pc^3 near the Sun that are brighter than absolute H magnitudes (Vega)."""
    m_bol, at = _white_dwarf_magnitudes(numbers)
    rise = numbers.slope * np.log(10.0)
    share = np.expm1(rise * (m_bol - m_bol[0])) / np.expm1(rise * (m_bol[-1] - m_bol[0]))
    return np.asarray(numbers.local * np.interp(m_h, at, share))
