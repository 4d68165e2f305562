"""Expected dark current of each pixel of an infrared detector, which varies from pixel to pixel, with hot pixels.

The effect is for detectors that are read several times during the exposure (up the ramp). It is added to the expected
electrons of the light, from which the effect `ramp` later draws random counts.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lake_schema.errors import OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.camera import windows
from truesky.render.camera.windows import DetectorPart
from truesky.render.effects import pixel_random
from truesky.render.effects.effect import Effect
from truesky.render.effects.scene import Frame, Scene

# Upper limit on the mean dark electrons of a hot pixel in an exposure, far above every full well.
_MAX_HOT_ELECTRONS = 1e11


def apply(
    frame: Frame,
    electrons: float,
    spread: float,
    hot_fraction: float,
    hot_electrons: float,
    rng: np.random.Generator,
    part: DetectorPart | None = None,
) -> Frame:
    """Add the expected dark current of each pixel to a frame; the pattern is the same in every exposure.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Expected electrons.
    electrons : float
        Mean dark current of normal pixels in electrons, 0 to 1e12.
    spread : float
        Standard deviation of the natural logarithm of the dark current from pixel to pixel, 0 to 3.
    hot_fraction : float
        Fraction of pixels that are hot, 0 to 1.
    hot_electrons : float
        Mean additional electrons of a hot pixel, 0 to 1e12. The distribution is exponential.
    rng : numpy.random.Generator
        Random generator of the detector, in the same state in every exposure, so that the pattern does not change.
    part : DetectorPart, optional
        Part of the detector that the frame shows. By default the frame is the whole detector.

    Returns
    -------
    float array, shape (ny, nx)
        Expected electrons including dark current.

    Raises
    ------
    OutOfRange
        If `electrons`, `spread`, `hot_fraction` or `hot_electrons` is outside its limits or NaN.
    """
    for name, value, highest in (
        ("dark electrons", electrons, 1e12), ("spread of the dark current", spread, 3.0),
        ("fraction of hot pixels", hot_fraction, 1.0), ("hot electrons", hot_electrons, 1e12),
    ):  # fmt: skip
        if not 0.0 <= value <= highest:
            raise OutOfRange(name, value, 0.0, highest)
    # For a standard normal z, exp(s z) has the mean exp(s^2 / 2). Divide by it, so that the mean is `electrons`.
    part, out = part or windows.whole(frame.shape), np.empty(frame.shape)
    pixels, out_pixels = np.ascontiguousarray(frame, dtype=float).reshape(-1), out.reshape(-1)
    for run, key in pixel_random.split_key(pixel_random.draw_key(rng), part):
        _add_dark(pixels[run], out_pixels[run], electrons * np.exp(-0.5 * spread**2), spread, key)
    size = part.nx * part.ny
    count = int(rng.binomial(size, hot_fraction))
    is_inside, rows, columns = part.find_pixels(*np.divmod(rng.integers(0, max(size, 1), count), max(part.nx, 1)))
    np.add.at(out, (rows, columns), (hot_electrons * rng.standard_exponential(count))[is_inside])
    return out


@jit
def _add_dark(frame: Any, out: Any, median: float, spread: float, key: Any) -> None:
    for i in range(len(frame)):
        out[i] = frame[i] + median * np.exp(spread * pixel_random.normal(pixel_random.pixel_bits(key, i)))


def _parameters(scene: Scene) -> tuple[float, float, float, float]:
    rate = scene.value("hot_current", "electron / (s pix)") * scene.dark_current_scaling
    hot_electrons = min(rate * scene.exposure_time_s, _MAX_HOT_ELECTRONS)
    return scene.dark_electrons, scene.value("dark_spread", ""), scene.value("hot_pixels", ""), hot_electrons


def _contribution(scene: Scene) -> float:
    electrons, _, hot_fraction, hot_electrons = _parameters(scene)
    return electrons + hot_electrons * (hot_fraction > 0.0)


EFFECT = Effect("dark_map", apply, _parameters, _contribution, fixed=True, cost=1e-2)
