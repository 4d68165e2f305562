"""Gain differences between the outputs of a detector.

An infrared detector has 32 outputs, each of which reads neighbouring columns. The conversion to digital numbers and the
headers of files use one gain for all outputs. The differences therefore remain as stripes of neighbouring columns in
flats and images.

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
    """Multiply the columns that each output of the detector reads by the relative gain of the output.

    Parameters
    ----------
    frame : float array, shape (..., ny, nx)
        Electrons.
    spread : float
        Width of the range of gains, 0 to 1. Gains are drawn uniformly between 1 - spread / 2 and 1 + spread / 2.
    rng : numpy.random.Generator
        Random generator of the detector, in the same state in every exposure, so that the gains do not change.

    Returns
    -------
    float array, shape of `frame`
        Electrons as they are read.

    Raises
    ------
    OutOfRange
        If `spread` is outside its limits or NaN.
    """
    if not 0.0 <= spread <= 1.0:
        raise OutOfRange("spread of the outputs' gains", spread, 0.0, 1.0)
    gains = 1.0 + spread * (rng.random(ramp_noise.OUTPUTS) - 0.5)
    columns = np.repeat(gains, np.diff(ramp_noise.edges(frame.shape[-1])))
    return np.asarray(frame * columns.astype(frame.dtype))


def _parameters(scene: Scene) -> tuple[float]:
    return (scene.value("gain_spread", ""),)


def _contribution(scene: Scene) -> float:
    """Return the largest change of a full pixel by gain differences in electrons.

    Any pixel may be full, because it may be hot or hit by a cosmic ray.
    """
    return 0.5 * _parameters(scene)[0] * scene.value("full_well", "electron")


EFFECT = Effect("output_gain", apply, _parameters, _contribution, fixed=True, cost=7e-3)
