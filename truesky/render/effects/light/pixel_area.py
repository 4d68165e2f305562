"""Area of the sky that a pixel covers: optical distortion changes it, and with it the sky background in the pixel.

The projection of the sky on a tangent plane also changes the area. Sources keep their flux at any position, because
their images are drawn with the same local scale of the sky.
"""

from __future__ import annotations

import numpy as np
from numpy.polynomial import polynomial

from lake_schema.errors import OutOfRange
from truesky.numerics import matrices
from truesky.render.camera import distortion
from truesky.render.camera.pointing import ARCSEC
from truesky.render.effects.effect import Effect, copy_frame, row_blocks
from truesky.render.effects.scene import Frame, Scene

# The largest change of the sky area on a detector is found from pixels that are this number of pixels apart. The change
# is a smooth polynomial of the position.
_SAMPLE_STEP = 64


def apply(
    frame: Frame,
    electrons: float,
    u: Frame,
    v: Frame,
    stretch: Frame,
    rng: np.random.Generator | None = None,
    out: Frame | None = None,
) -> Frame:
    """Add the change of the sky background that is caused by the different sky areas of pixels.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Expected electrons, including the sky background of a pixel at the boresight.
    electrons : float
        Sky background of a pixel at the boresight in electrons, 0 or more.
    u : float array, shape (nx,)
        Columns relative to the boresight in pixels.
    v : float array, shape (ny,)
        Rows relative to the boresight in pixels.
    stretch : float array, shape (n, m)
        Coefficients of u^p v^q, at index [p, q], of the sky area of a pixel relative to the boresight, minus 1.
    rng : numpy.random.Generator, optional
        Not used.
    out : float64 array, shape of `frame`, optional
        Array for the result, which may be `frame` itself. By default a new array.

    Returns
    -------
    float array, shape (ny, nx)
        Expected electrons with the sky background of each pixel's area.

    Raises
    ------
    OutOfRange
        If `electrons` is negative, infinite or NaN.
    """
    if not 0.0 <= electrons < np.inf:
        raise OutOfRange("sky electrons", electrons, 0.0, np.inf)
    out = copy_frame(frame, out)
    along, across = _area_factors(u, v, electrons * stretch)
    for rows in row_blocks(out):
        out[rows] += matrices.matmul(along[rows], across)
    return out


def area_change(u: Frame, v: Frame, stretch: Frame) -> Frame:
    """Return the sky area of each pixel divided by that of a pixel at the boresight, minus 1.

    Parameters
    ----------
    u : float array, shape (nx,)
        Columns relative to the boresight in pixels.
    v : float array, shape (ny,)
        Rows relative to the boresight in pixels.
    stretch : float array, shape (n, m)
        Coefficients of u^p v^q, at index [p, q], of the relative change of the area, with u and v in pixels.

    Returns
    -------
    float array, shape (ny, nx)
        Relative change of the area.

    Notes
    -----
    The error is 1e-4, because the product of the changes by distortion and by projection is neglected.
    """
    return np.asarray(matrices.matmul(*_area_factors(u, v, stretch)))


def _area_factors(u: Frame, v: Frame, stretch: Frame) -> tuple[Frame, Frame]:
    """Return two matrices, (ny, m) and (m, nx), whose product is the result of `area_change`."""
    across, along = (polynomial.polyvander(at, n - 1) for at, n in zip((u, v), stretch.shape, strict=True))
    return np.asarray(along, float), np.asarray(matrices.matmul(stretch.T, across.T))


def parameters(scene: Scene) -> tuple[float, Frame, Frame, Frame]:
    """Return the parameters of `apply` for a scene: sky electrons, columns u, rows v, and coefficients of the area.

    The sky electrons are for a pixel at the boresight. u [nx] and v [ny] are the columns and rows of the detector
    relative to the boresight in pixels. The coefficients [p, q] of u^p v^q give the sky area of a pixel divided by
    the area at the boresight, minus 1. For a scene without detector, u, v and the coefficients are 0.
    """
    d = scene.detector
    if d is None:
        return scene.sky_electrons, np.zeros(scene.nx), np.zeros(scene.ny), np.zeros((1, 1))
    along, up = d.from_focal_plane(d.x, d.y)
    u = np.arange(d.nx) - (d.nx - 1) / 2 + along / d.pixel_scale
    v = np.arange(d.ny) - (d.ny - 1) / 2 + up / d.pixel_scale
    stretch = np.zeros((3, 3))
    if d.distortion_terms:
        stretch = distortion.area_change(d.distortion_terms, d.pixel_scale * d.axes)
    # An area on the tangent plane, at the distance r (rad) from the boresight, covers (1 + r^2)^(-3/2) of it on the
    # sky.
    flat = -1.5 * (d.pixel_scale * ARCSEC) ** 2
    stretch[2, 0] += flat
    stretch[0, 2] += flat
    return scene.sky_electrons, u, v, stretch


def _contribution(scene: Scene) -> float:
    electrons, u, v, stretch = parameters(scene)
    sampled_u, sampled_v = (np.append(at[::_SAMPLE_STEP], at[-1:]) for at in (u, v))
    return electrons * float(np.abs(area_change(sampled_u, sampled_v, stretch)).max(initial=0.0))


EFFECT = Effect("pixel_area", apply, parameters, _contribution, cost=5e-3, in_place=True)
