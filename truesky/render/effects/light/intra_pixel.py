"""Intra-pixel response: a pixel's centre sees more than its corners, so that sources look a little sharper.

Response 1 - a (u^2 + v^2) over the pixel, u and v from -1 to 1; its mean belongs to the quantum efficiency. It is part
of the pixel's transfer function, with which sources are drawn: once pixels are summed it is too late (a filter on the
finished image mends no more than half of it).

apply    the pixel's transfer function with the response
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lake_schema.errors import OutOfRange
from truesky.render.effects.effect import Effect
from truesky.render.effects.scene import Frame, Scene

# Below this the closed form loses digits to its own cancellation; the series of four terms has 1e-12 there.
_SMALL = 0.15


def apply(x: npt.ArrayLike, y: npt.ArrayLike, strength: float) -> Frame:
    """Transfer function of the pixel, 1 at 0.

    x, y     : [..] cycles a pixel along columns and rows
    strength : a; 0 = sinc x sinc y
    """
    if not 0.0 <= strength <= 0.5:
        raise OutOfRange("intra-pixel strength", strength, 0.0, 0.5)
    x, y = np.asarray(x, float), np.asarray(y, float)
    plain_x, plain_y = np.sinc(x), np.sinc(y)
    dip = plain_x * _second_moment(y) + _second_moment(x) * plain_y
    return np.asarray((plain_x * plain_y - strength * dip) / (1.0 - strength * 2.0 / 3.0))


def _second_moment(x: Frame) -> Frame:
    """Mean of u^2 cos(pi x u) over -1 .. 1."""
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


# Of a VIS star's brightest pixel: this times a.
_CHANGE = 0.07
EFFECT = Effect(
    "intra_pixel",
    apply,
    lambda scene: (_strength(scene),),
    lambda scene: _CHANGE * _strength(scene) * scene.peak_electrons,
)
