"""Read noise of detectors that are read once: the output amplifier adds Gaussian noise to every pixel."""

from __future__ import annotations

from typing import Any

import numpy as np

from lake_schema.arrays import Float
from lake_schema.errors import OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.effects import pixel_random
from truesky.render.effects.effect import Effect, map_pixels, zero_contribution
from truesky.render.effects.scene import Frame, Scene


def apply(frame: Frame, sigma: float | Float, rng: np.random.Generator, out: Frame | None = None) -> Frame:
    """Add Gaussian read noise to every pixel of a frame.

    Parameters
    ----------
    frame : float array, shape (ny, nx), or (q, ny, nx) for q amplifiers
        Electrons.
    sigma : float or array, shape (q,)
        Standard deviation in electrons, 0 or more.
    rng : numpy.random.Generator
        Random generator from which one 64-bit key is drawn. Each pixel derives its random number from the key and its
        index.
    out : float64 array, shape of `frame`, optional
        Array for the result, which may be `frame` itself. By default a new array.

    Returns
    -------
    float array, shape of `frame`
        Electrons including read noise.

    Raises
    ------
    OutOfRange
        If `sigma` is negative, infinite or NaN.
    """
    if not (np.min(sigma) >= 0.0 and np.max(sigma) < np.inf):
        raise OutOfRange("read noise", sigma, 0.0, np.inf)
    # Index of the first pixel of each amplifier in the flat frame. It gives every pixel of the detector its own random
    # number.
    first = np.arange(len(frame)) * frame[0].size if np.ndim(sigma) else 0
    return map_pixels(_add, frame, sigma, pixel_random.draw_key(rng), first, out=out)


@jit
def _add(pixels: Any, sigma: float, key: Any, first: int) -> None:
    """Add Gaussian noise to pixels, in place. Pixel `i` has the random bits of index `first` + i with the key `key`."""
    normals, bits = np.empty(pixel_random.BLOCK), np.empty(pixel_random.BLOCK, np.uint64)
    for start in range(0, len(pixels), pixel_random.BLOCK):
        block = pixels[start : start + pixel_random.BLOCK]
        noise = normals[: len(block)]
        pixel_random.fill_normals(noise, bits, key, first + start)
        for i in range(len(block)):
            block[i] += sigma * noise[i]


def _sigma(scene: Scene) -> float | Float:
    return scene.amplifier_values("read_noise", "electron")


EFFECT = Effect(
    "read_noise",
    apply,
    lambda scene: (_sigma(scene),),
    lambda scene: float(np.max(_sigma(scene))),
    cost=9e-3,
    systematic=zero_contribution,
    in_place=True,
)
