"""Colours and dust of galaxies: red and blue sequences of 0.1(g - r), and dusty galaxies between them.

red_fraction       how many are red, against luminosity and redshift
limits             of the colours that the templates have
draw, known        sequence and colour;  dust : E(B-V) and extinction law

Colours and E(B-V) come from truncated distributions, through their inverse: no two galaxies share a value where a
distribution ends.
Ref: Skibba & Sheth 2009, Ilbert et al. 2009; the numbers and their sources are in sed_assignment.toml.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.special import gammainc, ndtr, ndtri

from lake_schema.arrays import Bool, Float, Int
from truesky.catalogue import parameters
from truesky.catalogue.galaxies.band_ratios import BandRatios, ebv_weights
from truesky.fluxes.spectra.extinction import CALZETTI, LAW_COUNT, PREVOT
from truesky.numerics import matrices
from truesky.randomness.per_source import AnyGenerator

_FILE = "sed_assignment.toml"
BLUE, GREEN, RED = 0, 1, 2
# The sequences are written in M_r + 20.
_PIVOT = -20.0
# Galaxies of other catalogues are no further from a sequence, in its scatter.
_MAX_DEVIATE = 3.0
# Nodes of E(B-V) at which the bluest template's colour is known, and of the Gamma distribution in units of its
# mean / shape, denser towards 0: 1e-4 of a value.
_EBV_NODES, _GAMMA_NODES = 65, 60.0 * np.linspace(0.0, 1.0, 8001) ** 3


@dataclass(frozen=True, slots=True)
class RedFraction:
    """Share of the red sequence (sed_assignment.toml, [red_fraction])."""

    blue: float
    blue_rate: float
    limits: tuple[float, float]
    times: tuple[float, float]
    z_norm: float
    z_rate: float
    z_bright: float
    z_pivot: float
    z_limits: tuple[float, float]
    dwarf: float
    dwarf_rate: float
    highest: float


@dataclass(frozen=True, slots=True)
class Green:
    """Dusty galaxies between the sequences (sed_assignment.toml, [green])."""

    z_norm: float
    z_rate: float
    z_floor: float
    excess: float
    usual: float
    z_ramp: tuple[float, float]
    max_share: float
    redder: float
    scatter: float
    ebv: float


@dataclass(frozen=True, slots=True)
class ColourSequence:
    """Mean colours and scatters (sed_assignment.toml, [sequence])."""

    red: float
    red_rate: float
    red_z_rate: float
    red_scatter: float
    red_scatter_rate: float
    red_scatter_limits: tuple[float, float]
    blue: float
    blue_rate: float
    blue_limits: tuple[float, float]
    blue_z_rate: float
    z_first: float
    z_range: float
    far_z_rate: float
    far_z: float
    far_z_range: float
    blue_scatter: float
    blue_scatter_rate: float
    blue_scatter_limits: tuple[float, float]
    red_least: float
    inside: tuple[float, float]


@dataclass(frozen=True, slots=True)
class Dust:
    """Dust of galaxies that are not red (sed_assignment.toml, [dust])."""

    shape: float
    mean: float
    mean_rate: float
    pivot: float
    mean_limits: tuple[float, float]
    far_z_rate: float
    far_z: float
    far_z_range: float
    highest: float
    lowest: float
    prevot_colour: float
    calzetti_odds: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Colours:
    """Everything that colours and dust are drawn from, made once by `model`."""

    fraction: RedFraction
    green: Green
    sequence: ColourSequence
    dust: Dust


@dataclass(frozen=True, slots=True)
class ColourLimits:
    """Of the colours that the templates have.

    bluest, reddest : 0.1(g - r) mag, without dust
    ebv : [e] mag;  behind : [law, e] 0.1(g - r) of the bluest template behind so much dust
    """

    bluest: float
    reddest: float
    ebv: Float
    bluest_dusty: Float


@dataclass(frozen=True, slots=True, eq=False)
class Colour:
    """n galaxies: sequence (BLUE, GREEN, RED), 0.1(g - r) mag, and its normal deviate on the sequence."""

    sequence: Int
    colour: Float
    deviate: Float

    @property
    def red(self) -> Bool:
        """bool[n]"""
        return np.asarray(self.sequence == RED)

    def select(self, keep: npt.NDArray[np.generic]) -> Colour:
        """The galaxies that are kept: keep : bool or int[m] rows."""
        return Colour(self.sequence[keep], self.colour[keep], self.deviate[keep])


def model() -> Colours:
    """The colours of the embedded universe."""
    return Colours(
        RedFraction(**parameters.section(_FILE, "red_fraction")),
        Green(**parameters.section(_FILE, "green")),
        ColourSequence(**parameters.section(_FILE, "sequence")),
        Dust(**parameters.section(_FILE, "dust")),
    )


def colour_limits(table: BandRatios, dust: Dust) -> ColourLimits:
    """Of the colours of a library.

    table : of 0.1g at z = 0;  dust : how much of it there may be
    """
    ebv = np.linspace(0.0, dust.highest, _EBV_NODES)
    ln_ratio = table.values[0].astype(np.float64)
    bare = -2.5 / np.log(10.0) * ln_ratio[0, :, 0]
    bluest_dusty = -2.5 / np.log(10.0) * matrices.matmul(ln_ratio[:, -1, :], ebv_weights(table.ebv, ebv).T)
    return ColourLimits(float(bare[-1]), float(bare[0]), ebv, np.maximum.accumulate(bluest_dusty, axis=1))


def red_fraction(law: RedFraction, m_r: Float, z: Float, satellite: Float | Int) -> Float:
    """Share[n] of galaxies on the red sequence.

    m_r, z : float[n] M_r mag, redshift
    satellite : [n] 0 central, 1 satellite; or how many of the galaxies of this luminosity are
    law   : constants of the relation
    Ref: Skibba & Sheth 2009
    """
    bright = np.clip(1.0 - (law.blue + law.blue_rate * (m_r - _PIVOT)), *law.limits)
    times = law.times[0] + (law.times[1] - law.times[0]) * satellite
    evolved = law.z_norm - law.z_rate * z * (1.0 + law.z_bright * (m_r - law.z_pivot))
    shares = bright * times * np.clip(evolved, *law.z_limits) * _dwarf_factor(law, m_r)
    return np.asarray(np.minimum(shares, law.highest))


def green_share(law: Green, fraction: RedFraction, m_r: Float, z: Float) -> Float:
    """Share[n] of green galaxies among those that are not red.

    m_r, z : float[n] M_r mag, redshift;  law, fraction : constants
    """
    bright = np.clip(1.0 - (fraction.blue + fraction.blue_rate * (m_r - _PIVOT)), *fraction.limits)
    old = bright * np.clip(law.z_norm - law.z_rate * z, law.z_floor, 1.0) * _dwarf_factor(fraction, m_r)
    red = red_fraction(fraction, m_r, z, np.zeros(m_r.size))
    ramp = np.clip((law.z_ramp[1] - z) / (law.z_ramp[1] - law.z_ramp[0]), 0.0, 1.0)
    share = np.clip(law.excess * np.maximum(old - red, 0.0) + law.usual * ramp, 0.0, law.max_share)
    return np.asarray(np.minimum(share / (1.0 - red), 1.0))


def draw(colours: Colours, limits: ColourLimits, m_r: Float, z: Float, odds: Float, rng: AnyGenerator) -> Colour:
    """Sequence and colour of galaxies.

    m_r, z : float[n] M_r mag, redshift;  odds : float[n] of being red
    own    : the sequences;  ends : of the templates' colours;  rng : of the sequence, then of the place on it
    """
    law, chosen, uniform = colours.sequence, rng.random(z.size), _open_uniform(rng, z.size)
    # Of what is not red, the first part is green: one number says both.
    green = odds + (1.0 - odds) * green_share(colours.green, colours.fraction, m_r, z)
    sequence = np.where(chosen < odds, RED, np.where(chosen < green, GREEN, BLUE))
    mean, scatter = _mean_and_scatter(colours, m_r, z, sequence)
    low = limits.bluest + law.inside[0]
    min_colour = np.where(sequence == RED, max(law.red_least, low), low)
    max_colour = limits.reddest - law.inside[1]
    colour = mean + scatter * truncated_normal((min_colour - mean) / scatter, (max_colour - mean) / scatter, uniform)
    return Colour(sequence, np.clip(colour, min_colour, max_colour), ndtri(uniform))


def place_on_sequence(colours: Colours, m_r: Float, z: Float, colour: Float, red: Bool) -> Colour:
    """Galaxies whose colours are given, with their places on the sequences.

    m_r, z : float[n] M_r mag, redshift;  colour : float[n] 0.1(g - r) mag;  red : bool[n];  own : the sequences
    """
    sequence = np.where(red, RED, BLUE)
    mean, scatter = _mean_and_scatter(colours, m_r, z, sequence)
    return Colour(sequence, colour, np.clip((colour - mean) / scatter, -_MAX_DEVIATE, _MAX_DEVIATE))


def _mean_and_scatter(colours: Colours, m_r: Float, z: Float, sequence: Int) -> tuple[Float, Float]:
    """Mean and scatter[n] of 0.1(g - r) of each galaxy's sequence."""
    law, x = colours.sequence, m_r - _PIVOT
    red_mean = law.red + law.red_rate * x - law.red_z_rate * z
    blue_mean = np.clip(law.blue + law.blue_rate * x, *law.blue_limits)
    blue_mean = blue_mean - law.blue_z_rate * np.clip(z - law.z_first, 0.0, law.z_range)
    blue_mean = blue_mean - law.far_z_rate * np.clip(z - law.far_z, 0.0, law.far_z_range)
    red_scatter = np.clip(law.red_scatter + law.red_scatter_rate * x, *law.red_scatter_limits)
    blue_scatter = np.clip(law.blue_scatter + law.blue_scatter_rate * x, *law.blue_scatter_limits)
    green = 0.5 * (red_mean + blue_mean) + colours.green.redder
    mean = np.where(sequence == RED, red_mean, np.where(sequence == GREEN, green, blue_mean))
    return mean, np.where(
        sequence == RED, red_scatter, np.where(sequence == GREEN, colours.green.scatter, blue_scatter)
    )


