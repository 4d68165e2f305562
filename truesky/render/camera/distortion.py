"""Geometric distortion of optics, as a polynomial in the focal plane and as SIP in pixels.

A focal-plane position P (arcsec) receives the light that a perfect camera would image at P + D(P). The polynomial D has
no constant and no linear terms, so that the boresight and the scale there are unchanged. In pixels, D becomes the
polynomial of the SIP (Simple Imaging Polynomial) convention of FITS headers.

References
----------
Shupe et al. 2005 (SIP).
"""

from __future__ import annotations

from functools import lru_cache
from math import comb

import numpy as np
import numpy.typing as npt
from numpy.polynomial import polynomial

from lake_schema.arrays import Float
from lake_schema.errors import BadInput
from lake_schema.mission.configuration import MissionConfiguration
from truesky.numerics import matrices

# A distortion: each term is (power of x, power of y, coefficient for x, coefficient for y). x and y are in arcsec, and
# the unit of a coefficient is arcsec^(1 - sum of powers).
Terms = tuple[tuple[int, int, float, float], ...]

# Arcseconds per degree.
_ARCSEC = 3600.0
# The iteration of `undo_sip`, which removes the distortion from pixel positions, ends when its last step changes no
# position by this number of pixels or more.
_TOLERANCE = 1e-9
# Largest number of iterations with which `undo_sip` removes the distortion from pixel positions; each doubles the
# number of correct digits. BadInput is raised if more would be needed.
_MAX_STEPS = 30
# Largest distance of any camera's pixels from the boresight, in pixels. Positions beyond it are not corrected for
# distortion.
_MAX_RADIUS = 6e4
# A distortion counts as invertible where the sky area of a pixel is more than this fraction of the undistorted area.
_MIN_AREA = 0.1
# Number of distances from the boresight, besides 0, at which the sky area of a pixel is computed to find out where the
# distortion is invertible.
_RINGS = 60
# Number of directions in which the sky area of a pixel is computed at each distance from the boresight.
_RAYS = 24


def terms(section: str, mission: MissionConfiguration) -> Terms:
    """Return the polynomial of a camera's optical distortion from the mission database.

    It is () if the database has no distortion of the camera or the strength of the distortion is 0.

    Raises
    ------
    BadInput
        If the polynomial has a constant or linear term, which would move the boresight or change the scale.
    """
    key = f"{section}.fpa.distortion_polynomial"
    if key not in mission:
        return _radial_terms(section, mission)
    strength = mission.value(f"{section}.fpa.distortion", "")
    # Convert the coefficients: the polynomial of the mission database is in degrees, `Terms` are in arcsec.
    all_terms = [
        (int(i), int(j), strength * to_x * _ARCSEC ** (1 - i - j), strength * to_y * _ARCSEC ** (1 - i - j))
        for i, j, to_x, to_y in mission.numbers(key)
    ]
    if any(i + j < 2 for i, j, _, _ in all_terms):
        raise BadInput(f"mission model {key}: terms below second order are not allowed, they move the boresight")
    return tuple(term for term in all_terms if term[2] or term[3])


def _radial_terms(section: str, mission: MissionConfiguration) -> Terms:
    """Return a radial distortion from the mission database: the sum of P k r^n for the powers n = 2, 4 and 6.

    P is the focal-plane position, r its distance from the boresight, and k the coefficient of the power n (1 / mm^n in
    the database). The result is () if the database has no coefficient, or only coefficients of 0.
    """
    scale = mission.value(f"{section}.fpa.pixel_scale", "arcsec / pix")
    plate_scale = scale / mission.value(f"{section}.fpa.pixel_size", "mm / pix")
    radial_terms: Terms = ()
    for power in (2, 4, 6):
        key = f"{section}.fpa.distortion_r{power}"
        k = mission.value(key, f"1 / mm{power}") / plate_scale**power if key in mission else 0.0
        if k:
            radial_terms = add_terms(radial_terms, _power_terms(power, k))
    return radial_terms


def require_invertible(distortion_terms: Terms, radius: float, scale: float, camera: str) -> None:
    """Check that every sky position appears on one pixel only, in the whole field of a camera.

    Parameters
    ----------
    distortion_terms : Terms
        Polynomial of the distortion of the camera.
    radius : float
        Distance from the boresight to the farthest corner of a detector, pixels.
    scale : float
        Arcsec per pixel.
    camera : str
        Name of the camera, for the message.

    Raises
    ------
    BadInput
        If `radius` is not below `invertible_radius`, the largest distance for which the distortion can be inverted.
    """
    if distortion_terms and radius >= invertible_radius(*sip(distortion_terms, scale * np.eye(2))):
        raise BadInput(
            f"camera {camera}: its distortion is so strong that some sky positions appear on several pixels or on none"
        )


def _power_terms(power: int, k: float) -> Terms:
    """Return the polynomial k r^power (x, y) with r^2 = x^2 + y^2, for an even power."""
    half = power // 2
    parts = [(power - 2 * i, 2 * i, k * comb(half, i)) for i in range(half + 1)]
    return (*((i + 1, j, a, 0.0) for i, j, a in parts), *((i, j + 1, 0.0, a) for i, j, a in parts))


