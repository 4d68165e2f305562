"""Area of the sky per pixel: distortion changes the light of the diffuse sky in a pixel.

The projection on a tangent plane also changes the area. Sources keep their flux at any position, because their images
are drawn through the same Jacobian.
"""

from __future__ import annotations

import numpy as np
from numpy.polynomial import polynomial

from lake_schema.errors import OutOfRange
from truesky.numerics import matrices
from truesky.render.camera import distortion
from truesky.render.camera.pointing import ARCSEC
from truesky.render.effects.effect import Effect
from truesky.render.effects.scene import Frame, Scene

# Pixels between samples for the largest change, which is a smooth polynomial.
_SAMPLE_STEP = 64


def apply(
    frame: Frame, electrons: float, u: Frame, v: Frame, stretch: Frame, rng: np.random.Generator | None = None
) -> Frame:
    """Add the difference of the sky by the area of pixels.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Expected electrons with the sky of a pixel at the boresight.
    electrons : float
        Electrons of the sky in a pixel at the boresight, 0 or more.
    u, v, stretch : float array
        Same as in `area_change`.
    rng : numpy.random.Generator, optional
        Not used.

    Returns
    -------
    float array, shape (ny, nx)
        Expected electrons.

    Raises
    ------
    OutOfRange
        If `electrons` is negative or infinite.
    """
    if not 0.0 <= electrons < np.inf:
        raise OutOfRange("sky electrons", electrons, 0.0, np.inf)
    out = area_change(u, v, electrons * stretch)
    out += frame
    return out


def area_change(u: Frame, v: Frame, stretch: Frame) -> Frame:
    """Area of each pixel relative to a pixel at the boresight, minus 1.

    Parameters
    ----------
    u : float array, shape (nx,)
        Columns relative to the boresight in pixels.
    v : float array, shape (ny,)
        Rows relative to the boresight in pixels.
    stretch : float array, shape (p, q)
        Coefficients of u^p v^q.

    Returns
    -------
    float array, shape (ny, nx)
        Relative change of the area.

    Notes
    -----
    The error is 1e-4, because the product of distortion and projection is neglected.
    """
    across, along = (polynomial.polyvander(at, n - 1) for at, n in zip((u, v), stretch.shape, strict=True))
    return np.asarray(matrices.matmul(along, matrices.matmul(stretch.T, across.T)))


def parameters(scene: Scene) -> tuple[float, Frame, Frame, Frame]:
    """Return the parameters of `apply`. Without a detector, the area of pixels does not change."""
    d = scene.detector
    if d is None:
        return scene.sky_electrons, np.zeros(scene.nx), np.zeros(scene.ny), np.zeros((1, 1))
    cosine, sine = np.cos(np.radians(d.rotation)), np.sin(np.radians(d.rotation))
    u = np.arange(d.nx) - (d.nx - 1) / 2 + (cosine * d.x + sine * d.y) / d.pixel_scale
    v = np.arange(d.ny) - (d.ny - 1) / 2 + (cosine * d.y - sine * d.x) / d.pixel_scale
    matrix = d.pixel_scale * np.array([[cosine, -sine], [sine, cosine]])
    stretch = np.zeros((3, 3))
    if d.distortion_terms:
        stretch = distortion.area_change(d.distortion_terms, matrix)
    # An area on the tangent plane covers (1 + r^2)^(-3/2) of this area on the sky.
    flat = -1.5 * (d.pixel_scale * ARCSEC) ** 2
    stretch[2, 0] += flat
    stretch[0, 2] += flat
    return scene.sky_electrons, u, v, stretch


def _contribution(scene: Scene) -> float:
    electrons, u, v, stretch = parameters(scene)
    sampled_u, sampled_v = (np.append(at[::_SAMPLE_STEP], at[-1:]) for at in (u, v))
    return electrons * float(np.abs(area_change(sampled_u, sampled_v, stretch)).max(initial=0.0))


EFFECT = Effect("pixel_area", apply, parameters, _contribution, cost=5e-3)
