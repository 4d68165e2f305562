"""Dark current: random numbers of thermal electrons in every pixel, and hot pixels with many more."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from lake_schema.errors import OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.camera import windows
from truesky.render.camera.windows import DetectorPart
from truesky.render.effects import pixel_random
from truesky.render.effects.charge import poisson
from truesky.render.effects.effect import Effect, copy_frame, map_pixels
from truesky.render.effects.scene import Frame, Scene

# Upper limit on the mean dark electrons of a hot pixel in an exposure, far above every full well. Only very warm
# detectors reach it.
_MAX_HOT_ELECTRONS = 1e11
# If the mean number of dark electrons per pixel is below this, counts are drawn for blocks of `_BLOCK` pixels together,
# which is faster.
_BLOCKWISE_BELOW = 2.0
# Number of pixels for which counts of dark electrons are drawn together.
_BLOCK = 512
# Counts of dark electrons are considered in ascending order, up to the count at which their cumulative probability
# reaches this number.
_CERTAIN = 1.0 - 2e-16


def apply(frame: Frame, electrons: float, rng: np.random.Generator, out: Frame | None = None) -> Frame:
    """Add a random number of dark electrons to every pixel, with a Poisson distribution.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Electrons.
    electrons : float
        Expected dark electrons per pixel, 0 or more.
    rng : numpy.random.Generator
        Random generator from which one 64-bit key is drawn. Each pixel derives its random number from the key and its
        index.
    out : float64 array, shape of `frame`, optional
        Array for the result, which may be `frame` itself. By default a new array.

    Returns
    -------
    float array, shape (ny, nx)
        Electrons including dark current.

    Raises
    ------
    OutOfRange
        If `electrons` is negative, infinite or NaN.
    """
    if not 0.0 <= electrons < np.inf:
        raise OutOfRange("dark electrons", electrons, 0.0, np.inf)
    return map_pixels(_add_counts, frame, electrons, pixel_random.draw_key(rng), out=out)


@jit
def _add_counts(pixels: Any, mean: float, key: Any) -> None:
    p_zero = math.exp(-mean)
    if mean >= _BLOCKWISE_BELOW:
        for i in range(len(pixels)):
            pixels[i] += poisson.draw_count(mean, p_zero, pixel_random.pixel_bits(key, i))
        return
    # For small means it is faster to increase the counts of a whole block of pixels one by one: for count = 0, 1, 2,
    # ... each pixel whose uniform random number exceeds the probability P(<= count) gets one more electron.
    u = np.empty(_BLOCK)
    for first in range(0, len(pixels), _BLOCK):
        block = pixels[first : first + _BLOCK]
        for j in range(len(block)):
            u[j] = pixel_random.uniform(pixel_random.pixel_bits(key, first + j))
        term, cumulative, count = p_zero, p_zero, 0.0
        while cumulative < _CERTAIN and term > 0.0:
            for j in range(len(block)):
                block[j] += 1.0 if u[j] > cumulative else 0.0
            count += 1.0
            term *= mean / count
            cumulative += term


def apply_hot(
    frame: Frame,
    fraction: float,
    electrons: float,
    rng: np.random.Generator,
    part: DetectorPart | None = None,
    out: Frame | None = None,
) -> Frame:
    """Add electrons to randomly chosen hot pixels, which are the same in every exposure.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Electrons.
    fraction : float
        Fraction of pixels that are hot, 0 to 1.
    electrons : float
        Mean electrons of a hot pixel, at least 0, below 1e12. The distribution is exponential.
    rng : numpy.random.Generator
        Random generator of the detector, in the same state in every exposure, so that the hot pixels are the same.
    part : DetectorPart, optional
        Part of the detector that the frame shows. By default the frame is the whole detector.
    out : float64 array, shape of `frame`, optional
        Array for the result, which may be `frame` itself. By default a new array.

    Returns
    -------
    float array, shape (ny, nx)
        Electrons. Those added to hot pixels are whole numbers.

    Raises
    ------
    OutOfRange
        If `fraction` or `electrons` is outside its limits or NaN.

    Notes
    -----
    The electrons of a hot pixel are the same in every exposure of the same length: their shot noise is not modelled.
    """
    if not 0.0 <= fraction <= 1.0:
        raise OutOfRange("fraction of hot pixels", fraction, 0.0, 1.0)
    if not 0.0 <= electrons < 1e12:
        raise OutOfRange("hot electrons", electrons, 0.0, 1e12)
    part, out = part or windows.whole(frame.shape), copy_frame(frame, out)
    size = part.nx * part.ny
    count = int(rng.binomial(size, fraction))
    is_inside, rows, columns = part.find_pixels(*np.divmod(rng.integers(0, max(size, 1), count), max(part.nx, 1)))
    np.add.at(out, (rows, columns), np.rint(electrons * rng.standard_exponential(count))[is_inside])
    return out


def _hot_parameters(scene: Scene) -> tuple[float, float]:
    rate = scene.value("hot_current", "electron / (s pix)") * scene.dark_current_scaling
    return scene.value("hot_pixels", ""), min(rate * scene.exposure_time_s, _MAX_HOT_ELECTRONS)


def _contribution(scene: Scene) -> float:
    """Return the root mean square of the dark electrons in a pixel, from their mean and shot noise together."""
    return float(np.sqrt(scene.dark_electrons * (1.0 + scene.dark_electrons)))


EFFECT = Effect(
    "dark_current",
    apply,
    lambda scene: (scene.dark_electrons,),
    _contribution,
    cost=2e-3,
    systematic=lambda scene: scene.dark_electrons,
    in_place=True,
)
HOT = Effect(
    "hot_pixels",
    apply_hot,
    _hot_parameters,
    lambda scene: _hot_parameters(scene)[1] * (_hot_parameters(scene)[0] > 0),
    fixed=True,
    cost=2e-3,
    in_place=True,
)