def add_terms(first: Terms, second: Terms) -> Terms:
    """Return the sum of two distortion polynomials; coefficients of the same powers are added."""
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
        Polynomial D of the distortion of the camera.

    Returns
    -------
    (float array, float array)
        Positions P + D(P) for the focal-plane positions P, arcsec.
    """
    x, y = np.asarray(x, float), np.asarray(y, float)
    to_x, to_y = np.zeros_like(x), np.zeros_like(y)
    for i, j, a, b in distortion_terms:
        power = x**i * y**j
        to_x += a * power
        to_y += b * power
    return x + to_x, y + to_y


def sip(distortion_terms: Terms, matrix: Float) -> tuple[Float, Float]:
    """Convert a distortion polynomial in arcsec to the SIP polynomials in pixels.

    Parameters
    ----------
    distortion_terms : Terms
        Polynomial of the distortion of the camera, with at least one term.
    matrix : float array, shape (2, 2)
        Matrix that converts pixels (u, v), counted along columns and rows of the image, to focal-plane positions (x, y)
        in arcsec.

    Returns
    -------
    (float array, float array), each of shape (order + 1, order + 1)
        Coefficients of u^p v^q, at index [p, q], of the polynomials that are added to the columns u and to the rows v.
    """
    order = max(i + j for i, j, _, _ in distortion_terms)
    to_x, to_y = np.zeros((2, order + 1, order + 1))
    for i, j, a, b in distortion_terms:
        power = np.zeros((order + 1, order + 1))
        # Expand x^i y^j for x = m00 u + m01 v and y = m10 u + m11 v, with the elements m of `matrix`. Each factor is a
        # polynomial of u and v with binomial coefficients.
        across, along = (_binomial(line, n) for line, n in ((matrix[0], i), (matrix[1], j)))
        for p, coefficient in enumerate(across):
            for q, another in enumerate(along):
                power[p + q, i + j - p - q] += coefficient * another
        to_x += a * power
        to_y += b * power
    inverse = matrices.inverse(matrix)
    return inverse[0, 0] * to_x + inverse[0, 1] * to_y, inverse[1, 0] * to_x + inverse[1, 1] * to_y


def area_change(distortion_terms: Terms, matrix: Float) -> Float:
    """Return the relative change of the sky area of a pixel by distortion, as a polynomial in the pixel's position.

    Parameters
    ----------
    distortion_terms : Terms
        Polynomial of the distortion of the camera, with at least one term.
    matrix : float array, shape (2, 2)
        Matrix that converts pixels (u, v), columns and rows of the image, to focal-plane positions (x, y) in arcsec.

    Returns
    -------
    float array, shape (n, n)
        Coefficients of u^p v^q, at index [p, q], of the sky area of a pixel divided by the area at the boresight, minus
        1. Columns u and rows v are in pixels from the boresight.

    Notes
    -----
    With the SIP polynomials a and b, the pixel (u, v) sees the sky at (u + a, v + b). The area is the determinant of
    the derivative of this position with respect to (u, v).
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
    """Return the coefficients of (line[0] u + line[1] v)^n, by ascending power of u, float[n + 1]."""
    return np.asarray(polynomial.polypow([line[1], line[0]], n), float) if n else np.ones(1)


def undo_sip(u: Float, v: Float, a: Float, b: Float) -> tuple[Float, Float]:
    """Remove the SIP distortion from pixel positions, by Newton's method.

    Parameters
    ----------
    u, v : float array, shape (k,)
        Distorted columns u + a(u, v) and rows v + b(u, v), pixels from the boresight.
    a, b : float array, shape (n, n)
        SIP coefficients of u^p v^q, at index [p, q], for columns and rows.

    Returns
    -------
    (float array, float array)
        Undistorted columns u and rows v to 1e-9 pixels. Positions that are farther from the boresight than
        `invertible_radius`, and NaN, are returned unchanged.

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
    # Each position is iterated until it has converged, so that it does not depend on the other positions.
    active = np.arange(estimate.shape[1])
    for _ in range(_MAX_STEPS):
        moving = estimate[:, active]
        residual = moving + np.stack([_evaluate(moving, c) for c in (a, b)]) - target[:, active]
        au, av, bu, bv = (_evaluate(moving, c) for c in slopes)
        determinant = (1.0 + au) * (1.0 + bv) - av * bu
        step = (
            np.stack([(1.0 + bv) * residual[0] - av * residual[1], (1.0 + au) * residual[1] - bu * residual[0]])
            / determinant
        )
        estimate[:, active] = moving - step
        active = active[~(np.abs(step).max(axis=0) < _TOLERANCE)]
        if not len(active):
            break
    else:
        raise BadInput("the distortion is so strong that some sky positions appear on several pixels or on none")
    undistorted[:, is_invertible] = estimate
    return undistorted[0], undistorted[1]


def invertible_radius(a: Float, b: Float) -> float:
    """Return the distance from the boresight, in pixels, within which each sky position appears on one pixel only.

    `a` and `b` are SIP coefficients [n, n] for columns and rows. The result never exceeds 6e4 pixels, the largest
    radius of all cameras.
    """
    return _invertible_radius(a.tobytes(), b.tobytes(), a.shape, b.shape)


@lru_cache(maxsize=512)
def _invertible_radius(a: bytes, b: bytes, shape_a: tuple[int, int], shape_b: tuple[int, int]) -> float:
    polynomials = np.frombuffer(a).reshape(shape_a), np.frombuffer(b).reshape(shape_b)
    # Compute the sky area of pixels up to twice the largest distance of any camera's pixels from the boresight. A pixel
    # beyond this distance may show sky within it, if the distortion is strong.
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
