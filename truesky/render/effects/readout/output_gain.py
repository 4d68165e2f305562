"""The outputs of a detector have gains of their own: of as much charge some columns read a little more.

Signals are computed, and headers tell the gain, of all outputs together: what is left are stripes of neighbouring
columns, in flats as in images.

Ref : Kubik et al. 2025, NISP detectors on ground (gains within 1 %)
"""

from __future__ import annotations

import numpy as np

from lake_schema.errors import OutOfRange
from truesky.render.effects.effect import Effect
from truesky.render.effects.readout import ramp_noise
from truesky.render.effects.scene import Frame, Scene


def apply(frame: Frame, spread: float, rng: np.random.Generator) -> Frame:
    """Planes [.., ny, nx] e- -> as the outputs of their columns read them.

    frame : the planes;  spread : between the lowest gain and the highest, as a fraction;  rng : numbers of the outputs
    """
    if not 0.0 <= spread <= 1.0:
        raise OutOfRange("spread of the outputs' gains", spread, 0.0, 1.0)
    gains = 1.0 + spread * (rng.random(ramp_noise.OUTPUTS) - 0.5)
    columns = np.repeat(gains, np.diff(ramp_noise.edges(frame.shape[-1])))
    return np.asarray(frame * columns.astype(frame.dtype))


def _parameters(scene: Scene) -> tuple[float]:
    return (scene.value("gain_spread", ""),)


def _contribution(scene: Scene) -> float:
    """Of a full pixel: a hot pixel or a cosmic ray may fill any, also where nothing shines."""
    return 0.5 * _parameters(scene)[0] * scene.value("full_well", "electron")


EFFECT = Effect("output_gain", apply, _parameters, _contribution, fixed=True, cost=7e-3)
