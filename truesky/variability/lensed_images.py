"""Compute the images of point sources behind singular isothermal ellipsoids (SIE): positions, magnifications, delays.

In units of its scale, the potential of an isothermal lens is the distance r from the lens times a function f of the
direction phi. All properties of the images of a source at beta then follow from one function of the direction, with the
unit vector e(phi)::

    r(phi) = beta . e(phi) + f(phi),    f(phi) = alpha(phi) . e(phi)

Each stationary point of r(phi) with r > 0 is an image at the distance r from the lens. Its magnification is -r / r'',
and its light arrives earlier than without the lens by r^2 / 2 - beta^2 / 2 times the time-delay distance / c. These
forms have no difference of large numbers if two images merge, if the lens is almost round, or if the source is almost
behind its centre.

Positions are in arcsec east and north of the lens on the tangent plane, and angles are in deg from north through east.

References
----------
Kormann, Schneider & Bartelmann 1994, A&A 284, 285 (the deflection, eqs. 27a, 27b)
Witt, Mao & Keeton 2000, ApJ 544, 98 (delays of isothermal lenses from the distances of the images)
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Float, Int
from lake_schema.errors import BadInput
from lake_schema.units import LIGHT_KM_S
from truesky.cosmology import Cosmology

# Largest absolute magnification of an image. A supernova with a radius of 1e15 cm at z = 1, or 4e-8 arcsec, is
# magnified at most about sqrt(1 arcsec / 4e-8 arcsec) = 5000 times at a caustic of a lens with an Einstein radius of
# 1 arcsec.
MAX_MAGNIFICATION = 1e4
# Largest axis ratio of a lens. The image of a point behind a round lens is a ring; behind this one, it is four images.
_ROUNDEST = 1.0 - 1e-6
# Number of directions, uniform over the circle, between which images are searched. Pairs of images between two
# directions are found, too. Three images between two directions (0.4 deg) may count as one image, but then each is
# magnified more than MAX_MAGNIFICATION (measured for axis ratios from 0.3 to 0.95).
_DIRECTIONS = 1024
# Number of bisections after which the direction of an image has an error below 1e-15 rad.
_BISECTIONS = 44
# Number of sources for which the directions are computed together, to save memory.
_BLOCK = 512
# One Mpc in days of light travel: 3.0856775814913673e19 km (IAU 2015 resolution B2).
_MPC_DAYS = 3.0856775814913673e19 / LIGHT_KM_S / 86400.0
_ARCSEC = np.pi / 180.0 / 3600.0


@dataclass(frozen=True, slots=True, eq=False)
class Ellipsoids:
    """Singular isothermal ellipsoids, the lenses of n sources.

    Attributes
    ----------
    radius : float array, shape (n,)
        Einstein radius, arcsec.
    axis_ratio : float array, shape (n,)
        Minor / major axis.
    angle : float array, shape (n,)
        Position angle of the major axis, deg from north through east.
    """

    radius: Float
    axis_ratio: Float
    angle: Float


@dataclass(frozen=True, slots=True, eq=False)
class Images:
    """The m images of n sources, sorted by source, then by arrival.

    Attributes
    ----------
    source : int array, shape (m,)
        Index of the source.
    number : int array, shape (m,)
        Number of the image of its source, from 1, in the order of arrival.
    east, north : float array, shape (m,)
        Position relative to the lens, arcsec.
    magnification : float array, shape (m,)
        Flux relative to the source, negative for mirrored images (saddle points of the arrival time). The absolute
        value is at most MAX_MAGNIFICATION.
    lag : float array, shape (m,)
        Fermat potential minus that of the first image of the source, arcsec2; at least 0.
    """

    source: Int
    number: Int
    east: Float
    north: Float
    magnification: Float
    lag: Float


def find_images(lenses: Ellipsoids, east: npt.ArrayLike, north: npt.ArrayLike) -> Images:
    """Find the images of point sources.

    Parameters
    ----------
    lenses : Ellipsoids
        The n lenses, one for each source.
    east, north : float array, shape (n,)
        Position of each source relative to its lens, arcsec.

    Returns
    -------
    Images
        At least one image per source, at most four.

    Raises
    ------
    BadInput
        If an Einstein radius is not positive, an axis ratio is not in (0, 1], or a value is not finite.

    Notes
    -----
    An image near the centre of the lens has a magnification close to 0: it appears at r = 0 if the source enters the
    circle-like curve ("cut") inside which a singular lens has at least two images.
    """
    place = np.broadcast_arrays(np.asarray(east, float), np.asarray(north, float))
    radius, axis_ratio, angle = (np.asarray(x, float) for x in (lenses.radius, lenses.axis_ratio, lenses.angle))
    _check(radius, axis_ratio, np.array([*place, angle]))
    sin, cos = np.sin(np.radians(angle)), np.cos(np.radians(angle))
    along, across = place[0] * sin + place[1] * cos, place[0] * cos - place[1] * sin
    system = _Systems(radius, np.minimum(axis_ratio, _ROUNDEST), along, across)
    pieces = [_directions(system.select(slice(i, i + _BLOCK)), i) for i in range(0, len(radius), _BLOCK)]
    source = np.concatenate([np.empty(0, np.int64), *(piece[0] for piece in pieces)])
    phi = np.concatenate([np.empty(0), *(piece[1] for piece in pieces)])
    r, _, curvature = system.select(source).distance(phi)
    real = r > 0.0
    source, phi, r, curvature = source[real], phi[real], r[real], curvature[real]
    order = np.lexsort((-r, source))
    source, phi, r, curvature = source[order], phi[order], r[order], curvature[order]
    first = np.searchsorted(source, source)
    inverse = -curvature / r
    inverse = np.where(
        np.abs(inverse) < 1.0 / MAX_MAGNIFICATION, np.copysign(1.0 / MAX_MAGNIFICATION, inverse), inverse
    )
    along, across = r * np.cos(phi), r * np.sin(phi)
    return Images(
        source,
        np.arange(len(source)) - first + 1,
        along * sin[source] + across * cos[source],
        along * cos[source] - across * sin[source],
        1.0 / inverse,
        0.5 * (r[first] - r) * (r[first] + r),
    )


def delays(lag: npt.ArrayLike, z_lens: npt.ArrayLike, z_source: npt.ArrayLike, cosmology: Cosmology) -> Float:
    """Return how much later images arrive, from the differences of the Fermat potential.

    Parameters
    ----------
    lag : float array, shape (m,)
        Difference of the Fermat potential, arcsec2, as in `Images`.
    z_lens, z_source : float array, shape (m,)
        Redshifts of lens and source of each image.
    cosmology : Cosmology
        Parameters of the universe.

    Returns
    -------
    float array, shape (m,)
        Delay at the observer in days. The relative error is that of the time-delay distance, 1e-10.

    Raises
    ------
    BadInput
        If a source is not behind its lens.
    """
    return np.asarray(lag, float) * _ARCSEC**2 * time_delay_distance(z_lens, z_source, cosmology) * _MPC_DAYS


def time_delay_distance(z_lens: npt.ArrayLike, z_source: npt.ArrayLike, cosmology: Cosmology) -> Float:
    """Return the time-delay distance (1 + z_l) D_l D_s / D_ls of lenses in a flat universe.

    Parameters
    ----------
    z_lens, z_source : float array, shape (n,)
        Redshifts of lens and source.
    cosmology : Cosmology
        Parameters of the universe.

    Returns
    -------
    float array, shape (n,)
        Distance in Mpc; in comoving distances it is chi_l chi_s / (chi_s - chi_l).

    Raises
    ------
    BadInput
        If a source is not behind its lens.
    """
    lens, source = np.broadcast_arrays(np.asarray(z_lens, float), np.asarray(z_source, float))
    wrong = ~((source > lens) & (lens > 0.0))
    if wrong.any():
        i = wrong.ravel().argmax()
        problem = f"z_lens = {lens.ravel()[i]:g} and z_source = {source.ravel()[i]:g}"
        raise BadInput(f"{problem}: both must be positive, and the source must be behind the lens")
    between = cosmology.comoving_separation(lens, source)
    return cosmology.comoving_distance(lens) * cosmology.comoving_distance(source) / between / cosmology.h


@dataclass(frozen=True, slots=True, eq=False)
class _Systems:
    """Lenses, and positions of their sources (arcsec) along and across the major axis of the lens; shape (n,)."""

    radius: Float
    axis_ratio: Float
    along: Float
    across: Float

    def select(self, which: slice | Int | tuple[slice | None, ...]) -> _Systems:
        return _Systems(self.radius[which], self.axis_ratio[which], self.along[which], self.across[which])

    def distance(self, phi: Float) -> tuple[Float, Float, Float]:
        """Return r(phi) of the module and its first two derivatives, arcsec; phi (rad) is measured from the major axis.

        The second derivative follows from f + f'' = sqrt(q) radius / sqrt(q^2 cos^2 phi + sin^2 phi), twice the
        convergence times r.
        """
        q, cos, sin = self.axis_ratio, np.cos(phi), np.sin(phi)
        scale, flat, psi = self.radius * np.sqrt(q), np.sqrt((1.0 - q) * (1.0 + q)), np.hypot(q * cos, sin)
        x = self.along + scale / flat * np.arctan(flat * cos / psi)
        y = self.across + scale / flat * np.arctanh(flat * sin / psi)
        r = x * cos + y * sin
        return r, y * cos - x * sin, scale / psi - r


def _directions(systems: _Systems, first: int) -> tuple[Int, Float]:
    """Return the stationary points of r(phi) of all systems: indices of the systems plus `first`, and phi in rad."""
    # The first angle is arbitrary, so that no image is exactly in one of the directions.
    phi = 0.1234567 + np.linspace(0.0, 2.0 * np.pi, _DIRECTIONS + 1)
    _, slope, curvature = systems.select((slice(None), None)).distance(phi)
    rises, turns = (np.diff(values < 0.0, axis=1) for values in (slope, curvature))
    # An interval in which only the curvature changes its sign has no stationary point or two, one on each side of the
    # extremum of the slope.
    row, at = np.nonzero(turns & ~rises)
    middle = _bisect(lambda x: systems.select(row).distance(x)[2], phi[at], phi[at + 1])
    two = (systems.select(row).distance(middle)[1] < 0.0) != (slope[row, at] < 0.0)
    row, at, middle = row[two], at[two], middle[two]
    single, place = np.nonzero(rises)
    index = np.concatenate([single, row, row])
    low, high = np.concatenate([phi[place], phi[at], middle]), np.concatenate([phi[place + 1], middle, phi[at + 1]])
    return index + first, _bisect(lambda x: systems.select(index).distance(x)[1], low, high)


def _bisect(function: Callable[[Float], Float], low: Float, high: Float) -> Float:
    """Return a point between each pair of `low` and `high` at which the function changes its sign."""
    negative = function(low) < 0.0
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        same_sign = (function(middle) < 0.0) == negative
        low, high = np.where(same_sign, middle, low), np.where(same_sign, high, middle)
    return 0.5 * (low + high)


def _check(radius: Float, axis_ratio: Float, positions: Float) -> None:
    if not ((radius > 0.0) & np.isfinite(radius)).all():
        raise BadInput("einstein_radius of a lens must be positive")
    if not ((axis_ratio > 0.0) & (axis_ratio <= 1.0)).all():
        raise BadInput("axis_ratio of a lens must be above 0 and at most 1")
    if not np.isfinite(positions).all():
        raise BadInput("position or position_angle of a lens is not a number")
