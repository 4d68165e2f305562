"""Fourier transform of the response inside a pixel, which is largest at its centre.

The response is 1 - a (u^2 + v^2), with u and v from -1 to 1 between the edges. With a = 0 it is uniform.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Float
from lake_schema.errors import OutOfRange

# Below this value of pi times the spatial frequency (cycles per pixel), the closed form of `_second_moment` loses
# digits by cancellation. A series of five terms is used there, with an error below 1e-12.
_SMALL = 0.15


def transform(x: npt.ArrayLike, y: npt.ArrayLike, strength: float) -> Float:
    """Return the transfer function of a pixel (Fourier transform of its response to light), normalised to 1 at 0.

    Parameters
    ----------
    x, y : float array
        Spatial frequencies along columns and rows in cycles per pixel.
    strength : float
        Parameter a of the response 1 - a (u^2 + v^2) inside a pixel, 0 to 0.5. With 0 the result is sinc x sinc y.

    Returns
    -------
    float array
        Transfer function, in the shape to which `x` and `y` are broadcast.

    Raises
    ------
    OutOfRange
        If `strength` is outside its limits or NaN.
    """
    if not 0.0 <= strength <= 0.5:
        raise OutOfRange("intra-pixel strength", strength, 0.0, 0.5)
    x, y = np.asarray(x, float), np.asarray(y, float)
    plain_x, plain_y = np.sinc(x), np.sinc(y)
    dip = plain_x * _second_moment(y) + _second_moment(x) * plain_y
    return np.asarray((plain_x * plain_y - strength * dip) / (1.0 - strength * 2.0 / 3.0))


def _second_moment(x: Float) -> Float:
    """Return the mean of u^2 cos(pi x u) over u from -1 to 1, for spatial frequencies x in cycles per pixel.

    It is the Fourier transform of the term u^2 of the response inside a pixel, whose edges are at u = -1 and 1.
    """
    phase = np.pi * np.abs(x)
    q = np.where(phase < _SMALL, 1.0, phase)
    closed = np.sin(q) / q + 2.0 * np.cos(q) / q**2 - 2.0 * np.sin(q) / q**3
    square = phase**2
    series = 1.0 / 3.0 - square / 10.0 * (
        1.0 - square / 16.8 * (1.0 - square / (270.0 / 7.0) * (1.0 - square / (616.0 / 9.0)))
    )
    return np.asarray(np.where(phase < _SMALL, series, closed))
