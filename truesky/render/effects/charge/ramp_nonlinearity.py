"""Non-linearity of a pixel's capacity: of N electrons N (1 - b N) are seen, b its own.

It acts on the charge that a pixel holds, frame by frame up the ramp; or, as Serrano et al. 2024 have it, on the signal
that is estimated of the ramp: the mission's parameter nonlinearity_of_signal, 0 or 1, says which.  The two differ:
charge counts over all frames of a ramp, the signal over those between its first group and its last.

apply, EFFECT          on the ramp
apply_signal, SIGNAL   on the signal, with the same b
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lake_schema.errors import OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.effects import pixel_random
from truesky.render.effects.charge import ramp
from truesky.render.effects.effect import Effect
from truesky.render.effects.scene import Frame, Scene


def apply(frame: Frame, mean: float, spread: float, rng: np.random.Generator) -> Frame:
    """Frame [ny, nx] or [3, ny, nx] of ramp.apply -> [4, ny, nx], with b of every pixel, 1/e-.

    frame : of ramp.apply;  mean : of b, 1/e-;  spread : of b from pixel to pixel, as a fraction
    rng   : random numbers of the detector's pixels
    """
    out = ramp.with_planes(frame, 4)
    _draw_coefficients(out[3].reshape(-1), *_check_parameters(mean, spread), pixel_random.draw_key(rng))
    return out


def apply_signal(frame: Frame, mean: float, spread: float, rng: np.random.Generator) -> Frame:
    """[2, ny, nx] signal of a ramp, e-, and its chi^2 -> with what is seen of the signal.

    frame             : signal and chi^2
    mean, spread, rng : as of `apply`
    Error             : of more than 1 / 2 b electrons is seen what is seen of these, as the most
    """
    out = np.array(frame, dtype=float, order="C")
    _bend_signal(out[0].reshape(-1), *_check_parameters(mean, spread), pixel_random.draw_key(rng))
    return out


def _check_parameters(mean: float, spread: float) -> tuple[float, float]:
    if not 0.0 <= mean <= 1e-3:
        raise OutOfRange("non-linearity", mean, 0.0, 1e-3)
    if not 0.0 <= spread <= 10.0:
        raise OutOfRange("spread of the non-linearity", spread, 0.0, 10.0)
    return mean, spread


@jit
def _draw_coefficients(coefficients: Any, mean: float, spread: float, key: Any) -> None:
    for i in range(len(coefficients)):
        coefficients[i] = mean * max(1.0 + spread * pixel_random.normal(pixel_random.pixel_bits(key, i)), 0.0)


@jit
def _bend_signal(signal: Any, mean: float, spread: float, key: Any) -> None:
    for i in range(len(signal)):
        b = mean * max(1.0 + spread * pixel_random.normal(pixel_random.pixel_bits(key, i)), 0.0)
        electrons = signal[i]
        if b > 0.0:
            electrons = min(electrons, 0.5 / b)
        if electrons > 0.0:
            signal[i] = electrons * (1.0 - b * electrons)


def _parameters(scene: Scene) -> tuple[float, float]:
    return scene.value("nonlinearity", "1 / electron"), scene.value("nonlinearity_spread", "")


def _acts_on_signal(scene: Scene) -> bool:
    return scene.value("nonlinearity_of_signal", "") > 0.5


def _change_at_full_well(scene: Scene) -> float:
    """Of a full pixel: a hot pixel or a cosmic ray may fill any, also where nothing shines."""
    return _parameters(scene)[0] * scene.value("full_well", "electron") ** 2


def _contribution(scene: Scene) -> float:
    return 0.0 if _acts_on_signal(scene) else _change_at_full_well(scene)


def _contribution_to_signal(scene: Scene) -> float:
    return _change_at_full_well(scene) if _acts_on_signal(scene) else 0.0


EFFECT = Effect("ramp_nonlinearity", apply, _parameters, _contribution, fixed=True, cost=1e-2)
SIGNAL = Effect(
    "signal_nonlinearity",
    apply_signal,
    _parameters,
    _contribution_to_signal,
    fixed=True,
    random_stream=EFFECT.name,
    cost=1e-2,
)
