"""Readout trail (frame-transfer smear): with an open shutter, rows collect light while they are shifted.

The effect acts on expected electrons: the light of the trail is counted like all other light, with the sensitivity of
the pixel on which it falls. A calibration lamp is off during the readout. The effect `pixel_response` is applied later.
It multiplies the whole charge of a row by the sensitivity of the pixels in which the row began; this sensitivity is
therefore divided out here. In a dark column (a column with a defect that charge cannot pass), the pixels beyond the
defect, farther from the serial register, lose their trail as well as their signal.
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
    """Add the light that rows collect during the readout, on their way to the serial register, to a frame.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Expected electrons.
    share : float
        Time that a row spends over one pixel as a fraction of the exposure time, 0 to 1e6.
    halves : int
        2 if the upper half of the rows is read through the last row, 1 if all rows are read through row 0.
    response : tuple, optional
        Parameters of `pixel_response.response`, the sensitivity of each pixel that is applied later. By default all
        pixels have the same sensitivity.
    rng : numpy.random.Generator, optional
        Random generator of the sensitivity, in the same state in which the effect `pixel_response` gets it. By default
        all pixels have the same sensitivity.

    Returns
    -------
    float array, shape (ny, nx)
        Expected electrons including the trail.

    Raises
    ------
    OutOfRange
        If `share` or `halves` is outside its limits or NaN.
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
    """Fill `out` with the light and its trail, in electrons; row 0 is read first.

    Each row passes over all rows that are read before it, and collects the fraction `share` of their light. The light
    is counted with `sensitivity`, the relative sensitivity of each pixel. The trail is divided by that of the pixel in
    which the row began, because a later effect multiplies by it.
    """
    collected = np.zeros(light.shape[1])
    for r in range(len(light)):
        for c in range(light.shape[1]):
            out[r, c] = light[r, c]
            if sensitivity[r, c] > 0.0:
                out[r, c] += share * collected[c] / sensitivity[r, c]
                collected[c] += light[r, c] * sensitivity[r, c]


def _parameters(scene: Scene) -> tuple[float, int, pixel_response.Parameters | None]:
    # Divide the readout time by the number of rows of half a full detector, also if only a part of the detector is
    # simulated: the time per row is the same.
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
