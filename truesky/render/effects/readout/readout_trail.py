"""Readout trail, or frame-transfer smear: the shutter is open, and a row collects light wherever it is shifted over.

Runs on expected electrons: what falls in there is counted like all light, and seen by the pixel that it falls on. The
lamp is out while rows move. As the response of the pixel where a row began comes once, after all light has, it is
divided out here. Rows beyond a dark column's defect lose their trail with the rest.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lake_schema.errors import OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.effects.charge import pixel_response
from truesky.render.effects.effect import Effect
from truesky.render.effects.scene import Frame, Scene


def apply(
    frame: Frame,
    share: float,
    halves: int,
    response: pixel_response.Parameters | None = None,
    rng: np.random.Generator | None = None,
) -> Frame:
    """frame [ny, nx] expected e- -> plus what is collected on the way to the register.

    share    : time over one row, of the exposure time
    halves   : 2 = the upper half is read at its last row, 1 = all through row 0
    response : of pixel_response.response, which comes later and with whose random numbers this one comes; None: all
               pixels are alike
    rng      : random numbers of that response; None: all pixels are alike
    """
    if not 0.0 <= share <= 1e6:
        raise OutOfRange("readout trail", share, 0.0, 1e6)
    if halves not in (1, 2):
        raise OutOfRange("halves of a column", halves, 1, 2)
    light = np.ascontiguousarray(frame, dtype=float)
    if response is None or rng is None or share == 0.0:
        sensitivity = np.ones(light.shape)
    else:
        sensitivity = pixel_response.response(light.shape, *response, rng)
    out = np.empty(light.shape)
    middle = (len(out) + 1) // 2 if halves == 2 else len(out)
    _add_trail(light[:middle], sensitivity[:middle], share, out[:middle])
    _add_trail(light[middle:][::-1], sensitivity[middle:][::-1], share, out[middle:][::-1])
    return out


@jit
def _add_trail(light: Any, sensitivity: Any, share: float, out: Any) -> None:
    """Fills `out`: a row passes over those that are read before it, the first of all is row 0."""
    collected = np.zeros(light.shape[1])
    for r in range(len(light)):
        for c in range(light.shape[1]):
            out[r, c] = light[r, c]
            if sensitivity[r, c] > 0.0:
                out[r, c] += share * collected[c] / sensitivity[r, c]
                collected[c] += light[r, c] * sensitivity[r, c]


def _parameters(scene: Scene) -> tuple[float, int, pixel_response.Parameters | None]:
    # A row takes as long whatever part of a detector is looked at.
    rows = scene.value("fpa.ny", "pix") / 2 + scene.value("fpa.parallel_overscan", "pix")
    share = scene.value("readout_time", "s") / rows / max(scene.exposure_time_s, 1e-3)
    return share, 2, pixel_response.parameters(scene) if pixel_response.EFFECT.is_applied(scene) else None


def _contribution(scene: Scene) -> float:
    share, *_ = _parameters(scene)
    return share * (scene.peak_electrons + scene.half_rows * scene.sky_electrons)


EFFECT = Effect(
    "readout_trail",
    apply,
    _parameters,
    _contribution,
    fixed=True,
    random_stream=pixel_response.EFFECT.name,
    cost=1.3e-2,
)
