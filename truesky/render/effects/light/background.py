"""Add the diffuse sky background to an image: the same number of expected electrons in every pixel."""

from __future__ import annotations

import numpy as np

from lake_schema.errors import OutOfRange
from truesky.render.effects.effect import Effect
from truesky.render.effects.scene import Frame


def apply(frame: Frame, electrons: float, rng: np.random.Generator | None = None, out: Frame | None = None) -> Frame:
    """Add the sky background, a constant, to all pixels of a frame.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Expected electrons.
    electrons : float
        Expected electrons of the sky per pixel, 0 or more.
    rng : numpy.random.Generator, optional
        Not used.
    out : float64 array, shape of `frame`, optional
        Array for the result, which may be `frame` itself. By default a new array.

    Returns
    -------
    float array, shape (ny, nx)
        Expected electrons including sky.

    Raises
    ------
    OutOfRange
        If `electrons` is negative, infinite or NaN.
    """
    if not 0.0 <= electrons < np.inf:
        raise OutOfRange("sky electrons", electrons, 0.0, np.inf)
    return np.add(frame, electrons, out=out)


EFFECT = Effect(
    "background",
    apply,
    lambda scene: (scene.sky_electrons,),
    lambda scene: scene.sky_electrons,
    cost=3e-3,
    in_place=True,
)
