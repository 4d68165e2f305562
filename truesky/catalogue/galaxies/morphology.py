"""Sizes and shapes of galaxies: a Sersic bulge and an inclined exponential disc with one position angle.

half_light_radius   of the total light, from redshift, stellar mass and type
bulge_fraction, sersic_index, radius_ratio, bulge_colour   of the bulge
component_radii     the two half-light radii whose sum of light has the total's
disc_axis_ratio, bulge_axis_ratio, inclination, position_angle

All radii are semi-major axes. `red` marks galaxies of the red sequence: they take the laws of early types.
Ref: Serrano et al. 2024, "Bulge and disc model"; the numbers and their sources are in morphology.toml.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt
from scipy.special import gammainc, gammaincinv, ndtr, ndtri

from lake_schema.arrays import Bool, Float
from lake_schema.tables.galaxies import DISK_SCALE_HEIGHT
from truesky.catalogue import parameters
from truesky.randomness.per_source import AnyGenerator


@dataclass(frozen=True, slots=True)
class Size:
    """Half-light radius against stellar mass (morphology.toml, [size])."""

    z: tuple[float, ...]
    late_norm: tuple[float, ...]
    late_slope: tuple[float, ...]
    late_scatter: tuple[float, ...]
    early_norm: tuple[float, ...]
    early_slope: tuple[float, ...]
    early_scatter: tuple[float, ...]
    pivot: float
    knee: float
    knee_slope: float
    smallest: float
    largest: float


@dataclass(frozen=True, slots=True)
class Bulge:
    """Distributions of the bulge's parameters (morphology.toml, [bulge])."""

    early_a: float
    early_b: float
    late_mean: float
    late_rate: float
    late_pivot: float
    late_limits: tuple[float, float]
    late_concentration: float
    early_sersic: float
    late_sersic: float
    sersic_scatter: float
    sersic_limits: tuple[float, float]
    early_log_ratio: float
    late_log_ratio: float
    log_ratio_scatter: float
    ratio_limits: tuple[float, float]
    axis_ratio_mean: float
    axis_ratio_scatter: float
    axis_ratio_limits: tuple[float, float]
    colour_mean: float
    colour_scatter: float
    colour_limits: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Shapes:
    """Everything that morphology draws from, made once by `shapes`.

    disc_e, disc_cdf : [m] ellipticity of discs and its cumulative distribution
    fraction, ln_ratio, ln_sersic : axes of ln_disc, ln of (disc radius / total radius)
    """

    size: Size
    bulge: Bulge
    scale_height: float
    disc_e: Float
    disc_cdf: Float
    fraction: Float
    ln_ratio: Float
    ln_sersic: Float
    ln_disc: Float


@cache
def shapes() -> Shapes:
    """The morphology of the embedded universe: numbers read, tables made (0.2 s), once."""
    bulge = Bulge(**parameters.section("morphology.toml", "bulge"))
    e, cdf = _disc_distribution(**parameters.section("morphology.toml", "disc"))
    fraction = np.linspace(0.0, 1.0, _FRACTION_NODES)
    ln_ratio = _log_nodes(bulge.ratio_limits, _RATIO_NODES)
    ln_sersic = _log_nodes(bulge.sersic_limits, _SERSIC_NODES)
    grid = np.meshgrid(fraction, np.exp(ln_ratio), np.exp(ln_sersic), indexing="ij")
    return Shapes(
        size=Size(**parameters.section("morphology.toml", "size")),
        bulge=bulge,
        scale_height=DISK_SCALE_HEIGHT,
        disc_e=e,
        disc_cdf=cdf,
        fraction=fraction,
        ln_ratio=ln_ratio,
        ln_sersic=ln_sersic,
        ln_disc=np.log(disc_radius(*grid)),
    )


# Nodes of the radius table: bulge fraction, ratio of the radii, Sersic index.
_FRACTION_NODES, _RATIO_NODES, _SERSIC_NODES = 49, 25, 9
_BISECTIONS = 25


def _log_nodes(limits: tuple[float, float], number: int) -> Float:
    return np.linspace(np.log(limits[0]), np.log(limits[1]), number)


