"""Readout trail (frame-transfer smear): with an open shutter, rows collect light while they are shifted.

The effect acts on expected electrons: the light of the trail is counted like all other light, with the sensitivity of
the pixel on which it falls. The lamp is off during the readout. The pixel response is applied later, once for the pixel
in which a row began; it is therefore divided out here. Rows beyond the defect of a dark column lose their trail, too.
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
    """Add the light that rows collect on their way to the register.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Expected electrons.
    share : float
        Time that a row spends over one pixel as a fraction of the exposure time, 0 to 1e6.
    halves : int
        2 if the upper half is read through the last row, 1 if all rows are read through row 0.
    response : tuple, optional
        Parameters of `pixel_response.response`, which is applied later. By default all pixels have the same response.
    rng : numpy.random.Generator, optional
        Random numbers of the pixel response. By default all pixels have the same response.

    Returns
    -------
    float array, shape (ny, nx)
        Expected electrons including the trail.

    Raises
    ------
    OutOfRange
        If `share` or `halves` is outside its limits.
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
    """Fill `out`. A row passes over the rows that are read before it; row 0 is read first."""
    collected = np.zeros(light.shape[1])
    for r in range(len(light)):
        for c in range(light.shape[1]):
            out[r, c] = light[r, c]
            if sensitivity[r, c] > 0.0:
                out[r, c] += share * collected[c] / sensitivity[r, c]
                collected[c] += light[r, c] * sensitivity[r, c]


def _parameters(scene: Scene) -> tuple[float, int, pixel_response.Parameters | None]:
    # The time per row is the same if only a part of the detector is simulated.
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
