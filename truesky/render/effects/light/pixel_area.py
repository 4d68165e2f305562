"""Area of the sky that a pixel sees: where the optics distort, more of the diffuse sky, or less.

And a tangent plane is larger than the sky. Sources keep their light wherever they lie: theirs is drawn through the same
Jacobian.
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

# Pixels between places at which the largest change is looked for: it is a smooth polynomial.
_SAMPLE_STEP = 64


def apply(
    frame: Frame, electrons: float, u: Frame, v: Frame, stretch: Frame, rng: np.random.Generator | None = None
) -> Frame:
    """frame [ny, nx] e- -> plus electrons times `change`: what a pixel of the boresight's area has of the sky.

    electrons     : of the sky in a pixel at the boresight;  rng : not used
    u, v, stretch : as of `change`
    """
    if not 0.0 <= electrons < np.inf:
        raise OutOfRange("sky electrons", electrons, 0.0, np.inf)
    out = area_change(u, v, electrons * stretch)
    out += frame
    return out


def area_change(u: Frame, v: Frame, stretch: Frame) -> Frame:
    """[ny, nx] a pixel's area over that at the boresight, less 1.

    u [nx], v [ny] : pixels from the boresight;  stretch : coefficients of u^p v^q
    Error          : 1e-4, of what distortion and projection do to each other
    """
    across, along = (polynomial.polyvander(at, n - 1) for at, n in zip((u, v), stretch.shape, strict=True))
    return np.asarray(matrices.matmul(along, matrices.matmul(stretch.T, across.T)))


def parameters(scene: Scene) -> tuple[float, Frame, Frame, Frame]:
    """Nothing changes without a detector."""
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
    # Of the sky a tangent plane has (1 + r^2)^(-3/2).
    flat = -1.5 * (d.pixel_scale * ARCSEC) ** 2
    stretch[2, 0] += flat
    stretch[0, 2] += flat
    return scene.sky_electrons, u, v, stretch


def _contribution(scene: Scene) -> float:
    electrons, u, v, stretch = parameters(scene)
    sampled_u, sampled_v = (np.append(at[::_SAMPLE_STEP], at[-1:]) for at in (u, v))
    return electrons * float(np.abs(area_change(sampled_u, sampled_v, stretch)).max(initial=0.0))


EFFECT = Effect("pixel_area", apply, parameters, _contribution, cost=5e-3)
