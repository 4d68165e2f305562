"""Draw the colours and the dust of galaxies: a red and a blue sequence, and dusty (green) galaxies between them.

The colour is the rest-frame 0.1(g - r): SDSS g - r in bands blueshifted to z = 0.1. Colours and E(B-V) are drawn from
truncated distributions by inversion, so that galaxies do not pile up at the limits. The parameters and their sources
are in sed_assignment.toml.

References
----------
Skibba & Sheth 2009, Ilbert et al. 2009
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import scipy

from lake_schema.arrays import Bool, Float, Int
from truesky.catalogue import parameters
from truesky.catalogue.galaxies.band_ratios import BandRatios, ebv_weights
from truesky.fluxes.spectra.extinction import CALZETTI, LAW_COUNT, PREVOT
from truesky.numerics import matrices
from truesky.randomness.per_source import AnyGenerator

_FILE = "sed_assignment.toml"
BLUE, GREEN, RED = 0, 1, 2
# Zero point of the linear relations of the sequences, which are constant + rate (M_r - _PIVOT). M_r is the absolute
# magnitude in 0.1r.
_PIVOT = -20.0
# Largest difference between the colour of a galaxy from a user's catalogue and the mean of its sequence, in units of
# the scatter; larger differences are set to this value.
_MAX_DEVIATE = 3.0
# Number of values of E(B-V) at which the colour of the bluest template is tabulated.
_EBV_NODES = 65
# Values at which the cumulative Gamma distribution of E(B-V) is tabulated, in units of its scale (mean / shape). They
# are denser towards 0. The relative error is 1e-4.
_GAMMA_NODES = 60.0 * np.linspace(0.0, 1.0, 8001) ** 3


@dataclass(frozen=True, slots=True)
class RedFraction:
    """Parameters of the fraction of red galaxies by luminosity and redshift (sed_assignment.toml, [red_fraction])."""

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
    """Parameters of the dusty galaxies between the sequences; explained in sed_assignment.toml, [green]."""

    z_norm: float
    z_rate: float
    z_floor: float
    excess: float
    usual: float
    z_ramp: tuple[float, float]
    max_share: float
    offset: float
    scatter: float
    ebv: float


@dataclass(frozen=True, slots=True)
class ColourSequence:
    """Parameters of the mean colour and scatter of both sequences; explained in sed_assignment.toml, [sequence]."""

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
    """Parameters of the dust of galaxies that are not red; explained in sed_assignment.toml, [dust]."""

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
    prevot_colour: tuple[float, float]
    prevot_z: tuple[float, float]
    calzetti_odds: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Colours:
    """All parameters of the distributions of the colours and the dust of galaxies (sed_assignment.toml)."""

    fraction: RedFraction
    green: Green
    sequence: ColourSequence
    dust: Dust


@dataclass(frozen=True, slots=True)
class ColourLimits:
    """Range of rest-frame colours 0.1(g - r) that the template spectra can have.

    Attributes
    ----------
    bluest, reddest : float
        0.1(g - r) of the bluest and of the reddest template without dust, mag.
    ebv : float array, shape (e,)
        E(B-V) of the last axis of `bluest_dusty`, mag.
    bluest_dusty : float array, shape (laws, e)
        0.1(g - r) of the bluest template behind dust, by extinction law (1 to 4) and E(B-V), mag.
    """

    bluest: float
    reddest: float
    ebv: Float
    bluest_dusty: Float


@dataclass(frozen=True, slots=True, eq=False)
class Colour:
    """Colours of n galaxies.

    Attributes
    ----------
    sequence : int array, shape (n,)
        Sequence of the galaxy: BLUE, GREEN or RED.
    colour : float array, shape (n,)
        Rest-frame 0.1(g - r), mag.
    deviate : float array, shape (n,)
        Place of the colour in the distribution of its sequence, as a standard normal deviate; negative means bluer than
        the median.
    """

    sequence: Int
    colour: Float
    deviate: Float

    @property
    def red(self) -> Bool:
        """Return True for galaxies on the red sequence, shape (n,)."""
        return np.asarray(self.sequence == RED)

    def select(self, keep: npt.NDArray[np.generic]) -> Colour:
        """Return the colours of some galaxies, given as a bool mask of shape (n,) or as row numbers."""
        return Colour(self.sequence[keep], self.colour[keep], self.deviate[keep])


def model() -> Colours:
    """Return the built-in parameters of the distributions of colours and dust."""
    return Colours(
        RedFraction(**parameters.section(_FILE, "red_fraction")),
        Green(**parameters.section(_FILE, "green")),
        ColourSequence(**parameters.section(_FILE, "sequence")),
        Dust(**parameters.section(_FILE, "dust")),
    )


def colour_limits(table: BandRatios, dust: Dust) -> ColourLimits:
    """Return the range of colours of a library of templates.

    `table` is the library's table of the passband 0.1g. The limits are tabulated for E(B-V) from 0 to the largest value
    that the dust model `dust` allows.
    """
    ebv = np.linspace(0.0, dust.highest, _EBV_NODES)
    ln_ratio = table.values[0].astype(np.float64)
    bare = -2.5 / np.log(10.0) * ln_ratio[0, :, 0]
    bluest_dusty = -2.5 / np.log(10.0) * matrices.matmul(ln_ratio[:, -1, :], ebv_weights(table.ebv, ebv).T)
    return ColourLimits(float(bare[-1]), float(bare[0]), ebv, np.maximum.accumulate(bluest_dusty, axis=1))


def red_fraction(law: RedFraction, m_r: Float, z: Float, satellite: Float | Int) -> Float:
    """Return the fraction of galaxies on the red sequence.

    Parameters
    ----------
    law : RedFraction
        Parameters of the relation.
    m_r : float array, shape (n,)
        Absolute magnitude in 0.1r (SDSS r blueshifted to z = 0.1) for h = 1, mag.
    z : float array, shape (n,)
        Redshift.
    satellite : float or int array, shape (n,)
        0 for central galaxies and 1 for satellites, or the fraction of satellites at this luminosity.

    Returns
    -------
    float array, shape (n,)
        Fraction, 0 to 1.

    References
    ----------
    Skibba & Sheth 2009
    """
    bright = np.clip(1.0 - (law.blue + law.blue_rate * (m_r - _PIVOT)), *law.limits)
    times = law.times[0] + (law.times[1] - law.times[0]) * satellite
    evolved = law.z_norm - law.z_rate * z * (1.0 + law.z_bright * (m_r - law.z_pivot))
    shares = bright * times * np.clip(evolved, *law.z_limits) * _dwarf_factor(law, m_r)
    return np.asarray(np.minimum(shares, law.highest))


def green_share(law: Green, fraction: RedFraction, m_r: Float, z: Float) -> Float:
    """Return the fraction of green (dusty) galaxies among the galaxies that are not red.

    Parameters
    ----------
    law : Green
        Parameters of the green galaxies.
    fraction : RedFraction
        Parameters of the red fraction.
    m_r : float array, shape (n,)
        Absolute 0.1r magnitude for h = 1, mag.
    z : float array, shape (n,)
        Redshift.

    Returns
    -------
    float array, shape (n,)
        Fraction, 0 to 1.
    """
    bright = np.clip(1.0 - (fraction.blue + fraction.blue_rate * (m_r - _PIVOT)), *fraction.limits)
    old = bright * np.clip(law.z_norm - law.z_rate * z, law.z_floor, 1.0) * _dwarf_factor(fraction, m_r)
    red = red_fraction(fraction, m_r, z, np.zeros(m_r.size))
    ramp = np.clip((law.z_ramp[1] - z) / (law.z_ramp[1] - law.z_ramp[0]), 0.0, 1.0)
    share = np.clip(law.excess * np.maximum(old - red, 0.0) + law.usual * ramp, 0.0, law.max_share)
    return np.asarray(np.minimum(share / (1.0 - red), 1.0))


def draw(colours: Colours, limits: ColourLimits, m_r: Float, z: Float, odds: Float, rng: AnyGenerator) -> Colour:
    """Draw the sequence (red, green or blue) and the colour of galaxies.

    Parameters
    ----------
    colours : Colours
        Parameters of the distributions.
    limits : ColourLimits
        Range of the colours of the templates.
    m_r : float array, shape (n,)
        Absolute 0.1r magnitude for h = 1, mag.
    z : float array, shape (n,)
        Redshift.
    odds : float array, shape (n,)
        Probability of a galaxy to be red.
    rng : AnyGenerator
        Random numbers: first the numbers that select the sequence, then those of the colour.

    Returns
    -------
    Colour
        Sequence and colour of each galaxy.
    """
    law, chosen, uniform = colours.sequence, rng.random(z.size), _open_uniform(rng, z.size)
    # `chosen` selects the sequence: red below `odds`, green between `odds` and `green`, blue above.
    green = odds + (1.0 - odds) * green_share(colours.green, colours.fraction, m_r, z)
    sequence = np.where(chosen < odds, RED, np.where(chosen < green, GREEN, BLUE))
    mean, scatter = _mean_and_scatter(colours, m_r, z, sequence)
    low = limits.bluest + law.inside[0]
    min_colour = np.where(sequence == RED, max(law.red_least, low), low)
    max_colour = limits.reddest - law.inside[1]
    colour = mean + scatter * truncated_normal((min_colour - mean) / scatter, (max_colour - mean) / scatter, uniform)
    return Colour(sequence, np.clip(colour, min_colour, max_colour), scipy.special.ndtri(uniform))


def place_on_sequence(colours: Colours, m_r: Float, z: Float, colour: Float, red: Bool) -> Colour:
    """Return how far the given colours of galaxies are from the mean of the red or blue sequence.

    Parameters
    ----------
    colours : Colours
        Parameters of the distributions.
    m_r : float array, shape (n,)
        Absolute 0.1r magnitude for h = 1, mag.
    z : float array, shape (n,)
        Redshift.
    colour : float array, shape (n,)
        Rest-frame 0.1(g - r), mag.
    red : bool array, shape (n,)
        True for galaxies on the red sequence; all other galaxies are on the blue sequence.

    Returns
    -------
    Colour
        The colours with their sequence, and the difference from its mean in units of its scatter, limited to -3 to 3.
    """
    sequence = np.where(red, RED, BLUE)
    mean, scatter = _mean_and_scatter(colours, m_r, z, sequence)
    return Colour(sequence, colour, np.clip((colour - mean) / scatter, -_MAX_DEVIATE, _MAX_DEVIATE))


def _mean_and_scatter(colours: Colours, m_r: Float, z: Float, sequence: Int) -> tuple[Float, Float]:
    """Return the mean and the scatter (mag) of 0.1(g - r) on the sequence of each galaxy, at its M_r and redshift."""
    law, x = colours.sequence, m_r - _PIVOT
    red_mean = law.red + law.red_rate * x - law.red_z_rate * z
    blue_mean = np.clip(law.blue + law.blue_rate * x, *law.blue_limits)
    blue_mean = blue_mean - law.blue_z_rate * np.clip(z - law.z_first, 0.0, law.z_range)
    blue_mean = blue_mean - law.far_z_rate * np.clip(z - law.far_z, 0.0, law.far_z_range)
    red_scatter = np.clip(law.red_scatter + law.red_scatter_rate * x, *law.red_scatter_limits)
    blue_scatter = np.clip(law.blue_scatter + law.blue_scatter_rate * x, *law.blue_scatter_limits)
    green = 0.5 * (red_mean + blue_mean) + colours.green.offset
    mean = np.where(sequence == RED, red_mean, np.where(sequence == GREEN, green, blue_mean))
    return mean, np.where(
        sequence == RED, red_scatter, np.where(sequence == GREEN, colours.green.scatter, blue_scatter)
    )


def truncated_normal(low: Float, high: Float, uniform: Float) -> Float:
    """Convert uniform random numbers to standard normal deviates between two limits, by inversion.

    Parameters
    ----------
    low, high : float array, shape (n,)
        Limits, in standard deviations.
    uniform : float array, shape (n,)
        Numbers in (0, 1); larger numbers give larger deviates.

    Returns
    -------
    float array, shape (n,)
        Deviates. If both limits are positive, the lower tail is used and mirrored, which is more precise.
    """
    mirrored = low > 0.0
    a, b = np.where(mirrored, -high, low), np.where(mirrored, -low, high)
    below, above = scipy.special.ndtr(a), scipy.special.ndtr(b)
    u = np.where(mirrored, 1.0 - uniform, uniform)
    # Limit the probability to avoid infinite deviates. If both limits are 30 standard deviations away from 0, the
    # result is about the nearer limit.
    deviate = scipy.special.ndtri(np.clip(below + u * (above - below), 1e-300, 1.0 - 1e-16))
    return np.asarray(np.where(mirrored, -deviate, deviate))


def draw_dust(
    colours: Colours, limits: ColourLimits, m_r: Float, z: Float, colour: Colour, rng: AnyGenerator
) -> tuple[Int, Float]:
    """Draw extinction law and E(B-V) of the dust inside galaxies; red galaxies have no dust.

    Parameters
    ----------
    colours : Colours
        Parameters of the extinction laws and of the distribution of E(B-V).
    limits : ColourLimits
        Range of the colours of the templates.
    m_r : float array, shape (n,)
        Absolute 0.1r magnitude for h = 1, mag.
    z : float array, shape (n,)
        Redshift.
    colour : Colour
        Sequence and colour of the galaxies.
    rng : AnyGenerator
        Random numbers: first the numbers of E(B-V), then those of the law.

    Returns
    -------
    law : int array, shape (n,)
        Extinction law: 0 without dust, 1 for Prevot, 2 to 4 for Calzetti with a 2175 A bump of increasing strength.
    ebv : float array, shape (n,)
        E(B-V), mag.

    References
    ----------
    Ilbert et al. 2009
    """
    law = colours.dust
    amount, odds = rng.random(z.size), np.cumsum(law.calzetti_odds)
    calzetti = CALZETTI + np.searchsorted(odds[:-1], rng.random(z.size) * odds[-1], side="right")
    curve = np.where(colour.colour > np.interp(z, law.prevot_z, law.prevot_colour), PREVOT, calzetti)
    green = colour.sequence == GREEN
    curve = np.where(green, CALZETTI, curve)
    mean = np.clip(law.mean + law.mean_rate * (m_r - law.pivot), *law.mean_limits)
    mean = mean * (1.0 - law.far_z_rate * np.clip(z - law.far_z, 0.0, law.far_z_range))
    scale = np.where(green, colours.green.ebv, mean) / law.shape
    # Limit E(B-V) so that the bluest template behind the dust is at least as blue as the drawn colour.
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
    """Return `n` uniform random numbers in (0, 1); a 0, which the generator may return, is replaced by 2^-54."""
    return np.maximum(rng.random(n), 2.0**-54)


def _gamma_table(shape: float) -> Float:
    """Return the cumulative Gamma distribution with this shape and scale 1 at `_GAMMA_NODES`."""
    return np.asarray(scipy.special.gammainc(shape, _GAMMA_NODES))


def _dwarf_factor(law: RedFraction, m_r: Float) -> Float:
    return np.asarray(10.0 ** (-law.dwarf_rate * np.maximum(m_r - law.dwarf, 0.0)))
