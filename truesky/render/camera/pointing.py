"""Pointing of a camera: the boresight that puts a detector on a target, and sky positions of focal-plane positions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Bool, Float
from truesky.numerics import matrices
from truesky.render.camera import distortion
from truesky.render.camera.detectors import Detector

# One arcsecond in radians.
ARCSEC = np.pi / 180.0 / 3600.0


def boresight_for(detector: Detector, ra: float, dec: float, position_angle: float) -> tuple[float, float, float]:
    """Return the boresight and position angle that put a detector's centre on a target.

    Parameters
    ----------
    detector : Detector
        The detector.
    ra, dec : float
        Right ascension and declination of the target, deg.
    position_angle : float
        Angle of the focal plane's y axis *at the target*, deg from north through east.

    Returns
    -------
    (float, float, float)
        Right ascension in [0, 360) and declination of the boresight, and position angle of the y axis at the boresight,
        deg.

    Notes
    -----
    The position angles at the target and at the boresight differ because meridians converge. The result is defined
    everywhere, including the poles.
    """
    # Axes of the vector `centre`: minus the focal plane's x axis (east if y points north), its y axis, and outward
    # along the boresight. They are right-handed.
    x, y = (float(place) for place in distortion.distort(detector.x, detector.y, detector.distortion_terms))
    centre = np.array([-x * ARCSEC, y * ARCSEC, 1.0])
    camera = _triad(centre, np.array([0.0, 1.0, 0.0]))
    east, north, out = basis(ra, dec)
    angle = np.radians(position_angle)
    sky = _triad(out, np.sin(angle) * east + np.cos(angle) * north)
    rotation = matrices.matmul(sky, camera.T)
    boresight, up = rotation[:, 2], rotation[:, 1]
    ra0 = float(np.degrees(np.arctan2(boresight[1], boresight[0])) % 360.0)
    dec0 = float(np.degrees(np.arctan2(boresight[2], np.hypot(boresight[0], boresight[1]))))
    east0, north0, _ = basis(ra0, dec0)
    return ra0, dec0, float(np.degrees(np.arctan2(matrices.matmul(up, east0), matrices.matmul(up, north0))))


def sky_of_plane(
    x: npt.ArrayLike, y: npt.ArrayLike, ra: float, dec: float, position_angle: float
) -> tuple[Float, Float]:
    """Convert focal-plane coordinates on the tangent plane to right ascension and declination.

    Parameters
    ----------
    x, y : array_like
        Focal-plane coordinates relative to the boresight, arcsec; x points west if the position angle is 0.
    ra, dec : float
        Right ascension and declination of the boresight, deg.
    position_angle : float
        Angle of the y axis at the boresight, deg from north through east.

    Returns
    -------
    (float array, float array)
        Right ascension in [0, 360) and declination, deg.
    """
    angle = np.radians(position_angle)
    u, v = np.asarray(x, float) * ARCSEC, np.asarray(y, float) * ARCSEC
    east, north, out = basis(ra, dec)
    to_east, to_north = np.sin(angle) * v - np.cos(angle) * u, np.cos(angle) * v + np.sin(angle) * u
    to = out[:, None] + east[:, None] * to_east.ravel() + north[:, None] * to_north.ravel()
    lon = np.degrees(np.arctan2(to[1], to[0])) % 360.0
    lat = np.degrees(np.arctan2(to[2], np.hypot(to[0], to[1])))
    return lon.reshape(u.shape), lat.reshape(u.shape)


def plane_of_sky(places: Float, ra: float, dec: float, position_angle: float) -> tuple[Float, Float, Bool]:
    """Convert directions to focal-plane coordinates on the tangent plane, the inverse of `sky_of_plane`.

    Parameters
    ----------
    places : float array, shape (n, 3)
        Unit vectors.
    ra, dec : float
        Right ascension and declination of the boresight, deg.
    position_angle : float
        Angle of the y axis at the boresight, deg from north through east.

    Returns
    -------
    x, y : float array, shape (n,)
        Focal-plane coordinates relative to the boresight, arcsec; x points west if the position angle is 0.
    is_near : bool array, shape (n,)
        True for directions less than 60 deg from the boresight. The coordinates of others have no meaning.
    """
    to_east, to_north, to_out = ((places * axis.ravel()).sum(axis=-1) for axis in basis(ra, dec))
    is_near, angle = to_out > 0.5, np.radians(position_angle)
    to_east, to_north = (
        np.divide(v, to_out, out=np.zeros_like(v), where=is_near) / ARCSEC for v in (to_east, to_north)
    )
    x = to_north * np.sin(angle) - to_east * np.cos(angle)
    return x, to_east * np.sin(angle) + to_north * np.cos(angle), is_near


def outline(detectors: Sequence[Detector]) -> tuple[Float, Float]:
    """Return the tangent-plane positions of the centre and corners of n detectors: x and y, each float[n, 5] in arcsec.

    The centre of each detector comes first, then its corners, in order around the detector. Optical distortion is
    included.
    """
    column = np.array([0.0, -0.5, 0.5, 0.5, -0.5])
    row = np.array([0.0, -0.5, -0.5, 0.5, 0.5])
    width = np.array([[d.nx * d.pixel_scale] for d in detectors]) * column
    height = np.array([[d.ny * d.pixel_scale] for d in detectors]) * row
    # The axes of a detector, float[2, 2, n, 1].
    axes = np.array([d.axes for d in detectors]).transpose(1, 2, 0)[..., None]
    x = np.array([[d.x] for d in detectors]) + axes[0, 0] * width + axes[0, 1] * height
    y = np.array([[d.y] for d in detectors]) + axes[1, 0] * width + axes[1, 1] * height
    for bending in {d.distortion_terms for d in detectors if d.distortion_terms}:
        has_terms = np.array([d.distortion_terms == bending for d in detectors])
        x[has_terms], y[has_terms] = distortion.distort(x[has_terms], y[has_terms], bending)
    return x, y


def basis(ra: npt.ArrayLike, dec: npt.ArrayLike) -> tuple[Float, Float, Float]:
    """Return the unit vectors that point east, north and outward at sky positions (deg), each of shape (3, ...)."""
    lon, lat = np.radians(np.asarray(ra, float)), np.radians(np.asarray(dec, float))
    zero = np.zeros_like(lon * lat)
    east = np.stack([-np.sin(lon) + zero, np.cos(lon) + zero, zero])
    north = np.stack([-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat) + zero])
    out = np.stack([np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat) + zero])
    return east, north, out


def _triad(direction: Float, along: Float) -> Float:
    """Return a matrix, float[3, 3], with orthonormal columns.

    The first column is the unit vector along `direction`. The second one is the unit vector along the component of
    `along` that is perpendicular to `direction`. The third one is the cross product of the first and the second.
    """
    first = direction / np.sqrt(matrices.matmul(direction, direction))
    second = along - first * matrices.matmul(first, along)
    second = second / np.sqrt(matrices.matmul(second, second))
    return np.stack([first, second, np.cross(first, second)], axis=1)
