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
    start: tuple[float, float] = (0.0, 0.0),
    rng: np.random.Generator | None = None,
    out: Frame | None = None,
) -> Frame:
    """Add the sky background to all pixels of a frame.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Expected electrons.
    electrons : float
        Expected electrons of the sky per pixel in the middle of the detector, 0 or more.
    slopes : (float, float), optional
        Relative change of the sky per column and per row. By default the sky is constant.
    start : (float, float), optional
        Column and row of the first pixel of the frame, relative to the middle of the detector.
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
    rows, columns = (first + np.arange(n) for first, n in zip(start[::-1], frame.shape, strict=True))
    along_rows = electrons * slopes[0] * columns
    for block in row_blocks(out):
        # The sky cannot be negative, even where a plane is far from its tangent point.
        out[block] += np.maximum(along_rows + electrons * (1.0 + slopes[1] * rows[block, None]), 0.0)
    return out


def parameters(scene: Scene) -> tuple[float, tuple[float, float], tuple[float, float]]:
    """Return the parameters of `apply` for a scene: electrons of the sky, slopes, and position of the first pixel.

    The sky of a window is that of the same pixels of the detector.
    """
    shape = (scene.nx, scene.ny) if scene.detector is None else (scene.detector.nx, scene.detector.ny)
    first = (0, 0) if scene.window is None else (scene.window.column, scene.window.row)
    return scene.sky_electrons, scene.sky_slopes, (first[0] - (shape[0] - 1) / 2, first[1] - (shape[1] - 1) / 2)


EFFECT = Effect(
    "background",
    apply,
    parameters,
    lambda scene: scene.sky_electrons,
    cost=3e-3,
    in_place=True,
)
