"""Non-linearity of the output amplifier: its gain falls towards saturation, and for the first electrons.

measured = s - b n0 (1 - exp(-s / n0)),  s = n / (1 + a n / saturation)

apply         electrons -> what the amplifier gives, in electrons
linearised    its inverse: what a calibration does
"""

from __future__ import annotations

from typing import Any

import numpy as np

from jobs.compiling import jit
from jobs.render.effects.effect import Effect, Frame, Scene
from lake_schema.errors import OutOfRange

# Newton's rule doubles the digits; the function is smooth and its slope between 1 - b and 1.
_ITERATIONS = 6


def apply(
    frame: Frame, high: float, saturation: float, low: float, knee: float, rng: np.random.Generator | None = None
) -> Frame:
    """frame [..] e- >= 0 -> e-, monotonic.

    high : a, what is missing at `saturation` e-;  low : b, what is missing of the first electrons;  knee : n0, e-
    """
    _check(high, saturation, low, knee)
    out = np.array(frame, dtype=float, order="C")
    _respond(out.reshape(-1), high / saturation, low * knee, 1.0 / knee)
    return out


@jit
def _respond(signal: Any, high: float, low: float, inverse: float) -> None:
    """In place; high : per electron, low : electrons, inverse : of the knee."""
    for i in range(len(signal)):
        light = signal[i]
        if light > 0.0:
            response = light / (1.0 + high * light)
            signal[i] = response + low * np.expm1(-response * inverse)


def linearised(measured: Frame, high: float, saturation: float, low: float, knee: float) -> Frame:
    """The electrons that `apply` made into `measured`; beyond what it can give: infinite."""
    _check(high, saturation, low, knee)
    light = np.maximum(measured, 0.0)
    response = light / (1.0 - low * np.exp(-light / knee))
    for _ in range(_ITERATIONS):
        wrong = response + low * knee * np.expm1(-response / knee) - light
        response = np.maximum(response - wrong / (1.0 - low * np.exp(-response / knee)), 0.0)
    left = 1.0 - high / saturation * response
    with np.errstate(divide="ignore"):
        out = np.where(left > 0.0, response / np.maximum(left, 0.0), np.inf)
    return np.asarray(out + np.minimum(measured, 0.0))


def _check(high: float, saturation: float, low: float, knee: float) -> None:
    for name, value, least, most in (
        ("non-linearity at saturation", high, 0.0, 10.0),
        ("amplifier saturation", saturation, 1.0, 1e9),
        ("non-linearity of low signals", low, 0.0, 0.99),
        ("non-linearity knee", knee, 1e-3, 1e9),
    ):
        if not least <= value <= most:
            raise OutOfRange(name, value, least, most)


def parameters(scene: Scene) -> tuple[float, float, float, float]:
    """high, saturation, low, knee: the converter's range is the amplifier's."""
    saturation = scene.value("adc_max", "adu") * scene.value("gain", "electron / adu")
    return (
        scene.value("nonlinearity.high", ""),
        saturation,
        scene.value("nonlinearity.low", ""),
        scene.value("nonlinearity.low_scale", "electron"),
    )


def _contribution(scene: Scene) -> float:
    brightest = min(scene.peak_electrons, scene.value("full_well", "electron")) + scene.sky_electrons
    there = np.array([brightest])
    return float((there - apply(there, *parameters(scene)))[0])


EFFECT = Effect("nonlinearity", apply, parameters, _contribution, cost=3.9e-2)
