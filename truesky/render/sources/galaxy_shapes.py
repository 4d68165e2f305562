"""Convert rows of the table `galaxies` to gravitationally lensed light profiles (Sersic bulge and inclined disc).

Positions on the sky are (u, v) in arcsec as in galsim: u to the west and v to the north. An axis with the position
angle PA (from north through east) has the angle 90 deg + PA from u towards v.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
import scipy

from lake_schema.arrays import Float, Int
from lake_schema.tables.galaxies import DISK_SCALE_HEIGHT
from truesky.numerics import matrices
from truesky.render.sources import sersic
from truesky.request.schema import MAX_SHEAR

if TYPE_CHECKING:
    # Imported in the functions that use it, because its import takes half a second.
    import galsim

# Half-light radius of a face-on exponential disc in scale lengths, the solution of (1 + x) exp(-x) = 1/2.
EXPONENTIAL_RADIUS = 1.6783469900166605
# Lower limit of the inverse magnification by lensing, so that the magnification is at most 1000. It is reached near
# critical lines, where no image is an ellipse.
_MIN_DETERMINANT = 1e-3
# Smallest axis ratio of a bulge; a thinner ellipse would be a line without area.
_SLIMMEST = 1e-4
# Smallest Sersic index n for which b_n is computed from a series; below, it is computed from an inverse gamma function.
# The profile is exp(-b_n (r / r_e)^(1/n)), where r is the radius and r_e the half-light radius.
_SERIES = 0.8
# Step of the variable t for integrals of a galaxy's light along a line at the distance d from its middle. The points on
# the line are at d cosh(t) from the middle.
_LINE_STEP = 0.35
# Number of values of the variable t, from 0 in steps of `_LINE_STEP`, for integrals of a galaxy's light along a line.
_LINE_NODES = 12
# A bulge or disc with a smaller area than this, in square pixels, has no light in `real_space_profile`, because its
# light far from the middle is negligible.
_NO_AREA = 1e-8


# Columns of the table `galaxies` from which shapes are computed.
COLUMNS = (
    "bulge_half_light_radius",
    "disk_half_light_radius",
    "bulge_fraction",
    "bulge_sersic_index",
    "bulge_axis_ratio",
    "inclination",
    "position_angle",
    "kappa",
    "gamma1",
    "gamma2",
)


@dataclass(frozen=True, slots=True)
class Shapes:
    """Shapes of n galaxies with bulge and disc, as arrays of shape (n,); its length is n.

    Attributes
    ----------
    bulge_radius, disk_radius : float array
        Half-light semi-major axes of bulge and disc before lensing, arcsec.
    bulge_fraction : float array
        Fraction of the light in the bulge, 0 to 1.
    sersic_index : float array
        Sersic index of the bulge.
    bulge_axis_ratio : float array
        Axis ratio of the bulge, minor to major.
    inclination : float array
        Inclination of the disc in degrees; 0 is face-on.
    beta : float array
        Angle of the major axis of both bulge and disc in radians, from west (u) towards north (v).
    g1, g2 : float array
        Reduced shear. Positive g1 stretches images along west (u), positive g2 along north-west (45 deg from u to v).
    magnification : float array
        Magnification by lensing, positive. It affects sizes only, since catalogue fluxes already include it.
    """

    bulge_radius: Float
    disk_radius: Float
    bulge_fraction: Float
    sersic_index: Float
    bulge_axis_ratio: Float
    inclination: Float
    beta: Float
    g1: Float
    g2: Float
    magnification: Float

    def __len__(self) -> int:
        return len(self.beta)

    def take(self, chosen: Int) -> Shapes:
        """Return the galaxies with the indices `chosen`, in the order of the indices."""
        return Shapes(*(getattr(self, field.name)[chosen] for field in fields(self)))


def shapes(galaxies: pa.Table) -> Shapes:
    """Convert rows of the table `galaxies` to shapes, one per row.

    Notes
    -----
    The shear gamma and the convergence kappa are columns of the table. The reduced shear is g = gamma / (1 - kappa), at
    most 0.9 in absolute value. The magnification is mu = 1 / |(1 - kappa)^2 - gamma^2|, at most 1000. Sersic indices of
    bulges outside 0.3 to 6.2 and axis ratios of bulges outside 1e-4 to 1 are set to the nearest limit.
    """
    columns = {name: np.asarray(galaxies[name].to_numpy(), float) for name in COLUMNS}
    stretch = 1.0 - columns["kappa"]
    gamma = np.hypot(columns["gamma1"], columns["gamma2"])
    determinant = np.maximum(np.abs((stretch - gamma) * (stretch + gamma)), _MIN_DETERMINANT)
    with np.errstate(divide="ignore", invalid="ignore"):
        reduced = np.where(gamma > 0, np.minimum(1.0, MAX_SHEAR * np.abs(stretch) / gamma) / stretch, 0.0)
    return Shapes(
        bulge_radius=columns["bulge_half_light_radius"],
        disk_radius=columns["disk_half_light_radius"],
        bulge_fraction=columns["bulge_fraction"],
        sersic_index=np.clip(columns["bulge_sersic_index"], sersic.INDEX_LO, sersic.INDEX_HI),
        bulge_axis_ratio=np.clip(columns["bulge_axis_ratio"], _SLIMMEST, 1.0),
        inclination=columns["inclination"],
        beta=np.radians(90.0 + columns["position_angle"]),
        g1=np.nan_to_num(columns["gamma1"] * reduced),
        # Change the sign: positive gamma2 stretches images along north-east, but positive g2 along north-west.
        g2=np.nan_to_num(-columns["gamma2"] * reduced),
        magnification=1.0 / determinant,
    )


@dataclass(frozen=True, slots=True)
class Forms:
    """Sizes and orientations of n lensed galaxies in pixels, in the form in which their Fourier transforms need them.

    Attributes
    ----------
    bulge, disk : float array, shape (n, 2, 2)
        Lensed vectors (columns of each matrix) along the major and minor axis of bulge and disc in pixels. Before
        lensing, their lengths are the half-light radius of the bulge, or the scale length of the disc, foreshortened
        along the minor axis. For a wave vector k in radian / pixel, the profile is round in k @ matrix.
    thick : float array, shape (n, 2)
        Vector along the minor axis in pixels that describes the thickness of an inclined disc: its product with k is
        q = (pi / 2) (h / r) sin(inclination) k r, for scale height h, scale length r and k along the minor axis.
    """

    bulge: Float
    disk: Float
    thick: Float


def forms(shape: Shapes, jacobian: Float) -> Forms:
    """Return sizes and orientations in pixels for n lensed galaxies.

    `jacobian`, shape (n, 2, 2), has the arcsec to the west and north (rows) for a step of one column and one row
    (columns) at each galaxy.

    Notes
    -----
    An inclined disc with the density profile sech^2(z / h), at a height z above its plane and with the scale height h,
    has the Fourier transform (1 + k_p^2)^-3/2 q / sinh q. For a wave vector k in radian / pixel, k_p is the length of
    `k @ disk`, and q is `k @ thick`.

    References
    ----------
    van der Kruit & Searle 1981 (the disc); galsim.InclinedExponential.
    """
    cos_beta, sin_beta = np.cos(shape.beta), np.sin(shape.beta)
    turn = _matrices(cos_beta, -sin_beta, sin_beta, cos_beta)
    scale = np.sqrt(shape.magnification / ((1 - shape.g1) * (1 + shape.g1) - shape.g2**2))
    lens = _matrices(1 + shape.g1, shape.g2, shape.g2, 1 - shape.g1) * scale[:, None, None]
    to_pixels = matrices.matmul(matrices.matmul(matrices.inverse(jacobian), lens), turn)
    ones = np.ones(len(shape))
    bulge = to_pixels * (shape.bulge_radius[:, None] * np.stack([ones, shape.bulge_axis_ratio], 1))[:, None]
    disk = to_pixels * (shape.disk_radius / EXPONENTIAL_RADIUS)[:, None, None]
    inclination = np.radians(shape.inclination)
    projected_disk = disk * np.stack([ones, np.cos(inclination)], 1)[:, None]
    thick = disk[:, :, 1] * (0.5 * np.pi * DISK_SCALE_HEIGHT * np.sin(inclination))[:, None]
    return Forms(bulge, projected_disk, thick)


def _matrices(a: Float, b: Float, c: Float, d: Float) -> Float:
    return np.stack([np.stack([a, b], -1), np.stack([c, d], -1)], -2)


def profile(shape: Shapes, i: int, smallest: float) -> galsim.GSObject:
    """Return the lensed light profile of one galaxy as a galsim object with flux 1.

    Parameters
    ----------
    shape : Shapes
        Shapes of galaxies.
    i : int
        Index of the galaxy in `shape`.
    smallest : float
        Half-light radius in arcsec below which the bulge or the disc is a point source.

    Returns
    -------
    galsim.GSObject
        The profile in arcsec, with u to the west and v to the north.
    """
    import galsim

    fraction = float(shape.bulge_fraction[i])
    parts = []
    if fraction > 0:
        parts.append(fraction * _bulge(shape, i, smallest))
    if fraction < 1:
        parts.append((1 - fraction) * _disk(shape, i, smallest))
    body = parts[0] if len(parts) == 1 else galsim.Sum(parts)
    turned = body.rotate(float(shape.beta[i]) * galsim.radians)
    lensed = turned.lens(float(shape.g1[i]), float(shape.g2[i]), float(shape.magnification[i]))
    return lensed.withFlux(1.0)


def _bulge(shape: Shapes, i: int, smallest: float) -> galsim.GSObject:
    import galsim

    # The shear of galsim preserves the area. Begin with a circle whose radius is the geometric mean of the axes.
    q = float(shape.bulge_axis_ratio[i])
    radius = float(shape.bulge_radius[i]) * np.sqrt(q)
    if radius < smallest:
        return galsim.DeltaFunction()
    round_one = _sersic(float(shape.sersic_index[i])).dilate(radius)
    return round_one.shear(q=q, beta=0.0 * galsim.radians)


@lru_cache(maxsize=256)
def _sersic(index: float) -> galsim.Sersic:
    import galsim

    return galsim.Sersic(index, half_light_radius=1.0)


def _disk(shape: Shapes, i: int, smallest: float) -> galsim.GSObject:
    import galsim

    radius = float(shape.disk_radius[i])
    if radius < smallest:
        return galsim.DeltaFunction()
    return galsim.InclinedExponential(
        float(shape.inclination[i]) * galsim.degrees, half_light_radius=radius, scale_h_over_r=DISK_SCALE_HEIGHT
    )


def surface_brightness(shape: Shapes, radius: Float) -> Float:
    """Return the surface brightness of galaxies along their major axis, an upper limit for all other directions.

    Parameters
    ----------
    shape : Shapes
        Shapes of n galaxies.
    radius : float array, shape (m,)
        Distances from the middle in arcsec.

    Returns
    -------
    float array, shape (n, m)
        Surface brightness after lensing, as a fraction of the galaxy's flux per arcsec^2.
    """
    stretch = _lensed_stretch(shape)
    area = 1.0 / shape.magnification
    bulge = shape.bulge_fraction * area / shape.bulge_axis_ratio
    disk = (1 - shape.bulge_fraction) * area / _apparent_axis_ratio(shape)
    return np.asarray(
        bulge[:, None] * _sersic_surface(radius, shape.bulge_radius * stretch, shape.sersic_index, stretch)
        + disk[:, None] * _sersic_surface(radius, shape.disk_radius * stretch, np.ones(len(shape)), stretch)
    )


def line_brightness(shape: Shapes, distance: float) -> Float:
    """Return the light of each galaxy integrated along a straight line at a given distance from its middle.

    The line is parallel to the minor axis, and the result is an upper limit for lines of all other directions.

    Parameters
    ----------
    shape : Shapes
        Shapes of n galaxies.
    distance : float
        Distance of the line from the middle in arcsec, positive.

    Returns
    -------
    float array, shape (n,)
        Light as a fraction of the galaxy's flux per arcsec across the line, with an error of 1 %.
    """
    t = _LINE_STEP * np.arange(_LINE_NODES)
    radius, stretch = distance * np.cosh(t), _lensed_stretch(shape)
    # Weights of the trapezoidal rule in t for both halves of the line. The position along the line is x = distance
    # sinh(t), and the distance from the galaxy's middle is radius = distance cosh(t), so that dx = radius dt.
    weights = 2.0 * _LINE_STEP * radius
    weights[0] *= 0.5
    ones, parts = np.ones(len(shape)), ((shape.bulge_radius, shape.sersic_index), (shape.disk_radius, None))
    bulge, disk = (
        matrices.matmul(_sersic_surface(radius, size * stretch, ones if n is None else n, ones), weights)
        for size, n in parts
    )
    return np.asarray(shape.bulge_fraction * bulge + (1 - shape.bulge_fraction) * disk)


def flux_outside(shape: Shapes, radius: Float) -> Float:
    """Return the fraction of a galaxy's flux outside ellipses with the shapes of its bulge and its disc.

    It is an upper limit for the flux outside the circle with the same radius.

    Parameters
    ----------
    shape : Shapes
        Shapes of n galaxies.
    radius : float array, shape (n,)
        Semi-major axis of the ellipses in arcsec, after lensing.

    Returns
    -------
    float array, shape (n,)
        Fractions of the flux, 0 to 1.
    """
    stretch, n = _lensed_stretch(shape), shape.sersic_index
    bulge_radius, disk_radius = (np.maximum(r * stretch, 1e-6) for r in (shape.bulge_radius, shape.disk_radius))
    bulge = scipy.special.gammaincc(2 * n, _b(n) * (radius / bulge_radius) ** (1 / n))
    lengths = radius / disk_radius * EXPONENTIAL_RADIUS
    disk = (1 + lengths) * np.exp(-lengths)
    return np.asarray(shape.bulge_fraction * bulge + (1 - shape.bulge_fraction) * disk)


def real_space_profile(shape: Shapes, form: Forms) -> Float:
    """Return the parameters from which drawing/kernels/frame.py computes the light of a galaxy at any pixel.

    Parameters
    ----------
    shape : Shapes
        Shapes of n galaxies.
    form : Forms
        Sizes and orientations of these galaxies in pixels.

    Returns
    -------
    float array, shape (n, 11)
        Columns 0 and 1: light in the middle of the bulge and of the disc per square pixel, for a galaxy of flux 1.
        Columns 2 to 5: matrix of the bulge, row by row; column 6: its exponent p. Columns 7 to 10: matrix of the disc.

    Notes
    -----
    The matrices convert offsets (x, y) from the galaxy's middle in pixels to coordinates (s, t) without unit in which
    bulge or disc is round. The light of the bulge is proportional to exp(-(s^2 + t^2)^p), with p = 1 / (2 n) for the
    Sersic index n, and that of the disc to exp(-sqrt(s^2 + t^2)). The disc is treated as thin, with its apparent axis
    ratio. A bulge or disc with almost no area has no light.
    """
    n, b = shape.sersic_index, _b(shape.sersic_index)
    # Apparent minor axis of the disc: foreshortened radius and scale height are added in quadrature.
    across = form.disk[:, :, 1], form.thick * (2 / np.pi)
    disk = np.stack([form.disk[:, :, 0], np.copysign(np.hypot(*across), across[0] + across[1])], -1)
    areas = [
        np.abs(matrix[:, 0, 0] * matrix[:, 1, 1] - matrix[:, 0, 1] * matrix[:, 1, 0]) for matrix in (form.bulge, disk)
    ]
    has_area = [area > _NO_AREA for area in areas]
    areas = [np.where(valid, area, 1.0) for valid, area in zip(has_area, areas, strict=True)]
    middles = (
        shape.bulge_fraction
        * np.exp(2 * n * np.log(b) - np.log(2 * np.pi * n) - scipy.special.gammaln(2 * n))
        / areas[0],
        (1 - shape.bulge_fraction) / (2 * np.pi) / areas[1],
    )
    inverse = [
        matrices.inverse(np.where(valid[:, None, None], m, np.eye(2)))
        for valid, m in zip(has_area, (form.bulge, disk), strict=True)
    ]
    return np.column_stack(
        [
            *(np.where(valid, middle, 0.0) for valid, middle in zip(has_area, middles, strict=True)),
            (inverse[0] * (b**n)[:, None, None]).reshape(-1, 4),
            0.5 / n,
            inverse[1].reshape(-1, 4),
        ]
    )


def half_light(shape: Shapes) -> Float:
    """Return the half-light semi-major axis of galaxies after lensing in arcsec, shape (n,).

    It is approximated by the mean of the half-light radii of bulge and disc, weighted by their light. Lensing is
    assumed to stretch the galaxy along its major axis.
    """
    fraction = shape.bulge_fraction
    return _lensed_stretch(shape) * (fraction * shape.bulge_radius + (1 - fraction) * shape.disk_radius)


def _lensed_stretch(shape: Shapes) -> Float:
    """Return the factor by which lensing stretches galaxies along the direction of the largest stretch."""
    g = np.hypot(shape.g1, shape.g2)
    return np.asarray(np.sqrt(shape.magnification * (1 + g) / (1 - g)))


def _apparent_axis_ratio(shape: Shapes) -> Float:
    cosine = np.cos(np.radians(shape.inclination))
    return np.asarray(np.hypot(cosine, DISK_SCALE_HEIGHT))


def _b(index: Float) -> Float:
    """Return the constant b_n of Sersic profiles for arrays of the index n, with an error of 3e-5.

    References
    ----------
    Ciotti & Bertin 1999, eq. 18, which has an error of 1 % at the lowest index.
    """
    out = np.asarray(2 * index - 1 / 3 + 4 / (405 * index) + 46 / (25515 * index**2))
    low = index < _SERIES
    out[low] = scipy.special.gammaincinv(2 * index[low], 0.5)
    return out


def _sersic_surface(radius: Float, half_light: Float, index: Float, stretch: Float) -> Float:
    """Return the unlensed surface brightness of round Sersic profiles of flux 1 at lensed radii, shape (n, m).

    It is the flux per arcsec^2 before lensing. `radius`, shape (m,), is where it is computed, and `half_light`, shape
    (n,), is the half-light radius; both are in arcsec after lensing. `stretch` is the factor by which lensing has
    enlarged `half_light`, and `index` is the Sersic index, shape (n,).
    """
    r_e = np.maximum(half_light, 1e-6)[:, None]
    n, b = index[:, None], _b(index)[:, None]
    log_norm = (
        np.log(2 * np.pi * n) - 2 * n * np.log(b) + scipy.special.gammaln(2 * n) + 2 * np.log(r_e / stretch[:, None])
    )
    return np.asarray(np.exp(-b * (radius[None, :] / r_e) ** (1 / n) - log_norm))