def half_light_radius(
    size: Size, z: Float, log_stellar_mass: Float, red: Bool, kpc_per_arcsec: Float, rng: AnyGenerator
) -> Float:
    """Half-light semi-major axis[n] of the total light, arcsec.

    z : float[n];  red : bool[n] on the red sequence
    log_stellar_mass : [n] log10 Msun (h = 0.67); kpc_per_arcsec : [n] proper
    size : constants of the relation;  rng : of the scatter about it
    Ref: van der Wel et al. 2014
    """
    log_mass = log_stellar_mass - np.log10(size.pivot)
    knee = np.log10(size.knee / size.pivot)
    early = _at_redshift(size, size.early_norm, z) + _at_redshift(size, size.early_slope, z) * np.maximum(
        log_mass, knee
    )
    early += size.knee_slope * np.minimum(log_mass - knee, 0.0)
    late = _at_redshift(size, size.late_norm, z) + _at_redshift(size, size.late_slope, z) * log_mass
    scatter = np.where(red, _at_redshift(size, size.early_scatter, z), _at_redshift(size, size.late_scatter, z))
    log_kpc = np.where(red, early, late) + scatter * rng.standard_normal(z.size)
    return np.asarray(np.clip(10.0**log_kpc / kpc_per_arcsec, size.smallest, size.largest))


def _at_redshift(size: Size, values: tuple[float, ...], z: Float) -> Float:
    return np.interp(z, size.z, values)


def bulge_fraction(bulge: Bulge, log_stellar_mass: Float, red: Bool, rng: AnyGenerator) -> Float:
    """Flux of the bulge / total, [n] in [0, 1].

    log_stellar_mass : float[n] log10 Msun;  red : bool[n]
    bulge            : constants of the relation;  rng : of the scatter about it
    """
    mean = np.clip(bulge.late_mean + bulge.late_rate * (log_stellar_mass - bulge.late_pivot), *bulge.late_limits)
    a = np.where(red, bulge.early_a, bulge.late_concentration * mean)
    b = np.where(red, bulge.early_b, bulge.late_concentration * (1.0 - mean))
    return rng.beta(a, b)


def sersic_index(bulge: Bulge, red: Bool, rng: AnyGenerator) -> Float:
    """Sersic index[n] of the bulge.

    red : bool[n] on the red sequence
    """
    log_n = np.log10(np.where(red, bulge.early_sersic, bulge.late_sersic))
    return np.clip(10.0 ** (log_n + bulge.sersic_scatter * rng.standard_normal(red.size)), *bulge.sersic_limits)


def radius_ratio(bulge: Bulge, red: Bool, rng: AnyGenerator) -> Float:
    """Half-light radius of the bulge / that of the disc, [n].

    red : bool[n] on the red sequence
    """
    log_ratio = np.where(red, bulge.early_log_ratio, bulge.late_log_ratio)
    return np.clip(10.0 ** (log_ratio + bulge.log_ratio_scatter * rng.standard_normal(red.size)), *bulge.ratio_limits)


def bulge_colour(bulge: Bulge, n: int, rng: AnyGenerator) -> Float:
    """0.1(g - r) of the bulge less that of the disc, [n] mag."""
    return np.asarray(np.clip(bulge.colour_mean + bulge.colour_scatter * rng.standard_normal(n), *bulge.colour_limits))


def component_radii(model: Shapes, radius: Float, fraction: Float, ratio: Float, sersic: Float) -> tuple[Float, Float]:
    """Half-light radii of bulge[n] and disc[n] whose summed light has the half-light radius `radius`[n].

    radius : float[n] arcsec, or any length, as what is returned
    fraction : bulge / total; ratio : bulge radius / disc radius; sersic : index of the bulge
    model    : light of profiles within radii, tabulated
    Error: the light within `radius` is 0.5 to 0.005 (tests/truesky/catalogue/galaxies/test_morphology.py)
    """
    # Slow to import, and not needed where a job is only submitted.
    from scipy.interpolate import RegularGridInterpolator

    axes = (model.fraction, model.ln_ratio, model.ln_sersic)
    # The last bit of a logarithm may put a limit just outside: no error, no fill.
    table = RegularGridInterpolator(axes, model.ln_disc, bounds_error=False, fill_value=None)
    disc = radius * np.exp(table(np.stack([fraction, np.log(ratio), np.log(sersic)], axis=-1)))
    return ratio * disc, disc


