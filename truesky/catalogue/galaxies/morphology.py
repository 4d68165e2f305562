"""Draw the sizes and shapes of galaxies: a Sersic bulge and an inclined exponential disc with the same position angle.

All radii are semi-major axes. Galaxies on the red sequence (`red` is True) follow the relations of early types, and all
other galaxies those of late types. The parameters and their sources are in morphology.toml.

References
----------
Serrano et al. 2024, "Bulge and disc model"
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import numpy.typing as npt
import scipy

from lake_schema.arrays import Bool, Float
from lake_schema.tables.galaxies import DISK_SCALE_HEIGHT
from truesky.catalogue import parameters
from truesky.randomness.per_source import AnyGenerator


@dataclass(frozen=True, slots=True)
class Size:
    """Parameters of the half-light radius by stellar mass and redshift; explained in morphology.toml, [size]."""

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
    compact_mass: tuple[float, ...]
    compact_share: tuple[float, ...]
    compact_z: tuple[float, float]
    smallest: float
    largest: float


@dataclass(frozen=True, slots=True)
class Bulge:
    """Parameters of the distributions of bulge fraction, radius and colour; see morphology.toml, [bulge]."""

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
    colour_mean: float
    colour_scatter: float
    colour_limits: tuple[float, float]


@dataclass(frozen=True, slots=True)
class BulgeShape:
    """Parameters of the axis ratios of triaxial bulges; explained in morphology.toml, [bulge_shape]."""

    thickness_mean: float
    thickness_scatter: float
    thickness_limits: tuple[float, float]
    elongation_log: float
    elongation_scatter: float
    most_elongated: float


@dataclass(frozen=True, slots=True, eq=False)
class Shapes:
    """Parameters and tables of the sizes and shapes of galaxies, made once by `shapes`.

    Attributes
    ----------
    size, bulge : Size, Bulge
        Parameters from morphology.toml.
    scale_height : float
        Scale height of discs in units of the scale length.
    disc_e, disc_cdf : float array, shape (m,)
        Apparent ellipticity (a - b) / (a + b) of discs, and the cumulative distribution at these values.
    bulge_ratio : float array, shape (k,)
        Apparent axis ratio of bulges at equidistant values of the cumulative distribution, from 0 to 1.
    fraction, ln_ratio, ln_sersic : float array, shape (f,), (r,), (s,)
        Axes of `ln_disc`: bulge fraction, ln(bulge radius / disc radius), ln of the bulge's Sersic index.
    ln_disc : float array, shape (f, r, s)
        ln(half-light radius of the disc / half-light radius of bulge and disc together).
    """

    size: Size
    bulge: Bulge
    scale_height: float
    disc_e: Float
    disc_cdf: Float
    bulge_ratio: Float
    fraction: Float
    ln_ratio: Float
    ln_sersic: Float
    ln_disc: Float


@cache
def shapes() -> Shapes:
    """Return the built-in parameters and tables of sizes and shapes.

    The first call in a process makes the tables in 0.3 s; later calls return the same object.
    """
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
        bulge_ratio=_bulge_quantiles(BulgeShape(**parameters.section("morphology.toml", "bulge_shape"))),
        fraction=fraction,
        ln_ratio=ln_ratio,
        ln_sersic=ln_sersic,
        ln_disc=np.log(disc_radius(*grid)),
    )


# Number of values on each axis of the table `ln_disc`: bulge fraction, bulge radius / disc radius, Sersic index.
_FRACTION_NODES, _RATIO_NODES, _SERSIC_NODES = 49, 25, 9
# Number of bisections in `disc_radius`.
_BISECTIONS = 25


def _log_nodes(limits: tuple[float, float], number: int) -> Float:
    return np.linspace(np.log(limits[0]), np.log(limits[1]), number)


def half_light_radius(
    size: Size, z: Float, log_stellar_mass: Float, red: Bool, kpc_per_arcsec: Float, rng: AnyGenerator
) -> Float:
    """Draw the half-light semi-major axis of the total light of bulge and disc.

    Parameters
    ----------
    size : Size
        Parameters of the relation between size and mass.
    z : float array, shape (n,)
        Redshift.
    log_stellar_mass : float array, shape (n,)
        log10 of the stellar mass, Msun (not Msun/h).
    red : bool array, shape (n,)
        True for galaxies on the red sequence.
    kpc_per_arcsec : float array, shape (n,)
        Proper length per angle at the redshift, kpc/arcsec.
    rng : AnyGenerator
        Random numbers: first those of the scatter, then those that select compact late types.

    Returns
    -------
    float array, shape (n,)
        Semi-major axis in arcsec, limited to `size.smallest` to `size.largest`.

    References
    ----------
    van der Wel et al. 2014
    """
    log_mass = log_stellar_mass - np.log10(size.pivot)
    knee = np.log10(size.knee / size.pivot)
    early = _at_redshift(size, size.early_norm, z) + _at_redshift(size, size.early_slope, z) * np.maximum(
        log_mass, knee
    )
    early += size.knee_slope * np.minimum(log_mass - knee, 0.0)
    late = _at_redshift(size, size.late_norm, z) + _at_redshift(size, size.late_slope, z) * log_mass
    normal = rng.standard_normal(z.size)
    small = red | (rng.random(z.size) < compact_share(size, z, log_stellar_mass))
    scatter = np.where(small, _at_redshift(size, size.early_scatter, z), _at_redshift(size, size.late_scatter, z))
    log_kpc = np.where(small, early, late) + scatter * normal
    return np.asarray(np.clip(10.0**log_kpc / kpc_per_arcsec, size.smallest, size.largest))


def compact_share(size: Size, z: Float, log_stellar_mass: Float) -> Float:
    """Return the share of late types that are as small as early types.

    Parameters
    ----------
    size : Size
        Parameters of sizes.
    z : float array, shape (n,)
        Redshifts.
    log_stellar_mass : float array, shape (n,)
        log10 of the stellar mass, Msun.

    Returns
    -------
    float array, shape (n,)
        Shares, 0 to 1.
    """
    start, end = size.compact_z
    ramp = np.clip((z - start) / (end - start), 0.0, 1.0)
    return np.asarray(np.interp(log_stellar_mass, size.compact_mass, size.compact_share) * ramp)


def _at_redshift(size: Size, values: tuple[float, ...], z: Float) -> Float:
    return np.interp(z, size.z, values)


def bulge_fraction(bulge: Bulge, log_stellar_mass: Float, red: Bool, rng: AnyGenerator) -> Float:
    """Draw the fraction of the rest-frame 0.1r flux that is in the bulge, from a beta distribution.

    Parameters
    ----------
    bulge : Bulge
        Parameters of the distribution.
    log_stellar_mass : float array, shape (n,)
        log10 of the stellar mass, Msun.
    red : bool array, shape (n,)
        True for galaxies on the red sequence.
    rng : AnyGenerator
        Random numbers.

    Returns
    -------
    float array, shape (n,)
        Fraction, 0 to 1.
    """
    mean = np.clip(bulge.late_mean + bulge.late_rate * (log_stellar_mass - bulge.late_pivot), *bulge.late_limits)
    a = np.where(red, bulge.early_a, bulge.late_concentration * mean)
    b = np.where(red, bulge.early_b, bulge.late_concentration * (1.0 - mean))
    return rng.beta(a, b)


def sersic_index(bulge: Bulge, red: Bool, rng: AnyGenerator) -> Float:
    """Draw the Sersic index of bulges.

    Parameters
    ----------
    bulge : Bulge
        Parameters of the distribution.
    red : bool array, shape (n,)
        True for galaxies on the red sequence.
    rng : AnyGenerator
        Random numbers.

    Returns
    -------
    float array, shape (n,)
        Sersic index, limited to `bulge.sersic_limits`.
    """
    log_n = np.log10(np.where(red, bulge.early_sersic, bulge.late_sersic))
    return np.clip(10.0 ** (log_n + bulge.sersic_scatter * rng.standard_normal(red.size)), *bulge.sersic_limits)


def radius_ratio(bulge: Bulge, red: Bool, rng: AnyGenerator) -> Float:
    """Draw the half-light radius of the bulge relative to the disc.

    Parameters
    ----------
    bulge : Bulge
        Parameters of the distribution.
    red : bool array, shape (n,)
        True for galaxies on the red sequence.
    rng : AnyGenerator
        Random numbers.

    Returns
    -------
    float array, shape (n,)
        Bulge radius / disc radius, limited to `bulge.ratio_limits`.
    """
    log_ratio = np.where(red, bulge.early_log_ratio, bulge.late_log_ratio)
    return np.clip(10.0 ** (log_ratio + bulge.log_ratio_scatter * rng.standard_normal(red.size)), *bulge.ratio_limits)


def bulge_colour(bulge: Bulge, n: int, rng: AnyGenerator) -> Float:
    """Draw the colour of the bulge relative to the disc.

    Parameters
    ----------
    bulge : Bulge
        Parameters of the distribution.
    n : int
        Number of galaxies.
    rng : AnyGenerator
        Random numbers.

    Returns
    -------
    float array, shape (n,)
        0.1(g - r) (rest-frame SDSS g - r in bands blueshifted to z = 0.1) of the bulge minus that of the disc, mag.
    """
    return np.asarray(np.clip(bulge.colour_mean + bulge.colour_scatter * rng.standard_normal(n), *bulge.colour_limits))


def component_radii(model: Shapes, radius: Float, fraction: Float, ratio: Float, sersic: Float) -> tuple[Float, Float]:
    """Return the half-light radii of bulge and disc whose summed light has a given half-light radius.

    Parameters
    ----------
    model : Shapes
        Tables of the radii.
    radius : float array, shape (n,)
        Half-light radius of bulge and disc together, in any unit; the result has the same unit.
    fraction : float array, shape (n,)
        Fraction of the flux in the bulge.
    ratio : float array, shape (n,)
        Bulge radius / disc radius.
    sersic : float array, shape (n,)
        Sersic index of the bulge.

    Returns
    -------
    bulge, disc : float array, shape (n,)
        Half-light radii.

    Notes
    -----
    The fraction of light within `radius` is 0.5 within an error of 0.005
    (tests/truesky/catalogue/galaxies/test_morphology.py).
    """
    # Import here, because scipy.interpolate is slow to import and not needed to submit a job.
    from scipy.interpolate import RegularGridInterpolator

    axes = (model.fraction, model.ln_ratio, model.ln_sersic)
    # Rounding of a logarithm may put a value slightly outside the table: extrapolate instead of raising an error.
    table = RegularGridInterpolator(axes, model.ln_disc, bounds_error=False, fill_value=None)
    disc = radius * np.exp(table(np.stack([fraction, np.log(ratio), np.log(sersic)], axis=-1)))
    return ratio * disc, disc


def light_within(r: npt.ArrayLike, half_light: npt.ArrayLike, sersic: npt.ArrayLike) -> Float:
    """Return the fraction of the light of a Sersic profile within a radius.

    Parameters
    ----------
    r : float array, any shape
        Radius.
    half_light : float array, any shape
        Half-light radius in the unit of `r`.
    sersic : float array, any shape
        Sersic index.

    Returns
    -------
    float array, broadcast shape of the arguments
        Fraction of the total light, 0 to 1.

    References
    ----------
    Graham & Driver 2005, PASA 22, 118
    """
    n = np.asarray(sersic, float)
    return _enclosed_light(
        np.asarray(r, float) / np.asarray(half_light, float), n, scipy.special.gammaincinv(2.0 * n, 0.5)
    )


def _enclosed_light(x: Float, n: Float, b: Float) -> Float:
    return np.asarray(scipy.special.gammainc(2.0 * n, b * x ** (1.0 / n)))


def disc_radius(fraction: Float, ratio: Float, sersic: Float) -> Float:
    """Compute the half-light radius of the disc relative to bulge and disc together, by bisection.

    Parameters
    ----------
    fraction : float array, shape (n,)
        Fraction of the flux in the bulge.
    ratio : float array, shape (n,)
        Bulge radius / disc radius.
    sersic : float array, shape (n,)
        Sersic index of the bulge.

    Returns
    -------
    float array, shape (n,)
        Half-light radius of the disc / half-light radius of bulge and disc together.
    """
    # The radius of bulge and disc together is between the two radii, so the result is between 1 and 1 / ratio.
    low, high = np.minimum(1.0, 1.0 / ratio), np.maximum(1.0, 1.0 / ratio)
    disc_sersic = np.ones(1)
    b_bulge, b_disc = scipy.special.gammaincinv(2.0 * sersic, 0.5), scipy.special.gammaincinv(2.0 * disc_sersic, 0.5)
    for _ in range(_BISECTIONS):
        middle = np.sqrt(low * high)
        inside = fraction * _enclosed_light(1.0 / (ratio * middle), sersic, b_bulge)
        inside += (1.0 - fraction) * _enclosed_light(1.0 / middle, disc_sersic, b_disc)
        low, high = np.where(inside > 0.5, middle, low), np.where(inside > 0.5, high, middle)
    return np.asarray(np.sqrt(low * high))


def disc_axis_ratio(model: Shapes, n: int, rng: AnyGenerator) -> Float:
    """Draw the apparent axis ratio (minor / major) of discs with random inclinations.

    Parameters
    ----------
    model : Shapes
        Distribution of the apparent ellipticity.
    n : int
        Number of galaxies.
    rng : AnyGenerator
        Random numbers.

    Returns
    -------
    float array, shape (n,)
        Axis ratio.

    References
    ----------
    Miller et al. 2013
    """
    e = np.interp(rng.random(n), model.disc_cdf, model.disc_e)
    return (1.0 - e) / (1.0 + e)


def bulge_axis_ratio(model: Shapes, n: int, rng: AnyGenerator) -> Float:
    """Draw the apparent axis ratio (minor / major) of triaxial bulges in random directions.

    Parameters
    ----------
    model : Shapes
        Distribution of the apparent axis ratio.
    n : int
        Number of galaxies.
    rng : AnyGenerator
        Random numbers, one per galaxy.

    Returns
    -------
    float array, shape (n,)
        Axis ratio.
    """
    return np.interp(rng.random(n), np.linspace(0.0, 1.0, model.bulge_ratio.size), model.bulge_ratio)


def project_ellipsoid(middle: Float, minor: Float, cosine: Float, azimuth: Float) -> Float:
    """Return the apparent axis ratio of ellipsoids with the major axis 1.

    Parameters
    ----------
    middle, minor : float array, any shape
        Middle and minor axis, 0 < minor <= middle <= 1.
    cosine : float array, any shape
        Cosine of the angle between the line of sight and the minor axis.
    azimuth : float array, any shape
        Angle of the line of sight around the minor axis, from the major axis, rad.

    Returns
    -------
    float array, broadcast shape of the arguments
        Minor / major axis of the projected ellipse.

    References
    ----------
    Binney 1985, MNRAS 212, 767
    """
    across, along = np.sin(azimuth) ** 2, np.cos(azimuth) ** 2
    a = (cosine / minor) ** 2 * (across + along / middle**2) + (1.0 - cosine**2) / middle**2
    b = cosine * np.sin(2.0 * azimuth) * (1.0 - 1.0 / middle**2) / minor**2
    c = (across / middle**2 + along) / minor**2
    difference = np.sqrt((a - c) ** 2 + b**2)
    return np.asarray(np.sqrt(np.maximum(a + c - difference, 0.0) / (a + c + difference)))


def inclination(axis_ratio: npt.ArrayLike, scale_height: float) -> Float:
    """Return the inclination of discs in deg, 0 (face-on) to 90, from the axis ratio and the scale height.

    The axis ratio q is minor / major, and the scale height h is in units of the scale length.

    Notes
    -----
    The inclination follows from::

        sin^2 i = (1 - q^2) / (1 - h^2)

    and is 90 deg if q < h. The published form with an arcsine is not defined for q < h, and near 90 deg rounding
    destroys half of its digits. The arctangent used here has neither problem.

    References
    ----------
    Serrano et al. 2024, "Bulge and disc model"
    """
    q = np.asarray(axis_ratio, float)
    across = np.sqrt(np.maximum((1.0 - q) * (1.0 + q), 0.0))
    along = np.sqrt(np.maximum((q - scale_height) * (q + scale_height), 0.0))
    return np.degrees(np.arctan2(across, along))


def position_angle(n: int, rng: AnyGenerator) -> Float:
    """Draw position angles of the major axis of `n` galaxies uniformly, deg in [0, 180)."""
    return 180.0 * rng.random(n)


def _disc_distribution(e_max: float, e_fall: float, e_core: float) -> tuple[Float, Float]:
    e = np.linspace(0.0, e_max, _E_NODES)
    p = -e * np.expm1((e - e_max) / e_fall) / ((1.0 + e) * np.hypot(e, e_core))
    cdf = np.concatenate([[0.0], np.cumsum(0.5 * (p[1:] + p[:-1]))])
    return e, cdf / cdf[-1]


def _bulge_quantiles(shape: BulgeShape) -> Float:
    """Return the apparent axis ratio of bulges at `_RATIO_QUANTILES` equidistant values of its cumulative distribution.

    All combinations of some axes and directions, which have equal probabilities, are projected and sorted.
    """
    low, high = scipy.special.ndtr((np.array(shape.thickness_limits) - shape.thickness_mean) / shape.thickness_scatter)
    thickness = scipy.special.ndtri(low + (high - low) * _middles(_THICKNESS_NODES))
    thickness = shape.thickness_mean + shape.thickness_scatter * thickness
    truncation = scipy.special.ndtr((np.log(shape.most_elongated) - shape.elongation_log) / shape.elongation_scatter)
    elongation = scipy.special.ndtri(truncation * _middles(_ELONGATION_NODES))
    elongation = np.exp(shape.elongation_log + shape.elongation_scatter * elongation)
    axes = thickness, 1.0 - elongation, _middles(_COSINE_NODES), 0.5 * np.pi * _middles(_AZIMUTH_NODES)
    thickness, middle, cosine, azimuth = np.meshgrid(*axes, indexing="ij")
    ratio = np.sort(project_ellipsoid(middle, thickness * middle, cosine, azimuth).ravel())
    return np.interp(np.linspace(0.0, 1.0, _RATIO_QUANTILES), _middles(ratio.size), ratio)


def _middles(number: int) -> Float:
    """Return the middles of `number` equal intervals from 0 to 1."""
    return (np.arange(number) + 0.5) / number


# Number of ellipticities at which the cumulative distribution of the discs' ellipticity is tabulated.
_E_NODES = 2001
# Number of axes and directions from which the apparent axis ratio of bulges is tabulated, and number of quantiles.
_THICKNESS_NODES, _ELONGATION_NODES, _COSINE_NODES, _AZIMUTH_NODES = 32, 32, 24, 16
_RATIO_QUANTILES = 1001
