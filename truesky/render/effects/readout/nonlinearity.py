"""Nonlinearity of the output amplifier: its gain falls towards saturation, and for the first electrons.

For n electrons, with the parameters a (`high`), b (`low`) and n0 (`knee`)::

    measured = s - b n0 (1 - exp(-s / n0)),    s = n / (1 + a n / saturation)
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lake_schema.arrays import Float
from lake_schema.errors import OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.effects.effect import Effect, map_pixels
from truesky.render.effects.scene import Frame, Scene
from truesky.render.effects.series import SMALL, small_expm1

# Newton's method doubles the number of correct digits. The function is smooth with slopes between 1 - b and 1.
_ITERATIONS = 6


Number = float | Float


def apply(
    frame: Frame, high: Number, saturation: Number, low: Number, knee: Number, rng: np.random.Generator | None = None
) -> Frame:
    """Apply the nonlinearity of the amplifiers.

    Parameters
    ----------
    frame : float array, any shape, or (q, ...) for q amplifiers
        Electrons. Negative values are unchanged.
    high : float or array, shape (q,)
        Parameter a: relative loss of signal at `saturation`, 0 to 10.
    saturation : float or array, shape (q,)
        Saturation of the amplifier in electrons, 1 to 1e9.
    low : float or array, shape (q,)
        Parameter b: missing fraction of the first electrons, 0 to 0.99.
    knee : float or array, shape (q,)
        Scale n0 of the loss of the first electrons, in electrons, 1e-3 to 1e9.
    rng : numpy.random.Generator, optional
        Not used.

    Returns
    -------
    float array, shape of `frame`
        Output of the amplifier in electrons. It increases monotonically with the input.

    Raises
    ------
    OutOfRange
        If a parameter is outside its limits.
    """
    _check_parameters(high, saturation, low, knee)
    return map_pixels(_respond, frame, high / saturation, low * knee, 1.0 / knee)


@jit
def _respond(light: Any, signal: Any, high: float, low: float, inverse: float) -> None:
    """Fill `signal`. `high` is per electron, `low` in electrons, and `inverse` is 1 / knee."""
    for i in range(len(light)):
        response = max(light[i], 0.0) / (1.0 + high * max(light[i], 0.0))
        signal[i] = min(light[i], 0.0) + response + low * small_expm1(-response * inverse)
    # Replace pixels outside the range of the series. A branch in the first loop would prevent its vectorisation, which
    # costs more than computing a few pixels twice.
    for i in range(len(light)):
        if light[i] * inverse > SMALL:
            response = light[i] / (1.0 + high * light[i])
            signal[i] = response + low * np.expm1(-response * inverse)


def linearise(measured: Frame, high: Number, saturation: Number, low: Number, knee: Number) -> Frame:
    """Invert `apply`, for calibration.

    Parameters
    ----------
    measured : float array, any shape, or (q, ...) for q amplifiers
        Output of the amplifier in electrons.
    high, saturation, low, knee : float or array, shape (q,)
        Same as in `apply`.

    Returns
    -------
    float array, shape of `measured`
        Electrons before the amplifier; infinite for values above the highest possible output.

    Raises
    ------
    OutOfRange
        If a parameter is outside its limits.
    """
    _check_parameters(high, saturation, low, knee)
    high, saturation, low, knee = (
        np.reshape(n, (-1, *[1] * (measured.ndim - 1))) if np.ndim(n) else n for n in (high, saturation, low, knee)
    )
    light = np.maximum(measured, 0.0)
    response = light / (1.0 - low * np.exp(-light / knee))
    for _ in range(_ITERATIONS):
        residual = response + low * knee * np.expm1(-response / knee) - light
        response = np.maximum(response - residual / (1.0 - low * np.exp(-response / knee)), 0.0)
    remaining = 1.0 - high / saturation * response
    with np.errstate(divide="ignore"):
        out = np.where(remaining > 0.0, response / np.maximum(remaining, 0.0), np.inf)
    return np.asarray(out + np.minimum(measured, 0.0))


def _check_parameters(high: Number, saturation: Number, low: Number, knee: Number) -> None:
    for name, value, lowest, highest in (
        ("non-linearity at saturation", high, 0.0, 10.0),
        ("amplifier saturation", saturation, 1.0, 1e9),
        ("non-linearity of low signals", low, 0.0, 0.99),
        ("non-linearity knee", knee, 1e-3, 1e9),
    ):
        if not (np.min(value) >= lowest and np.max(value) <= highest):
            raise OutOfRange(name, value, lowest, highest)


def parameters(scene: Scene) -> tuple[Number, Number, Number, Number]:
    """Return high, saturation, low and knee of a scene. The amplifier saturates at the end of the converter's range."""
    saturation = scene.amplifier_values("adc_max", "adu") * scene.amplifier_values("gain", "electron / adu")
    return (
        scene.amplifier_values("nonlinearity.high", ""),
        saturation,
        scene.amplifier_values("nonlinearity.low", ""),
        scene.amplifier_values("nonlinearity.low_scale", "electron"),
    )


def _contribution(scene: Scene) -> float:
    brightest = min(scene.brightest_electrons, scene.value("full_well", "electron") + scene.sky_electrons)
    curve = parameters(scene)
    light = np.full(max(np.size(number) for number in curve), brightest)
    return float(np.max(light - apply(light, *curve)))


EFFECT = Effect("nonlinearity", apply, parameters, _contribution, cost=6e-3)
