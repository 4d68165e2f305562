"""Catalogue rows -> light profiles, lensed, on the sky.

World frame of galsim: u to the west, v to the north, arcsec; an axis at position angle PA (north through east)
lies at 90 deg + PA from u.

shapes        rows -> Shapes, checked arrays
forms         what the kernel draws them from, in pixels
profile       one galaxy by galsim, for the reference
surface       its light at a radius, for the choice of a stamp's size;  line : along a line
outside       its light beyond a radius;  on_the_sky : its light at any place, for what lies outside its stamp
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
# Inverse magnification near a critical line: beyond it, as beyond MOST_SHEAR, a single source is not a lensed ellipse.
_MIN_DETERMINANT = 1e-3
# An ellipse has an area: thinner than this is a line.
_SLIMMEST = 1e-4
# From this index on Sersic's b_n is taken from its series.
_SERIES = 0.8
# Places along a line at which light is summed: t, from the nearest on, of distances that rise as cosh t.
_LINE_STEP, _LINE_NODES = 0.35, 12
# Square pixels of a component that has no light to speak of outside any stamp.
_NO_AREA = 1e-8


# What is read of the catalogue.
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
    """Structure of n galaxies, arrays [n].

    bulge_radius, disk_radius : half-light semi-major axis, arcsec, before lensing
    beta                      : radian, major axis from u towards v
    g1, g2                    : reduced shear in the world frame
    magnification             : > 0, used for sizes alone (catalogue fluxes hold it already)
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
        """Some of the galaxies."""
        return Shapes(*(getattr(self, field.name)[chosen] for field in fields(self)))


def shapes(galaxies: pa.Table) -> Shapes:
    """Rows of the table `galaxies` -> Shapes.

    Lensing     : g = gamma / (1 - kappa), held below 0.9; mu = 1 / |(1 - kappa)^2 - gamma^2|, the determinant
                  held above 1e-3
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
    """Sizes and orientations of n galaxies in Fourier space, k in radian / pixel.

    bulge, disk : float64[n, 2, 2] k @ matrix is k along and across the major axis times the radius: half-light of
                  the bulge, scale length of the disc, both foreshortened across
    thick       : float64[n, 2] k @ vector is (pi / 2) (h / r) sin(inclination) times k r across, r the scale length
    """

    bulge: Float
    disk: Float
    thick: Float


def forms(shape: Shapes, jacobian: Float) -> Forms:
    """What the kernel needs of shapes [n] at places of a Jacobian [n, 2, 2] (arcsec by pixels).

    An inclined disc of scale height h, sech^2 across, has (1 + k_p^2)^-3/2 q / sinh q for its transform.
    Ref : van der Kruit & Searle 1981 (the disc); galsim.InclinedExponential
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
    """Galaxy i, flux 1, world frame, arcsec.

    smallest : arcsec; a component of a smaller half-light radius is a point
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
    # galsim's shear keeps the area, so the circle that it starts from has the geometric mean of the axes as
    # its radius.
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
    """Fraction of the flux per arcsec2 along the major axis, an upper bound for every other direction.

    radius : [m] arcsec;  returns [n, m]
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
    """Fraction of the flux per arcsec of a line at a distance from the middle: of the major axis, along the minor.

    distance : arcsec, > 0;  returns [n], an upper bound for lines of every other direction. Error : 1 %
    """
    t = _LINE_STEP * np.arange(_LINE_NODES)
    radius, stretch = distance * np.cosh(t), _lensed_stretch(shape)
    # Both sides of the nearest point, by the trapezoidal rule: x = distance sinh t, dx = radius dt.
    weights = 2.0 * _LINE_STEP * radius
    weights[0] *= 0.5
    ones, parts = np.ones(len(shape)), ((shape.bulge_radius, shape.sersic_index), (shape.disk_radius, None))
    bulge, disk = (
        matrices.matmul(_sersic_surface(radius, size * stretch, ones if n is None else n, ones), weights)
        for size, n in parts
    )
    return np.asarray(shape.bulge_fraction * bulge + (1 - shape.bulge_fraction) * disk)


def flux_outside(shape: Shapes, radius: Float) -> Float:
    """Fraction of the flux beyond a radius along the major axis, an upper bound for what is beyond that circle.

    radius : [n] arcsec;  returns [n]
    """
    stretch, n = _lensed_stretch(shape), shape.sersic_index
    bulge_radius, disk_radius = (np.maximum(r * stretch, 1e-6) for r in (shape.bulge_radius, shape.disk_radius))
    bulge = gammaincc(2 * n, _b(n) * (radius / bulge_radius) ** (1 / n))
    lengths = radius / disk_radius * EXPONENTIAL_RADIUS
    disk = (1 + lengths) * np.exp(-lengths)
    return np.asarray(shape.bulge_fraction * bulge + (1 - shape.bulge_fraction) * disk)


def real_space_profile(shape: Shapes, form: Forms) -> Float:
    """float64[n, 11]: what drawing/kernels/frame.py takes the light at a place from, of unit flux.

    Of the bulge and of the disc the light in the middle, by square pixel; of the bulge, of pixels (x, y) from the
    middle, the rows of a matrix and an exponent p: light exp(-(u^2 + v^2)^p); of the disc a matrix:
    light exp(-sqrt(u^2 + v^2)).
    Error : the disc is thin, of the axis ratio that it is seen with
    """
    n, b = shape.sersic_index, _b(shape.sersic_index)
    # A disc on edge is as thick as it is high.
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
    """Half-light radius along the major axis, lensed, arcsec: the mean of the components'."""
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
    """Sersic's b_n.  Error: 3e-5.  Ref: Ciotti & Bertin 1999, eq. 18, which is wrong by 1 % at the lowest index."""
    out = np.asarray(2 * index - 1 / 3 + 4 / (405 * index) + 46 / (25515 * index**2))
    low = index < _SERIES
    out[low] = gammaincinv(2 * index[low], 0.5)
    return out


def _sersic_surface(radius: Float, half_light: Float, index: Float, stretch: Float) -> Float:
    """[n, m] per arcsec2 of the unlensed circle; axis ratio and magnification are the caller's."""
    r_e = np.maximum(half_light, 1e-6)[:, None]
    n, b = index[:, None], _b(index)[:, None]
    log_norm = np.log(2 * np.pi * n) - 2 * n * np.log(b) + gammaln(2 * n) + 2 * np.log(r_e / stretch[:, None])
    return np.asarray(np.exp(-b * (radius[None, :] / r_e) ** (1 / n) - log_norm))
