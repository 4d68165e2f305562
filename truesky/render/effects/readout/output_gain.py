"""Gain differences between the outputs of a detector.

Signals and headers use one gain for all outputs. The differences remain as stripes of neighbouring columns, in flats
and images.

References
----------
Kubik et al. 2025, NISP detectors on ground (gains within 1 %).
"""

from __future__ import annotations

import numpy as np

from lake_schema.errors import OutOfRange
from truesky.render.effects.effect import Effect
from truesky.render.effects.readout import ramp_noise
from truesky.render.effects.scene import Frame, Scene


def apply(frame: Frame, spread: float, rng: np.random.Generator) -> Frame:
    """Multiply the columns of each output by its relative gain.

    Parameters
    ----------
    frame : float array, shape (..., ny, nx)
        Electrons.
    spread : float
        Difference between the lowest and the highest possible gain as a fraction, 0 to 1. Gains are uniform in between.
    rng : numpy.random.Generator
        Random numbers of the outputs, the same in every exposure.

    Returns
    -------
    float array, shape of `frame`
        Electrons as they are read.

    Raises
    ------
    OutOfRange
        If `spread` is outside its limits.
    """
    if not 0.0 <= spread <= 1.0:
        raise OutOfRange("spread of the outputs' gains", spread, 0.0, 1.0)
    gains = 1.0 + spread * (rng.random(ramp_noise.OUTPUTS) - 0.5)
    columns = np.repeat(gains, np.diff(ramp_noise.edges(frame.shape[-1])))
    return np.asarray(frame * columns.astype(frame.dtype))


def _parameters(scene: Scene) -> tuple[float]:
    return (scene.value("gain_spread", ""),)


def _contribution(scene: Scene) -> float:
    """Change of a full pixel: a hot pixel or a cosmic ray can fill any pixel, even without light."""
    return 0.5 * _parameters(scene)[0] * scene.value("full_well", "electron")


EFFECT = Effect("output_gain", apply, _parameters, _contribution, fixed=True, cost=7e-3)
