"""Analogue-to-digital conversion: gain, bias, rounding, the converter's range.

as_stored   what the converter gives, in as many bits as a file has for it
"""

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
) -> Frame:
    """Electrons [ny, nx] -> ADU, whole numbers in [0, largest].

    gain : electrons per ADU;  bias : ADU;  each may be [q] of the amplifiers of a frame [q, ny, nx]
    frame : e-;  largest : ADU that the converter can give;  rng : not used
    """
    if not (np.min(gain) > 0.0 and np.max(gain) < np.inf):
        raise OutOfRange("gain", gain, 0.0, np.inf)
    return map_pixels(_convert, frame, gain, bias + 0.5, largest)


def apply_signal(
    frame: Frame, gain: float, bias: float, largest: float, rng: np.random.Generator | None = None
) -> Frame:
    """[2, ny, nx] signal of a ramp, e-, and its chi^2 -> the signal in ADU, and chi^2 as it is.

    frame : signal and chi^2;  gain, bias, largest, rng : as of `apply`
    """
    return np.stack([apply(frame[0], gain, bias, largest), frame[1]])


@jit
def _convert(electrons: Any, numbers: Any, gain: float, offset: float, largest: float) -> None:
    for i in range(len(electrons)):
        numbers[i] = min(max(np.floor(electrons[i] / gain + offset), 0.0), largest)


def _parameters(scene: Scene) -> tuple[float | Float, float | Float, float | Float]:
    gain, bias = scene.amplifier_values("gain", "electron / adu"), scene.amplifier_values("bias", "adu")
    return gain, bias, scene.amplifier_values("adc_max", "adu")


def pixel_type(scene: Scene) -> type[np.uint16] | type[np.int32]:
    """Of a file: 16 bits without a sign; 32 where a converter has more than 16."""
    largest = float(np.max(scene.amplifier_values("adc_max", "adu")))
    return np.uint16 if largest <= np.iinfo(np.uint16).max else np.int32


def to_file_type(numbers: Frame, scene: Scene) -> Array:
    """Whole ADU, as `apply` gives them -> the same in the type of a file."""
    return numbers.astype(pixel_type(scene))


def convert_groups(groups: Frame, scene: Scene) -> Array:
    """Groups of a ramp [groups, ny, nx] e- -> ADU."""
    numbers = _parameters(scene)
    return np.stack([to_file_type(apply(group, *numbers), scene) for group in groups])


def _contribution(scene: Scene) -> float:
    gain, bias, _ = _parameters(scene)
    return float(np.max(gain * (bias + 0.5)))


EFFECT = Effect("adc", apply, _parameters, _contribution, optional=False, cost=3e-3)
SIGNAL = Effect("signal_adc", apply_signal, _parameters, _contribution, optional=False, cost=8e-3)
