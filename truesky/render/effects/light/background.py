"""Add the diffuse sky background to an image: a constant, or a plane if the sky of twilight is brighter on one side."""

from __future__ import annotations

import numpy as np

from lake_schema.errors import OutOfRange
from truesky.render.effects.effect import Effect, copy_frame, row_blocks
from truesky.render.effects.scene import Frame, Scene


def apply(
    frame: Frame,
    electrons: float,
    slopes: tuple[float, float] = (0.0, 0.0),
    rng: np.random.Generator | None = None,
    out: Frame | None = None,
) -> Frame:
    """Add the sky background to all pixels of a frame.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Expected electrons.
    electrons : float
        Expected electrons of the sky per pixel in the middle of the frame, 0 or more.
    slopes : (float, float), optional
        Relative change of the sky per column and per row. By default the sky is constant.
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
    if slopes == (0.0, 0.0):
        return np.asarray(np.add(frame, electrons, out=out))
    out = copy_frame(frame, out)
    rows, columns = (np.arange(n) - (n - 1) / 2 for n in frame.shape)
    along_rows = electrons * slopes[0] * columns
    for block in row_blocks(out):
        # The sky cannot be negative, even where a plane is far from its tangent point.
        out[block] += np.maximum(along_rows + electrons * (1.0 + slopes[1] * rows[block, None]), 0.0)
    return out


def parameters(scene: Scene) -> tuple[float, tuple[float, float]]:
    """Return the parameters of `apply` for a scene: electrons of the sky in the middle of the drawn pixels, and slopes.

    The sky of a window is that of the same pixels of the detector.
    """
    slopes, electrons, detector = scene.sky_slopes, scene.sky_electrons, scene.detector
    if scene.window is None or detector is None or slopes == (0.0, 0.0):
        return electrons, slopes
    column, row = scene.window.middle
    middle = 1.0 + slopes[0] * (column - (detector.nx - 1) / 2) + slopes[1] * (row - (detector.ny - 1) / 2)
    return max(electrons * middle, 0.0), (slopes[0] / middle, slopes[1] / middle)


EFFECT = Effect(
    "background",
    apply,
    parameters,
    lambda scene: scene.sky_electrons,
    cost=3e-3,
    in_place=True,
)