def truncated_normal(low: Float, high: Float, uniform: Float) -> Float:
    """Normal deviates[n] between two limits, in the tail that keeps its digits.

    low, high : float[n];  uniform : float[n] in (0, 1), of which the deviates are a growing function
    """
    mirrored = low > 0.0
    a, b = np.where(mirrored, -high, low), np.where(mirrored, -low, high)
    below, above = ndtr(a), ndtr(b)
    u = np.where(mirrored, 1.0 - uniform, uniform)
    # Both limits 30 standard deviations away leave nothing between: the nearer one.
    deviate = ndtri(np.clip(below + u * (above - below), 1e-300, 1.0 - 1e-16))
    return np.asarray(np.where(mirrored, -deviate, deviate))


def draw_dust(
    colours: Colours, limits: ColourLimits, m_r: Float, z: Float, colour: Colour, rng: AnyGenerator
) -> tuple[Int, Float]:
    """(extinction law[n], E(B-V)[n] mag); red galaxies have no dust.

    m_r, z : float[n] mag, redshift;  found : their colours;  rng : of E(B-V), then of the law
    own    : laws and the distribution of E(B-V);  ends : of the templates' colours
    Ref: Ilbert et al. 2009
    """
    law = colours.dust
    amount, odds = rng.random(z.size), np.cumsum(law.calzetti_odds)
    calzetti = CALZETTI + np.searchsorted(odds[:-1], rng.random(z.size) * odds[-1], side="right")
    curve = np.where(colour.colour > law.prevot_colour, PREVOT, calzetti)
    green = colour.sequence == GREEN
    curve = np.where(green, CALZETTI, curve)
    mean = np.clip(law.mean + law.mean_rate * (m_r - law.pivot), *law.mean_limits)
    mean = mean * (1.0 - law.far_z_rate * np.clip(z - law.far_z, 0.0, law.far_z_range))
    scale = np.where(green, colours.green.ebv, mean) / law.shape
    # No more than leaves the bluest template as blue as the galaxy.
    max_ebv = np.empty(m_r.size)
    for code in range(1, LAW_COUNT):
        selected = np.flatnonzero(curve == code)
        max_ebv[selected] = np.interp(colour.colour[selected], limits.bluest_dusty[code - 1], limits.ebv)
    cumulative = _gamma_table(law.shape)
    reach = np.interp(max_ebv / scale, _GAMMA_NODES, cumulative)
    ebv = scale * np.interp(amount * reach, cumulative, _GAMMA_NODES)
    clean = colour.red | (ebv < law.lowest)
    return np.where(clean, 0, curve), np.where(clean, 0.0, ebv)


def _open_uniform(rng: AnyGenerator, n: int) -> Float:
    """Uniform in (0, 1), [n]: numpy's own may be 0."""
    return np.maximum(rng.random(n), 2.0**-54)


def _gamma_table(shape: float) -> Float:
    """Cumulative Gamma distribution at _GAMMA_NODES."""
    return np.asarray(gammainc(shape, _GAMMA_NODES))


def _dwarf_factor(law: RedFraction, m_r: Float) -> Float:
    return np.asarray(10.0 ** (-law.dwarf_rate * np.maximum(m_r - law.dwarf, 0.0)))
