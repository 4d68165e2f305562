"""Geometric distortion of optics, as a polynomial in the focal plane and as SIP in pixels.

A focal-plane position P (arcsec) receives the light that a perfect camera would image at P + D(P). The polynomial D has
no constant and no linear terms, so that it preserves the boresight and the scale there. In pixels, D becomes the
polynomial of the SIP convention.

References
----------
Shupe et al. 2005 (SIP).
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

# Each term contains the powers of x and y, and its coefficients for x and y, arcsec^(1 - sum of powers).
Terms = tuple[tuple[int, int, float, float], ...]

_ARCSEC = 3600.0
# Inversion: tolerance in pixels, maximum number of steps (each doubles the digits), and the largest distance from the
# boresight of any camera, in pixels. Positions beyond it are not corrected.
_TOLERANCE, _MAX_STEPS, _MAX_RADIUS = 1e-9, 30, 6e4
# The inverse exists if a pixel keeps more than this fraction of its area. Numbers of distances and directions to test.
_MIN_AREA, _RINGS, _RAYS = 0.1, 60, 24


def terms(section: str, mission: MissionConfiguration) -> Terms:
    """Distortion of a camera; () if the mission database has no polynomial or its strength is 0.

    Raises
    ------
    BadInput
        If the polynomial has a term below second order.
    """
    key = f"{section}.fpa.distortion_polynomial"
    if key not in mission:
        return _radial_terms(section, mission)
    strength = mission.value(f"{section}.fpa.distortion", "")
    # The polynomial of the database is in degrees.
    all_terms = [
        (int(i), int(j), strength * to_x * _ARCSEC ** (1 - i - j), strength * to_y * _ARCSEC ** (1 - i - j))
        for i, j, to_x, to_y in mission.numbers(key)
    ]
    if any(i + j < 2 for i, j, _, _ in all_terms):
        raise BadInput(f"mission model {key}: terms below second order are not allowed, they move the boresight")
    return tuple(term for term in all_terms if term[2] or term[3])


def _radial_terms(section: str, mission: MissionConfiguration) -> Terms:
    """Return P times k r^n for each even power n in the mission database, with r the radius of P in mm."""
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
    """Raise BadInput if detectors reach farther from the boresight than the distortion can be inverted.

    Parameters
    ----------
    distortion_terms : Terms
        Distortion of the camera.
    radius : float
        Distance from the boresight to the farthest corner, pixels.
    scale : float
        Arcsec per pixel.
    camera : str
        Name of the camera, for the message.

    Raises
    ------
    BadInput
        If `radius` is not below `invertible_radius`.
    """
    if distortion_terms and radius >= invertible_radius(*sip(distortion_terms, scale * np.eye(2))):
        raise BadInput(
            f"camera {camera}: its distortion is so strong that some sky positions appear on several pixels or on none"
        )


def _terms_r2(k: float) -> Terms:
    return (3, 0, k, 0.0), (1, 2, k, 0.0), (2, 1, 0.0, k), (0, 3, 0.0, k)


def _terms_r4(k: float) -> Terms:
    of_x, of_y = ((5, 0, k), (3, 2, 2.0 * k), (1, 4, k)), ((4, 1, k), (2, 3, 2.0 * k), (0, 5, k))
    return (*((i, j, a, 0.0) for i, j, a in of_x), *((i, j, 0.0, a) for i, j, a in of_y))


_RADIAL_TERMS = {2: _terms_r2, 4: _terms_r4}


def add_terms(first: Terms, second: Terms) -> Terms:
    """Return the sum of two distortions."""
    total: dict[tuple[int, int], tuple[float, float]] = {}
    for i, j, to_x, to_y in (*first, *second):
        x, y = total.get((i, j), (0.0, 0.0))
        total[i, j] = x + to_x, y + to_y
    return tuple((i, j, *coefficients) for (i, j), coefficients in total.items())


def distort(x: npt.ArrayLike, y: npt.ArrayLike, distortion_terms: Terms) -> tuple[Float, Float]:
    """Convert focal-plane positions to the positions where a perfect camera would image the same light.

    Parameters
    ----------
    x, y : array_like
        Focal-plane positions, arcsec.
    distortion_terms : Terms
        Distortion of the camera.

    Returns
    -------
    (float array, float array)
        P + D(P), arcsec.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    to_x, to_y = np.zeros_like(x), np.zeros_like(y)
    for i, j, a, b in distortion_terms:
        power = x**i * y**j
        to_x += a * power
        to_y += b * power
    return x + to_x, y + to_y


