"""Intra-pixel response: the centre of a pixel is more sensitive than its corners, so that sources are slightly sharper.

The response is 1 - a (u^2 + v^2) over the pixel, with u and v from -1 to 1. Its mean is part of the quantum efficiency.
The response belongs to the pixel's transfer function, with which sources are drawn: it cannot be applied after light is
summed in pixels. A filter on the final image would correct at most half of it.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lake_schema.errors import OutOfRange
from truesky.render.effects.effect import Effect
from truesky.render.effects.scene import Frame, Scene

# Below this phase the closed form loses digits by cancellation; the series of four terms has an error of 1e-12 there.
_SMALL = 0.15


def apply(x: npt.ArrayLike, y: npt.ArrayLike, strength: float) -> Frame:
    """Transfer function of a pixel, normalised to 1 at 0.

    Parameters
    ----------
    x, y : float array
        Spatial frequencies along columns and rows in cycles per pixel.
    strength : float
        Parameter a of the response, 0 to 0.5. With 0 the result is sinc x sinc y.

    Returns
    -------
    float array
        Transfer function, in the common shape of `x` and `y`.

    Raises
    ------
    OutOfRange
        If `strength` is outside its limits.
    """
    if not 0.0 <= strength <= 0.5:
        raise OutOfRange("intra-pixel strength", strength, 0.0, 0.5)
    x, y = np.asarray(x, float), np.asarray(y, float)
    plain_x, plain_y = np.sinc(x), np.sinc(y)
    dip = plain_x * _second_moment(y) + _second_moment(x) * plain_y
    return np.asarray((plain_x * plain_y - strength * dip) / (1.0 - strength * 2.0 / 3.0))


def _second_moment(x: Frame) -> Frame:
    """Return the mean of u^2 cos(pi x u) for u from -1 to 1."""
    phase = np.pi * np.abs(x)
    q = np.where(phase < _SMALL, 1.0, phase)
    closed = np.sin(q) / q + 2.0 * np.cos(q) / q**2 - 2.0 * np.sin(q) / q**3
    square = phase**2
    series = 1.0 / 3.0 - square / 10.0 * (
        1.0 - square / 16.8 * (1.0 - square / (270.0 / 7.0) * (1.0 - square / (616.0 / 9.0)))
    )
    return np.asarray(np.where(phase < _SMALL, series, closed))


def _strength(scene: Scene) -> float:
    return scene.value("intra_pixel_response", "")


# Relative change of the brightest pixel of a VIS star per unit of a.
_CHANGE = 0.07
EFFECT = Effect(
    "intra_pixel",
    apply,
    lambda scene: (_strength(scene),),
    lambda scene: _CHANGE * _strength(scene) * scene.peak_electrons,
)
