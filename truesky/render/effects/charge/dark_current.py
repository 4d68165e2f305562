"""Dark current: counted thermal electrons in every pixel, and hot pixels with many more."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from lake_schema.errors import OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.effects import pixel_random
from truesky.render.effects.charge import poisson
from truesky.render.effects.effect import Effect, map_pixels
from truesky.render.effects.scene import Frame, Scene

# Upper limit on the mean electrons of a hot pixel in a warm detector. It exceeds every full well by far.
_MAX_HOT_ELECTRONS = 1e11
# Means below _BLOCKWISE_BELOW are drawn for _BLOCK pixels together, up to the cumulative probability _CERTAIN.
_BLOCKWISE_BELOW, _BLOCK, _CERTAIN = 2.0, 512, 1.0 - 2e-16


def apply(frame: Frame, electrons: float, rng: np.random.Generator) -> Frame:
    """Add a Poisson count of dark electrons to every pixel.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Electrons.
    electrons : float
        Expected dark electrons per pixel, 0 or more.
    rng : numpy.random.Generator
        Source of the key from which each pixel derives its own random number.

    Returns
    -------
    float array, shape (ny, nx)
        Electrons including dark current.

    Raises
    ------
    OutOfRange
        If `electrons` is negative or infinite.
    """
    if not 0.0 <= electrons < np.inf:
        raise OutOfRange("dark electrons", electrons, 0.0, np.inf)
    return map_pixels(_add_counts, frame, electrons, pixel_random.draw_key(rng))


@jit
def _add_counts(frame: Any, out: Any, mean: float, key: Any) -> None:
    p_zero = math.exp(-mean)
    if mean >= _BLOCKWISE_BELOW:
        for i in range(len(frame)):
            out[i] = frame[i] + poisson.draw_count(mean, p_zero, pixel_random.pixel_bits(key, i))
        return
    # For small means it is faster to treat one count at a time for a whole block: each pixel whose uniform number
    # exceeds P(<= count) gets one more electron.
    u = np.empty(_BLOCK)
    for first in range(0, len(frame), _BLOCK):
        block, block_before = out[first : first + _BLOCK], frame[first : first + _BLOCK]
        for j in range(len(block)):
            u[j], block[j] = pixel_random.uniform(pixel_random.pixel_bits(key, first + j)), block_before[j]
        term, cumulative, count = p_zero, p_zero, 0.0
        while cumulative < _CERTAIN and term > 0.0:
            for j in range(len(block)):
                block[j] += 1.0 if u[j] > cumulative else 0.0
            count += 1.0
            term *= mean / count
            cumulative += term


def apply_hot(frame: Frame, fraction: float, electrons: float, rng: np.random.Generator) -> Frame:
    """Add whole electrons to hot pixels.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Electrons.
    fraction : float
        Fraction of hot pixels, 0 to 1.
    electrons : float
        Mean electrons of a hot pixel, 0 to 1e12. The distribution is exponential.
    rng : numpy.random.Generator
        Random numbers of the detector, the same in every exposure.

    Returns
    -------
    float array, shape (ny, nx)
        Electrons including hot pixels.

    Raises
    ------
    OutOfRange
        If a parameter is outside its limits.

    Notes
    -----
    The electrons of a hot pixel are the same in every exposure of the same length: their shot noise is not modelled.
    """
    if not 0.0 <= fraction <= 1.0:
        raise OutOfRange("fraction of hot pixels", fraction, 0.0, 1.0)
    if not 0.0 <= electrons < 1e12:
        raise OutOfRange("hot electrons", electrons, 0.0, 1e12)
    out = np.array(frame, dtype=float)
    count = int(rng.binomial(out.size, fraction))
    hot_pixels = rng.integers(0, max(out.size, 1), count)
    np.add.at(out.reshape(-1), hot_pixels, np.rint(electrons * rng.standard_exponential(count)))
    return out


def _hot_parameters(scene: Scene) -> tuple[float, float]:
    rate = scene.value("hot_current", "electron / (s pix)") * scene.dark_current_scaling
    return scene.value("hot_pixels", ""), min(rate * scene.exposure_time_s, _MAX_HOT_ELECTRONS)


def _contribution(scene: Scene) -> float:
    """Return the root mean square of the added electrons: their mean and shot noise together."""
    return float(np.sqrt(scene.dark_electrons * (1.0 + scene.dark_electrons)))


EFFECT = Effect(
    "dark_current",
    apply,
    lambda scene: (scene.dark_electrons,),
    _contribution,
    cost=2e-3,
    systematic=lambda scene: scene.dark_electrons,
)
HOT = Effect(
    "hot_pixels",
    apply_hot,
    _hot_parameters,
    lambda scene: _hot_parameters(scene)[1] * (_hot_parameters(scene)[0] > 0),
    fixed=True,
    cost=2e-3,
)
