"""Convert electrons to the digital numbers of an analogue-to-digital converter (ADC): gain, bias, rounding, range."""

from __future__ import annotations

from typing import Any

import numpy as np

from lake_schema.arrays import Array, Float
from lake_schema.errors import OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.effects.effect import Effect, map_pixels
from truesky.render.effects.scene import Frame, Scene


def apply(
    frame: Frame,
    gain: float | Float,
    bias: float | Float,
    largest: float | Float,
    rng: np.random.Generator | None = None,
    out: Frame | None = None,
) -> Frame:
    """Convert electrons to digital numbers (ADU), with clipping to the range of the converter.

    Parameters
    ----------
    frame : float array, shape (ny, nx), or (q, ny, nx) for q amplifiers
        Electrons.
    gain : float or array, shape (q,)
        Electrons per ADU, more than 0.
    bias : float or array, shape (q,)
        Bias level in ADU.
    largest : float or array, shape (q,)
        Highest output of the converter in ADU.
    rng : numpy.random.Generator, optional
        Not used.
    out : float64 array, shape of `frame`, optional
        Array for the result, which may be `frame` itself. By default a new array.

    Returns
    -------
    float array, shape of `frame`
        ADU, whole numbers from 0 to `largest`. Halves are rounded up.

    Raises
    ------
    OutOfRange
        If a gain is 0, negative, infinite or NaN. Bias and range are not checked.
    """
    if not (np.min(gain) > 0.0 and np.max(gain) < np.inf):
        raise OutOfRange("gain", gain, 0.0, np.inf)
    return map_pixels(_convert, frame, gain, bias + 0.5, largest, out=out)


def apply_signal(
    frame: Frame, gain: float, bias: float, largest: float, rng: np.random.Generator | None = None
) -> Frame:
    """Convert the signal that was estimated from an up-the-ramp exposure to digital numbers (ADU); chi^2 is unchanged.

    Parameters
    ----------
    frame : float array, shape (2, ny, nx)
        Signal in electrons, and chi^2 of the fit to the ramp.
    gain : float
        Electrons per ADU, more than 0.
    bias : float
        Bias level in ADU.
    largest : float
        Highest output of the converter in ADU.
    rng : numpy.random.Generator, optional
        Not used.

    Returns
    -------
    float array, shape (2, ny, nx)
        Signal in ADU, whole numbers from 0 to `largest`, and chi^2.

    Raises
    ------
    OutOfRange
        If the gain is 0, negative, infinite or NaN.
    """
    return np.stack([apply(frame[0], gain, bias, largest), frame[1]])


@jit
def _convert(pixels: Any, gain: float, offset: float, largest: float) -> None:
    for i in range(len(pixels)):
        pixels[i] = min(max(np.floor(pixels[i] / gain + offset), 0.0), largest)


def _parameters(scene: Scene) -> tuple[float | Float, float | Float, float | Float]:
    gain, bias = scene.amplifier_values("gain", "electron / adu"), scene.amplifier_values("bias", "adu")
    return gain, bias, scene.amplifier_values("adc_max", "adu")


def pixel_type(scene: Scene) -> type[np.uint16] | type[np.int32]:
    """Return the integer type of an image file's pixels: uint16, or int32 if a converter's range exceeds 65535 ADU."""
    largest = float(np.max(scene.amplifier_values("adc_max", "adu")))
    return np.uint16 if largest <= np.iinfo(np.uint16).max else np.int32


def to_file_type(numbers: Frame, scene: Scene) -> Array:
    """Convert digital numbers (whole ADU, as returned by `apply`) to the integer type of an image file."""
    return numbers.astype(pixel_type(scene))


def convert_groups(groups: Frame, scene: Scene) -> Array:
    """Convert the groups of an up-the-ramp exposure from electrons to ADU, in the integer type of an image file.

    A group is the mean of several reads. The array `groups` has the shape (groups, ny, nx), and so has the result. Its
    values are whole numbers from 0 to the highest output of the converter, including the bias level.
    """
    numbers = _parameters(scene)
    return np.stack([to_file_type(apply(group, *numbers), scene) for group in groups])


def _contribution(scene: Scene) -> float:
    gain, bias, _ = _parameters(scene)
    return float(np.max(gain * (bias + 0.5)))


EFFECT = Effect("adc", apply, _parameters, _contribution, optional=False, cost=3e-3, in_place=True)
SIGNAL = Effect("signal_adc", apply_signal, _parameters, _contribution, optional=False, cost=8e-3)