def light_within(r: npt.ArrayLike, half_light: npt.ArrayLike, sersic: npt.ArrayLike) -> Float:
    """Fraction of a Sersic profile's light within r.

    r, half_light : float[...] of the same unit;  sersic : float[...] index
    Ref: Graham & Driver 2005, PASA 22, 118
    """
    n = np.asarray(sersic, float)
    return _enclosed_light(np.asarray(r, float) / np.asarray(half_light, float), n, gammaincinv(2.0 * n, 0.5))


def _enclosed_light(x: Float, n: Float, b: Float) -> Float:
    return np.asarray(gammainc(2.0 * n, b * x ** (1.0 / n)))


def disc_radius(fraction: Float, ratio: Float, sersic: Float) -> Float:
    """Disc radius / total half-light radius by bisection: what `component_radii` tabulates.

    fraction, ratio, sersic : float[...] bulge / total, bulge radius / disc radius, index of the bulge
    """
    # The total's radius lies between those of its parts, so the disc's between 1 and 1 / ratio.
    low, high = np.minimum(1.0, 1.0 / ratio), np.maximum(1.0, 1.0 / ratio)
    disc_sersic = np.ones(1)
    b_bulge, b_disc = gammaincinv(2.0 * sersic, 0.5), gammaincinv(2.0 * disc_sersic, 0.5)
    for _ in range(_BISECTIONS):
        middle = np.sqrt(low * high)
        inside = fraction * _enclosed_light(1.0 / (ratio * middle), sersic, b_bulge)
        inside += (1.0 - fraction) * _enclosed_light(1.0 / middle, disc_sersic, b_disc)
        low, high = np.where(inside > 0.5, middle, low), np.where(inside > 0.5, high, middle)
    return np.asarray(np.sqrt(low * high))


def disc_axis_ratio(model: Shapes, n: int, rng: AnyGenerator) -> Float:
    """Apparent minor / major axis[n] of discs.  Ref: Miller et al. 2013"""
    e = np.interp(rng.random(n), model.disc_cdf, model.disc_e)
    return (1.0 - e) / (1.0 + e)


def bulge_axis_ratio(bulge: Bulge, n: int, rng: AnyGenerator) -> Float:
    """Minor / major axis[n] of bulges: a truncated normal, by its inverse."""
    limits = (np.array(bulge.axis_ratio_limits) - bulge.axis_ratio_mean) / bulge.axis_ratio_scatter
    low, high = ndtr(limits)
    q = bulge.axis_ratio_mean + bulge.axis_ratio_scatter * ndtri(low + (high - low) * rng.random(n))
    return np.asarray(np.clip(q, *bulge.axis_ratio_limits))


def inclination(axis_ratio: npt.ArrayLike, scale_height: float) -> Float:
    """Inclination[n] of discs, deg: sin^2 i = (1 - q^2) / (1 - h^2); 90 where it looks thinner than it is.

    The printed arcsine is not a number for q < h and loses half its digits near 90 deg; this form does
    neither.
    axis_ratio : float[n];  scale_height : h, of the disc's scale length
    Ref: Serrano et al. 2024, "Bulge and disc model"
    """
    q = np.asarray(axis_ratio, float)
    across = np.sqrt(np.maximum((1.0 - q) * (1.0 + q), 0.0))
    along = np.sqrt(np.maximum((q - scale_height) * (q + scale_height), 0.0))
    return np.degrees(np.arctan2(across, along))


def position_angle(n: int, rng: AnyGenerator) -> Float:
    """Position angle[n] of the major axis, deg in [0, 180)."""
    return 180.0 * rng.random(n)


def _disc_distribution(e_max: float, e_fall: float, e_core: float) -> tuple[Float, Float]:
    e = np.linspace(0.0, e_max, _E_NODES)
    p = -e * np.expm1((e - e_max) / e_fall) / ((1.0 + e) * np.hypot(e, e_core))
    cdf = np.concatenate([[0.0], np.cumsum(0.5 * (p[1:] + p[:-1]))])
    return e, cdf / cdf[-1]


_E_NODES = 2001
