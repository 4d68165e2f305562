"""Nonlinearity of a pixel's capacitance: N electrons are read as N (1 - b N), with a different b for each pixel.

An infrared detector is read many times during an exposure (a ramp), without reset. The effect acts on the charge of
every frame (`EFFECT`), or on the signal estimated from the ramp (`SIGNAL`), as in Serrano et al. 2024. The mission
parameter `nonlinearity_of_signal` selects the first (0) or the second (1). They differ because charge is counted from
the reset, but the signal only from the first to the last group of averaged frames.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lake_schema.errors import OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.camera import windows
from truesky.render.camera.windows import DetectorPart
from truesky.render.effects import pixel_random
from truesky.render.effects.charge import ramp
from truesky.render.effects.effect import Effect
from truesky.render.effects.scene import Frame, Scene


def apply(
    frame: Frame, mean: float, spread: float, rng: np.random.Generator, part: DetectorPart | None = None
) -> Frame:
    """Draw the nonlinearity coefficient b of each pixel, and add it to the frame as an additional plane.

    The effect `ramp`, which simulates the repeated reads of the detector, later uses this plane: N electrons are read
    as N (1 - b N).

    Parameters
    ----------
    frame : float array, shape (ny, nx) or (3, ny, nx)
        Expected electrons; with three planes also the charge of cosmic rays (electrons), and the time at which it
        arrives in units of the time from the reset to the last read.
    mean : float
        Mean over pixels of the coefficient b of N (1 - b N), in 1/electron, 0 to 1e-3.
    spread : float
        Standard deviation of b from pixel to pixel as a fraction of `mean`, 0 to 10. Negative values of b are set to 0.
    rng : numpy.random.Generator
        Random generator of the detector, in the same state in every exposure, so that b does not change.
    part : DetectorPart, optional
        Part of the detector that the frame shows. By default the frame is the whole detector.

    Returns
    -------
    float32 array, shape (4, ny, nx)
        The planes of `frame`, and b in 1/electron in the last plane. Planes 1 and 2 are 0 if `frame` does not have
        them.

    Raises
    ------
    OutOfRange
        If `mean` or `spread` is outside its limits or NaN.
    """
    out = ramp.with_planes(frame, 4)
    coefficients, limits = out[3].reshape(-1), _check_parameters(mean, spread)
    for run, key in pixel_random.split_key(pixel_random.draw_key(rng), part or windows.whole(frame.shape)):
        _draw_coefficients(coefficients[run], *limits, key)
    return out


def apply_signal(
    frame: Frame, mean: float, spread: float, rng: np.random.Generator, part: DetectorPart | None = None
) -> Frame:
    """Apply the nonlinearity N (1 - b N) to the signal N that was estimated from a ramp (repeated reads).

    Parameters
    ----------
    frame : float array, shape (2, ny, nx)
        Signal in electrons, and chi^2 of the fit to the ramp.
    mean : float
        Mean over pixels of the coefficient b in 1/electron, 0 to 1e-3.
    spread : float
        Standard deviation of b from pixel to pixel as a fraction of `mean`, 0 to 10. Negative values of b are set to 0.
    rng : numpy.random.Generator
        Random generator of the detector, in the same state in every exposure, so that b does not change.
    part : DetectorPart, optional
        Part of the detector that the frame shows. By default the frame is the whole detector.

    Returns
    -------
    float array, shape (2, ny, nx)
        Measured signal in electrons, and the unchanged chi^2.

    Raises
    ------
    OutOfRange
        If `mean` or `spread` is outside its limits or NaN.

    Notes
    -----
    N (1 - b N) has its maximum at N = 1 / (2 b). Larger signals are set to this maximum. Negative signals are
    unchanged.
    """
    out = np.array(frame, dtype=float, order="C")
    signal, limits = out[0].reshape(-1), _check_parameters(mean, spread)
    for run, key in pixel_random.split_key(pixel_random.draw_key(rng), part or windows.whole(frame.shape)):
        _bend_signal(signal[run], *limits, key)
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
    """Return by how many electrons the nonlinearity reduces the charge that is read in a pixel at full well.

    Any pixel may be at full well, also without light, because it may be hot or hit by a cosmic ray.
    """
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
