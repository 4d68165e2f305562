"""Convert catalogue rows to lensed light profiles on the sky.

The world frame is that of galsim: u to the west, v to the north, in arcsec. An axis at the position angle PA (north
through east) lies at 90 deg + PA from u.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import lru_cache

import galsim
import numpy as np
import pyarrow as pa
from scipy.special import gammaincc, gammaincinv, gammaln

from lake_schema.arrays import Float, Int
from lake_schema.tables.galaxies import DISK_SCALE_HEIGHT
from truesky.numerics import matrices
from truesky.render.sources import sersic
from truesky.request.schema import MAX_SHEAR

# Half-light radius of a face-on exponential disc in scale lengths: (1 + x) exp(-x) = 1/2.
EXPONENTIAL_RADIUS = 1.6783469900166605
# Smallest inverse magnification near a critical line. Below it, or beyond MAX_SHEAR, the image is not an ellipse.
_MIN_DETERMINANT = 1e-3
# Smallest axis ratio; a thinner ellipse would be a line without area.
_SLIMMEST = 1e-4
# Smallest index for which Sersic's b_n is computed from its series.
_SERIES = 0.8
# Step and number of the nodes t for integrals along a line; the distance of a node is proportional to cosh t.
_LINE_STEP, _LINE_NODES = 0.35, 12
# Area, in square pixels, below which a component has negligible light outside any stamp.
_NO_AREA = 1e-8


# Columns of the galaxy catalogue.
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
    """Structure of n galaxies, as arrays [n].

    Attributes
    ----------
    bulge_radius, disk_radius : float array
        Half-light semi-major axes before lensing, arcsec.
    bulge_fraction : float array
        Fraction of the light in the bulge.
    sersic_index : float array
        Sersic index of the bulge.
    bulge_axis_ratio : float array
        Axis ratio of the bulge.
    inclination : float array
        Inclination of the disc, deg.
    beta : float array
        Angle of the major axis from u towards v, radian.
    g1, g2 : float array
        Reduced shear in the world frame.
    magnification : float array
        Magnification, positive. It affects sizes only, since catalogue fluxes already include it.
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
        """Return the selected galaxies."""
        return Shapes(*(getattr(self, field.name)[chosen] for field in fields(self)))


def shapes(galaxies: pa.Table) -> Shapes:
    """Convert rows of the table `galaxies` to shapes.

    Notes
    -----
    The reduced shear is g = gamma / (1 - kappa), limited to MAX_SHEAR. The magnification is mu = 1 / |(1 - kappa)^2 -
    gamma^2|, with a determinant of at least 1e-3.
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
        # Positive gamma2 stretches along north-east, which in (west, north) is the second quadrant.
        g2=np.nan_to_num(-columns["gamma2"] * reduced),
        magnification=1.0 / determinant,
    )


@dataclass(frozen=True, slots=True)
class Forms:
    """Sizes and orientations of n galaxies in Fourier space, for k in radian / pixel.

    Attributes
    ----------
    bulge, disk : float array, shape (n, 2, 2)
        k @ matrix is k along and across the major axis times the radius: the half-light radius of the bulge, or the
        scale length of the disc. Both are foreshortened across the axis.
    thick : float array, shape (n, 2)
        k @ vector is (pi / 2) (h / r) sin(inclination) times k r across the axis, with the scale length r.
    """

    bulge: Float
    disk: Float
    thick: Float


def forms(shape: Shapes, jacobian: Float) -> Forms:
    """Compute the forms of shapes [n] at positions with the Jacobians [n, 2, 2], in arcsec per pixel.

    Notes
    -----
    An inclined disc with the vertical profile sech^2(z / h) has the transform (1 + k_p^2)^-3/2 q / sinh q.

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
    """Profile of one galaxy of flux 1 in the world frame, arcsec.

    Parameters
    ----------
    shape : Shapes
        Shapes of galaxies.
    i : int
        Number of the galaxy.
    smallest : float
        Components with a smaller half-light radius are point sources, arcsec.

    Returns
    -------
    galsim.GSObject
        The profile.
    """
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
    # galsim's shear preserves the area, so the radius of the initial circle is the geometric mean of the axes.
    q = float(shape.bulge_axis_ratio[i])
    radius = float(shape.bulge_radius[i]) * np.sqrt(q)
    if radius < smallest:
        return galsim.DeltaFunction()
    round_one = _sersic(float(shape.sersic_index[i])).dilate(radius)
    return round_one.shear(q=q, beta=0.0 * galsim.radians)


@lru_cache(maxsize=256)
def _sersic(index: float) -> galsim.Sersic:
    return galsim.Sersic(index, half_light_radius=1.0)


def _disk(shape: Shapes, i: int, smallest: float) -> galsim.GSObject:
    radius = float(shape.disk_radius[i])
    if radius < smallest:
        return galsim.DeltaFunction()
    return galsim.InclinedExponential(
        float(shape.inclination[i]) * galsim.degrees, half_light_radius=radius, scale_h_over_r=DISK_SCALE_HEIGHT
    )


# ------------------------------------------------------------------------------------------------ extent


