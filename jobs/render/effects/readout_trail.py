"""Readout trail: with the shutter open, a row collects light at every place that it is shifted over.

Runs on expected electrons: what falls in there is counted like all light.

Error : 1 % of the trail, from pixel to pixel: light of the trail takes the response of the pixel that is read, not of
        where it fell. The lamp is out while rows move, and the response comes once, after all light has. Rows beyond a
        dark column's defect lose their trail with the rest, rightly; the trail of a dead pixel is too faint.
"""

from __future__ import annotations

import numpy as np

from jobs.render.effects.effect import Effect, Frame, Scene
from lake_schema.errors import OutOfRange


def apply(frame: Frame, share: float, halves: int, rng: np.random.Generator | None = None) -> Frame:
    """frame [ny, nx] expected e- -> plus what is collected on the way to the register.

    share  : time over one row, of the exposure time
    halves : 2 = the upper half is read at its last row, 1 = all through row 0
    """
    if not 0.0 <= share <= 1e6:
        raise OutOfRange("readout trail", share, 0.0, 1e6)
    if halves not in (1, 2):
        raise OutOfRange("halves of a column", halves, 1, 2)
    out = np.array(frame, dtype=float)
    middle = (len(out) + 1) // 2 if halves == 2 else len(out)
    for part, half in ((frame[:middle], out[:middle]), (frame[middle:][::-1], out[middle:][::-1])):
        # A row passes over those that are read before it.
        half[1:] += share * np.cumsum(part, axis=0)[:-1]
    return out


def _parameters(scene: Scene) -> tuple[float, int]:
    # A row takes as long whatever part of a detector is looked at.
    rows = scene.value("fpa.ny", "pix") / 2 + scene.value("fpa.parallel_overscan", "pix")
    return scene.value("readout_time", "s") / rows / max(scene.exposure_time_s, 1e-3), 2


def _contribution(scene: Scene) -> float:
    share, _ = _parameters(scene)
    return share * (scene.peak_electrons + scene.half_rows * scene.sky_electrons)


EFFECT = Effect("readout_trail", apply, _parameters, _contribution, cost=3.5e-2)
