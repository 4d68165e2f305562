"""Geometric distortion: the optics put a place of the sky a little off where a perfect camera would.

A focal-plane position P (arcsec) looks where a perfect camera has P + D(P); D is a polynomial without constant and
linear terms, so that the boresight stays, and the scale there. In pixels it is the polynomial of the SIP convention.

terms      a camera's polynomial, from the mission database: any, or one of the distance from the axis
joined     the sum of two
bent       P -> P + D(P)
sip        the same in a detector's pixels: coefficients of the header's cards
stretch    what it does to a pixel's area
straight   what SIP makes of pixels, undone, as far as `one_to_one`

Ref : Shupe et al. 2005 (SIP)
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import numpy.typing as npt
from numpy.polynomial import polynomial

from lake_schema.arrays import Float
from lake_schema.errors import BadInput
from lake_schema.mission.configuration import MissionConfiguration
from truesky.numerics import matrices

# Of each term: powers of x and y; what it adds to x and to y, arcsec^(1 - powers).
Terms = tuple[tuple[int, int, float, float], ...]

_ARCSEC = 3600.0
# The inverse: pixels that it is exact to, steps it may take (each doubles the digits), and from where on there is no
# camera, pixels from the boresight: what lies there is left where a perfect camera has it.
_TOLERANCE, _MAX_STEPS, _MAX_RADIUS = 1e-9, 30, 6e4
# It is sought where a pixel keeps more than this part of its area; distances and directions that are tried.
_MIN_AREA, _RINGS, _RAYS = 0.1, 60, 24


def terms(section: str, mission: MissionConfiguration) -> Terms:
    """A camera's distortion; none where the database has no polynomial, or its strength is 0."""
    key = f"{section}.fpa.distortion_polynomial"
    if key not in mission:
        return _radial_terms(section, mission)
    strength = mission.value(f"{section}.fpa.distortion", "")
    # The polynomial is in degrees.
    all_terms = [
        (int(i), int(j), strength * to_x * _ARCSEC ** (1 - i - j), strength * to_y * _ARCSEC ** (1 - i - j))
        for i, j, to_x, to_y in mission.numbers(key)
    ]
    if any(i + j < 2 for i, j, _, _ in all_terms):
        raise BadInput(f"mission model {key}: a term of less than second order moves the boresight or turns the camera")
    return tuple(term for term in all_terms if term[2] or term[3])


def _radial_terms(section: str, mission: MissionConfiguration) -> Terms:
    """P times k r^n for each even power n that the mission has; r : of P in the focal plane, mm."""
    scale = mission.value(f"{section}.fpa.pixel_scale", "arcsec / pix")
    plate_scale = scale / mission.value(f"{section}.fpa.pixel_size", "mm / pix")
    radial_terms: Terms = ()
    for power in (2, 4):
        key = f"{section}.fpa.distortion_r{power}"
        k = mission.value(key, f"1 / mm{power}") / plate_scale**power if key in mission else 0.0
        if k:
            radial_terms = add_terms(radial_terms, _RADIAL_TERMS[power](k))
    return radial_terms


def require_invertible(distortion_terms: Terms, radius: float, scale: float, camera: str) -> None:
    """BadInput where detectors reach farther than the distortion can be undone.

    some : of the camera;  pixels : from the boresight to the farthest corner;  scale : arcsec of a pixel
    """
    if distortion_terms and radius >= invertible_radius(*sip(distortion_terms, scale * np.eye(2))):
        raise BadInput(
            f"camera {camera}: its distortion is so strong that places of the sky are seen twice, or nowhere"
        )


def _terms_r2(k: float) -> Terms:
    return (3, 0, k, 0.0), (1, 2, k, 0.0), (2, 1, 0.0, k), (0, 3, 0.0, k)


def _terms_r4(k: float) -> Terms:
    of_x, of_y = ((5, 0, k), (3, 2, 2.0 * k), (1, 4, k)), ((4, 1, k), (2, 3, 2.0 * k), (0, 5, k))
    return (*((i, j, a, 0.0) for i, j, a in of_x), *((i, j, 0.0, a) for i, j, a in of_y))


_RADIAL_TERMS = {2: _terms_r2, 4: _terms_r4}


def add_terms(first: Terms, second: Terms) -> Terms:
    """The sum of two distortions."""
    total: dict[tuple[int, int], tuple[float, float]] = {}
    for i, j, to_x, to_y in (*first, *second):
        x, y = total.get((i, j), (0.0, 0.0))
        total[i, j] = x + to_x, y + to_y
    return tuple((i, j, *coefficients) for (i, j), coefficients in total.items())


def distort(x: npt.ArrayLike, y: npt.ArrayLike, distortion_terms: Terms) -> tuple[Float, Float]:
    """Focal-plane positions [..], arcsec -> where a perfect camera has what is seen there."""
    x, y = np.asarray(x, float), np.asarray(y, float)
    to_x, to_y = np.zeros_like(x), np.zeros_like(y)
    for i, j, a, b in distortion_terms:
        power = x**i * y**j
        to_x += a * power
        to_y += b * power
    return x + to_x, y + to_y