def surface_brightness(shape: Shapes, radius: Float) -> Float:
    """Fraction of the flux per arcsec^2 along the major axis, which is an upper limit for all directions.

    Parameters
    ----------
    shape : Shapes
        Shapes of n galaxies.
    radius : float array, shape (m,)
        Radii, arcsec.

    Returns
    -------
    float array, shape (n, m)
        Fractions.
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
    """Fraction of the flux per arcsec on a line parallel to the minor axis, an upper limit for all directions.

    Parameters
    ----------
    shape : Shapes
        Shapes of n galaxies.
    distance : float
        Distance of the line from the middle along the major axis, arcsec, positive.

    Returns
    -------
    float array, shape (n,)
        Fractions, with an error of 1 %.
    """
    t = _LINE_STEP * np.arange(_LINE_NODES)
    radius, stretch = distance * np.cosh(t), _lensed_stretch(shape)
    # Trapezoidal rule on both sides of the nearest point, with x = distance sinh t and dx = radius dt.
    weights = 2.0 * _LINE_STEP * radius
    weights[0] *= 0.5
    ones, parts = np.ones(len(shape)), ((shape.bulge_radius, shape.sersic_index), (shape.disk_radius, None))
    bulge, disk = (
        matrices.matmul(_sersic_surface(radius, size * stretch, ones if n is None else n, ones), weights)
        for size, n in parts
    )
    return np.asarray(shape.bulge_fraction * bulge + (1 - shape.bulge_fraction) * disk)


def flux_outside(shape: Shapes, radius: Float) -> Float:
    """Fraction of the flux outside an ellipse with a given semi-major axis, an upper limit for that outside the circle.

    Parameters
    ----------
    shape : Shapes
        Shapes of n galaxies.
    radius : float array, shape (n,)
        Radii along the major axis, arcsec.

    Returns
    -------
    float array, shape (n,)
        Fractions.
    """
    stretch, n = _lensed_stretch(shape), shape.sersic_index
    bulge_radius, disk_radius = (np.maximum(r * stretch, 1e-6) for r in (shape.bulge_radius, shape.disk_radius))
    bulge = gammaincc(2 * n, _b(n) * (radius / bulge_radius) ** (1 / n))
    lengths = radius / disk_radius * EXPONENTIAL_RADIUS
    disk = (1 + lengths) * np.exp(-lengths)
    return np.asarray(shape.bulge_fraction * bulge + (1 - shape.bulge_fraction) * disk)


def real_space_profile(shape: Shapes, form: Forms) -> Float:
    """Parameters of the light at any position, for flux 1, as used by drawing/kernels/frame.py.

    Parameters
    ----------
    shape : Shapes
        Shapes of n galaxies.
    form : Forms
        Their forms.

    Returns
    -------
    float array, shape (n, 11)
        Columns: light in the middle of the bulge and of the disc, per square pixel; four elements (rows first) of the
        bulge's matrix, and its exponent p; four elements of the disc's matrix.

    Notes
    -----
    The matrices convert pixels (x, y) from the middle to (u, v). The light of the bulge is proportional to exp(-(u^2 +
    v^2)^p) and that of the disc to exp(-sqrt(u^2 + v^2)). The disc is treated as thin, with its apparent axis ratio.
    """
    n, b = shape.sersic_index, _b(shape.sersic_index)
    # The width of an edge-on disc is given by its scale height.
    across = form.disk[:, :, 1], form.thick * (2 / np.pi)
    disk = np.stack([form.disk[:, :, 0], np.copysign(np.hypot(*across), across[0] + across[1])], -1)
    areas = [
        np.abs(matrix[:, 0, 0] * matrix[:, 1, 1] - matrix[:, 0, 1] * matrix[:, 1, 0]) for matrix in (form.bulge, disk)
    ]
    has_area = [area > _NO_AREA for area in areas]
    areas = [np.where(valid, area, 1.0) for valid, area in zip(has_area, areas, strict=True)]
    middles = (
        shape.bulge_fraction * np.exp(2 * n * np.log(b) - np.log(2 * np.pi * n) - gammaln(2 * n)) / areas[0],
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
    """Half-light radius after lensing along the major axis, arcsec: the mean of bulge and disc, weighted by light."""
    fraction = shape.bulge_fraction
    return _lensed_stretch(shape) * (fraction * shape.bulge_radius + (1 - fraction) * shape.disk_radius)


def _lensed_stretch(shape: Shapes) -> Float:
    """Largest linear stretch by lensing."""
    g = np.hypot(shape.g1, shape.g2)
    return np.asarray(np.sqrt(shape.magnification * (1 + g) / (1 - g)))


def _apparent_axis_ratio(shape: Shapes) -> Float:
    cosine = np.cos(np.radians(shape.inclination))
    return np.asarray(np.hypot(cosine, DISK_SCALE_HEIGHT))


def _b(index: Float) -> Float:
    """Sersic's b_n, with an error of 3e-5.

    References
    ----------
    Ciotti & Bertin 1999, eq. 18, which has an error of 1 % at the lowest index.
    """
    out = np.asarray(2 * index - 1 / 3 + 4 / (405 * index) + 46 / (25515 * index**2))
    low = index < _SERIES
    out[low] = gammaincinv(2 * index[low], 0.5)
    return out


def _sersic_surface(radius: Float, half_light: Float, index: Float, stretch: Float) -> Float:
    """Surface brightness [n, m] per arcsec^2 of the unlensed circle, without axis ratio and magnification."""
    r_e = np.maximum(half_light, 1e-6)[:, None]
    n, b = index[:, None], _b(index)[:, None]
    log_norm = np.log(2 * np.pi * n) - 2 * n * np.log(b) + gammaln(2 * n) + 2 * np.log(r_e / stretch[:, None])
    return np.asarray(np.exp(-b * (radius[None, :] / r_e) ** (1 / n) - log_norm))
