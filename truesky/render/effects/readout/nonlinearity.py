"""Nonlinearity of the output amplifiers: their gain is lower near saturation, and for the first electrons.

For n electrons in a pixel, the output in electrons is::

    measured = s - b n0 (1 - exp(-s / n0)),    s = n / (1 + a n / saturation)

The parameter a (`high`) is the approximate relative loss of signal near `saturation` (electrons). The fraction b
(`low`) of the first electrons is missing in the output. This loss ends over n0 (`knee`) electrons.
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

# Number of steps of Newton's method in `linearise`. Each doubles the number of correct digits, because the function
# that is inverted is smooth: its slope increases from 1 - `low` (at least 0.01) for no signal to 1 for strong signals.
_ITERATIONS = 6
# Number of pixels whose input is kept while their output replaces it.
_BLOCK = 1024


Number = float | Float


def apply(
    frame: Frame,
    high: Number,
    saturation: Number,
    low: Number,
    knee: Number,
    rng: np.random.Generator | None = None,
    out: Frame | None = None,
) -> Frame:
    """Convert the electrons of pixels to the output of their nonlinear amplifiers.

    Parameters
    ----------
    frame : float array, any shape, or (q, ...) for q amplifiers
        Electrons. Negative values are unchanged. The first axis counts amplifiers if parameters are arrays.
    high : float or array, shape (q,)
        Parameter a: relative loss of signal near `saturation`, 0 to 10. With the loss, n electrons give n / (1 + a n /
        saturation).
    saturation : float or array, shape (q,)
        Saturation of the amplifier in electrons, 1 to 1e9.
    low : float or array, shape (q,)
        Parameter b: fraction of the first electrons that is missing in the output, 0 to 0.99.
    knee : float or array, shape (q,)
        Scale n0 in electrons over which the loss of the first electrons ends, 1e-3 to 1e9.
    rng : numpy.random.Generator, optional
        Not used.
    out : float64 array, shape of `frame`, optional
        Array for the result, which may be `frame` itself. By default a new array.

    Returns
    -------
    float array, shape of `frame`
        Output of the amplifier in electrons. It increases with the input everywhere.

    Raises
    ------
    OutOfRange
        If `high`, `saturation`, `low` or `knee` is outside its limits or NaN.
    """
    _check_parameters(high, saturation, low, knee)
    if np.all(np.equal(low, 0.0)):
        return map_pixels(_saturate, frame, high / saturation, out=out)
    return map_pixels(_respond, frame, high / saturation, low * knee, 1.0 / knee, out=out)


@jit
def _saturate(pixels: Any, high: float) -> None:
    """Convert electrons to the output of an amplifier that loses no first electrons, in place.

    `high` is the relative loss of signal per electron in the pixel, due to saturation.
    """
    for i in range(len(pixels)):
        light = max(pixels[i], 0.0)
        pixels[i] = min(pixels[i], 0.0) + light / (1.0 + high * light)


@jit
def _respond(pixels: Any, high: float, low: float, inverse: float) -> None:
    """Convert electrons to the output of an amplifier, in place.

    `high` is the relative loss of signal per electron in the pixel, due to saturation. `low` is the number of electrons
    that are missing in any strong signal. `inverse` is 1 / (scale in electrons over which this loss is reached).
    """
    light_of_block = np.empty(_BLOCK)
    for start in range(0, len(pixels), _BLOCK):
        signal = pixels[start : start + _BLOCK]
        light = light_of_block[: len(signal)]
        light[:] = signal
        for i in range(len(light)):
            response = max(light[i], 0.0) / (1.0 + high * max(light[i], 0.0))
            signal[i] = min(light[i], 0.0) + response + low * small_expm1(-response * inverse)
        # Compute the brighter pixels, for which the power series in `small_expm1` is not accurate, again. An `if` in
        # the first loop would prevent its vectorisation, which costs more than computing a few pixels twice.
        for i in range(len(light)):
            if light[i] * inverse > SMALL:
                response = light[i] / (1.0 + high * light[i])
                signal[i] = response + low * np.expm1(-response * inverse)


def linearise(measured: Frame, high: Number, saturation: Number, low: Number, knee: Number) -> Frame:
    """Convert the output of nonlinear amplifiers back to electrons, for calibration: the inverse of `apply`.

    Parameters
    ----------
    measured : float array, any shape, or (q, ...) for q amplifiers
        Output of the amplifiers in electrons. Negative values are unchanged.
    high : float or array, shape (q,)
        Relative loss of signal near `saturation`, 0 to 10.
    saturation : float or array, shape (q,)
        Saturation of the amplifier in electrons, 1 to 1e9.
    low : float or array, shape (q,)
        Fraction of the first electrons that is missing in the output, 0 to 0.99.
    knee : float or array, shape (q,)
        Scale in electrons over which the loss of the first electrons ends, 1e-3 to 1e9.

    Returns
    -------
    float array, shape of `measured`
        Electrons before the amplifier. Values above the highest possible output give infinity.

    Raises
    ------
    OutOfRange
        If `high`, `saturation`, `low` or `knee` is outside its limits or NaN.
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
    """Return the parameters of nonlinearity, (high, saturation, low, knee), of the amplifiers of a scene's detector.

    `high` is the relative loss of signal near saturation. `saturation` (electrons) is the highest output of the
    analogue-to-digital converter times the gain. `low` is the fraction of the first electrons that is missing in the
    output, and `knee` the scale in electrons over which this loss ends. Each is one number, or one per amplifier.
    """
    saturation = scene.amplifier_values("adc_max", "adu") * scene.amplifier_values("gain", "electron / adu")
    return (
        scene.amplifier_values("nonlinearity.high", ""),
        saturation,
        scene.amplifier_values("nonlinearity.low", ""),
        scene.amplifier_values("nonlinearity.low_scale", "electron"),
    )


def _contribution(scene: Scene) -> float:
    brightest = min(scene.brightest_electrons, scene.full_well + scene.sky_electrons)
    curve = parameters(scene)
    light = np.full(max(np.size(number) for number in curve), brightest)
    return float(np.max(light - apply(light, *curve)))


EFFECT = Effect("nonlinearity", apply, parameters, _contribution, cost=6e-3, in_place=True)
