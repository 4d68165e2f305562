"""Readout trail: with the shutter open, a row collects light at every place that it is shifted over.

Runs on expected electrons: what falls in there is counted like all light, and seen by the pixel that it falls on. The
lamp is out while rows move. As the response of the pixel where a row began comes once, after all light has, it is
divided out here. Rows beyond a dark column's defect lose their trail with the rest.
"""

from __future__ import annotations

import numpy as np

from jobs.render.effects import pixel_response
from jobs.render.effects.effect import Effect, Frame, Scene
from lake_schema.errors import OutOfRange


def apply(
    frame: Frame,
    share: float,
    halves: int,
    response: tuple[float, float, float] | None = None,
    rng: np.random.Generator | None = None,
) -> Frame:
    """frame [ny, nx] expected e- -> plus what is collected on the way to the register.

    share    : time over one row, of the exposure time
    halves   : 2 = the upper half is read at its last row, 1 = all through row 0
    response : of pixel_response.response, which comes later and with whose random numbers this one comes; None: all
               pixels are alike
    """
    if not 0.0 <= share <= 1e6:
        raise OutOfRange("readout trail", share, 0.0, 1e6)
    if halves not in (1, 2):
        raise OutOfRange("halves of a column", halves, 1, 2)
    out = np.array(frame, dtype=float)
    if share == 0.0:
        return out
    own = None if response is None or rng is None else pixel_response.response(out.shape, *response, rng)
    seen = frame if own is None else frame * own
    trail = np.zeros(out.shape)
    middle = (len(out) + 1) // 2 if halves == 2 else len(out)
    for part, half in ((seen[:middle], trail[:middle]), (seen[middle:][::-1], trail[middle:][::-1])):
        # A row passes over those that are read before it.
        half[1:] = np.cumsum(part, axis=0)[:-1]
    if own is not None:
        trail = np.divide(trail, own, out=np.zeros(out.shape), where=own > 0.0)
    return np.asarray(out + share * trail)


def _parameters(scene: Scene) -> tuple[float, int, tuple[float, float, float] | None]:
    # A row takes as long whatever part of a detector is looked at.
    rows = scene.value("fpa.ny", "pix") / 2 + scene.value("fpa.parallel_overscan", "pix")
    share = scene.value("readout_time", "s") / rows / max(scene.exposure_time_s, 1e-3)
    return share, 2, pixel_response.parameters(scene) if pixel_response.EFFECT.applied(scene) else None


def _contribution(scene: Scene) -> float:
    share, *_ = _parameters(scene)
    return share * (scene.peak_electrons + scene.half_rows * scene.sky_electrons)


EFFECT = Effect(
    "readout_trail",
    apply,
    _parameters,
    _contribution,
    fixed=True,
    numbers=pixel_response.EFFECT.name,
    cost=5e-2,
)