def sip(distortion_terms: Terms, matrix: Float) -> tuple[Float, Float]:
    """Convert a distortion to the SIP polynomials in pixels.

    Parameters
    ----------
    distortion_terms : Terms
        Distortion of the camera.
    matrix : float array, shape (2, 2)
        Focal-plane steps, in arcsec, of one pixel along columns (u) and rows (v).

    Returns
    -------
    (float array, float array), each of shape (order + 1, order + 1)
        Coefficients of u^p v^q that are added to columns and to rows.
    """
    order = max(i + j for i, j, _, _ in distortion_terms)
    to_x, to_y = np.zeros((2, order + 1, order + 1))
    for i, j, a, b in distortion_terms:
        power = np.zeros((order + 1, order + 1))
        # Each factor of (m00 u + m01 v)^i (m10 u + m11 v)^j is a homogeneous polynomial: a row of binomials.
        across, along = (_binomial(line, n) for line, n in ((matrix[0], i), (matrix[1], j)))
        for p, coefficient in enumerate(across):
            for q, another in enumerate(along):
                power[p + q, i + j - p - q] += coefficient * another
        to_x += a * power
        to_y += b * power
    inverse = matrices.inverse(matrix)
    return inverse[0, 0] * to_x + inverse[0, 1] * to_y, inverse[1, 0] * to_x + inverse[1, 1] * to_y


def area_change(distortion_terms: Terms, matrix: Float) -> Float:
    """Relative change of the sky area per pixel, as a polynomial.

    Parameters
    ----------
    distortion_terms : Terms
        Distortion of the camera.
    matrix : float array, shape (2, 2)
        Same as for `sip`.

    Returns
    -------
    float array, shape (n, n)
        Coefficients of u^p v^q for the sky area of a pixel, divided by its area at the boresight, minus 1.

    Notes
    -----
    The area is the determinant of the derivative of the mapping by `sip`.
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
    """Coefficients of (line[0] u + line[1] v)^n by the power of u."""
    return np.asarray(polynomial.polypow([line[1], line[0]], n), float) if n else np.ones(1)


def undo_sip(u: Float, v: Float, a: Float, b: Float) -> tuple[Float, Float]:
    """Invert the SIP polynomials by Newton's method.

    Parameters
    ----------
    u, v : float array, shape (n,)
        Distorted positions u + a(u, v) and v + b(u, v), pixels from the boresight.
    a, b : float array, shape (n, n)
        SIP coefficients for columns and rows.

    Returns
    -------
    (float array, float array)
        Positions u and v to 1e-9 pixels. Positions outside `invertible_radius` are returned unchanged.

    Raises
    ------
    BadInput
        If the iteration does not converge.
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
        raise BadInput("the distortion is so strong that some sky positions appear on several pixels or on none")
    undistorted[:, is_invertible] = estimate
    return undistorted[0], undistorted[1]


def invertible_radius(a: Float, b: Float) -> float:
    """Distance from the boresight, in pixels, within which each sky position appears on one pixel only.

    Parameters `a` and `b` are SIP coefficients [n, n]. The result is at most the largest radius of any camera.
    """
    return _invertible_radius(a.tobytes(), b.tobytes(), a.shape, b.shape)


@lru_cache(maxsize=512)
def _invertible_radius(a: bytes, b: bytes, shape_a: tuple[int, int], shape_b: tuple[int, int]) -> float:
    polynomials = np.frombuffer(a).reshape(shape_a), np.frombuffer(b).reshape(shape_b)
    # The factor 2 covers all requested sky positions, also if a detector position maps to a smaller sky radius.
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