def sip(distortion_terms: Terms, matrix: Float) -> tuple[Float, Float]:
    """Coefficients [order + 1, order + 1] of u^p v^q that SIP adds to columns and to rows.

    matrix : [2, 2] focal-plane arcsec of a pixel's step along columns (u) and rows (v)
    """
    order = max(i + j for i, j, _, _ in distortion_terms)
    to_x, to_y = np.zeros((2, order + 1, order + 1))
    for i, j, a, b in distortion_terms:
        power = np.zeros((order + 1, order + 1))
        # (m00 u + m01 v)^i (m10 u + m11 v)^j, each factor a homogeneous polynomial: a row of binomials.
        across, along = (_binomial(line, n) for line, n in ((matrix[0], i), (matrix[1], j)))
        for p, coefficient in enumerate(across):
            for q, another in enumerate(along):
                power[p + q, i + j - p - q] += coefficient * another
        to_x += a * power
        to_y += b * power
    inverse = matrices.inverse(matrix)
    return inverse[0, 0] * to_x + inverse[0, 1] * to_y, inverse[1, 0] * to_x + inverse[1, 1] * to_y


def area_change(distortion_terms: Terms, matrix: Float) -> Float:
    """Coefficients [n, n] of u^p v^q: the area that a pixel sees over that at the boresight, less 1.

    matrix : as of `sip`, whose derivative's determinant it is
    """
    a, b = sip(distortion_terms, matrix)
    (au, av), (bu, bv) = ([np.asarray(polynomial.polyder(c, axis=axis), float) for axis in (0, 1)] for c in (a, b))
    side = 2 * len(a) - 1
    out = np.zeros((side, side))
    for sign, factors in (
        (1.0, (au, _CONSTANT_POLYNOMIAL)),
        (1.0, (bv, _CONSTANT_POLYNOMIAL)),
        (1.0, (au, bv)),
        (-1.0, (av, bu)),
    ):
        first, second = factors
        for p, q in np.argwhere(first).tolist():
            out[p : p + second.shape[0], q : q + second.shape[1]] += sign * first[p, q] * second
    return out


_CONSTANT_POLYNOMIAL = np.ones((1, 1))


def _binomial(line: Float, n: int) -> Float:
    """Coefficients by the power of u of (line[0] u + line[1] v)^n."""
    return np.asarray(polynomial.polypow([line[1], line[0]], n), float) if n else np.ones(1)


def undo_sip(u: Float, v: Float, a: Float, b: Float) -> tuple[Float, Float]:
    """(u, v) [n] pixels from the boresight with u + a(u, v), v + b(u, v) as given, by Newton's rule.

    Error : 1e-9 pixels; beyond any camera (see above), and where places are seen twice, nothing is undone
    """
    distorted = np.stack([np.asarray(u, float), np.asarray(v, float)])
    undistorted = distorted.copy()
    with np.errstate(invalid="ignore"):
        is_invertible = np.hypot(*distorted) < invertible_radius(a, b)
    estimate, target = undistorted[:, is_invertible], distorted[:, is_invertible]
    slopes = [np.asarray(polynomial.polyder(c, axis=axis), float) for c in (a, b) for axis in (0, 1)]
    for _ in range(_MAX_STEPS):
        residual = estimate + np.stack([_evaluate(estimate, c) for c in (a, b)]) - target
        au, av, bu, bv = (_evaluate(estimate, c) for c in slopes)
        determinant = (1.0 + au) * (1.0 + bv) - av * bu
        step = (
            np.stack([(1.0 + bv) * residual[0] - av * residual[1], (1.0 + au) * residual[1] - bu * residual[0]])
            / determinant
        )
        estimate = np.asarray(estimate - step)
        if np.abs(step).max(initial=0.0) < _TOLERANCE:
            break
    else:
        raise BadInput("the distortion is so strong that places of the sky are seen twice, or nowhere")
    undistorted[:, is_invertible] = estimate
    return undistorted[0], undistorted[1]


def invertible_radius(a: Float, b: Float) -> float:
    """Pixels from the boresight within which each place of the sky is seen once; at most those of any camera.

    a, b : as of `straight`, coefficients [n, n]
    """
    return _invertible_radius(a.tobytes(), b.tobytes(), a.shape, b.shape)


@lru_cache(maxsize=512)
def _invertible_radius(a: bytes, b: bytes, shape_a: tuple[int, int], shape_b: tuple[int, int]) -> float:
    polynomials = np.frombuffer(a).reshape(shape_a), np.frombuffer(b).reshape(shape_b)
    # As far on the detectors as the sky goes that may be asked for, even where they see less of it.
    radius = np.linspace(0.0, 2.0 * _MAX_RADIUS, _RINGS + 1)[:, None]
    ray = 2.0 * np.pi * np.arange(_RAYS) / _RAYS
    places = np.stack([radius * np.cos(ray), radius * np.sin(ray)])
    (au, av), (bu, bv) = ([np.asarray(polynomial.polyder(c, axis=axis), float) for axis in (0, 1)] for c in polynomials)
    area = (1.0 + _evaluate(places, au)) * (1.0 + _evaluate(places, bv)) - _evaluate(places, av) * _evaluate(places, bu)
    folded_rings = np.flatnonzero((area < _MIN_AREA).any(axis=1))
    if not len(folded_rings):
        return _MAX_RADIUS
    sky_radius = np.hypot(*(places + np.stack([_evaluate(places, c) for c in polynomials])))[: folded_rings[0]].min(
        axis=1
    )
    return float(min(sky_radius[-1], _MAX_RADIUS))


def _evaluate(places: Float, coefficients: Float) -> Float:
    return np.asarray(polynomial.polyval2d(places[0], places[1], coefficients), float)
