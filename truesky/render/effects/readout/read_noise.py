"""Read noise of detectors that are read once: the output amplifier adds Gaussian noise to every pixel.

If the noise of light hides read noise, it is left out in the pixels of the detector. Prescan and overscan have no light
and always have read noise, with the same random numbers in both cases.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lake_schema.arrays import Float
from lake_schema.errors import OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.effects import pixel_random
from truesky.render.effects.effect import Effect, copy_frame, map_pixels, zero_contribution
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


def add_to_scans(frame: Frame, scene: Scene, rng: np.random.Generator, out: Frame | None = None) -> Frame:
    """Add Gaussian read noise to prescan and overscan, and leave the other pixels unchanged.

    Parameters
    ----------
    frame : float array, shape (q, ny, nx) for q amplifiers
        Electrons, with the pixel at [0, 0] read first. A frame (ny, nx) has no prescan and overscan.
    scene : Scene
        Properties of the detector, with the read noise of each amplifier.
    rng : numpy.random.Generator
        Random generator in the state that `apply` gets. Each pixel has the same random number as there.
    out : float64 array, shape of `frame`, optional
        Array for the result, which may be `frame` itself. By default a new array.

    Returns
    -------
    float array, shape of `frame`
        Electrons including read noise in prescan and overscan.
    """
    out = copy_frame(frame, out)
    if out.ndim == 3:
        sigmas = np.array(np.broadcast_to(_sigma(scene), len(out)), float)
        rows, columns = scene.pixels_in_plane
        _add_to_scans(out, sigmas, pixel_random.draw_key(rng), (rows.start, rows.stop), (columns.start, columns.stop))
    return out


@jit
def _add_to_scans(planes: Any, sigmas: Any, key: Any, rows: tuple[int, int], columns: tuple[int, int]) -> None:
    """Add Gaussian noise to prescan and overscan of planes [amplifier, row, column], in place.

    `sigmas` has the standard deviation of each amplifier in electrons. Pixels of the detector are the rows from
    `rows[0]` to `rows[1]` - 1 and the columns from `columns[0]` to `columns[1]` - 1. The random bits of a pixel derive
    from the key `key` and the flat index of the pixel in `planes`.
    """
    normals, bits = np.empty(pixel_random.BLOCK), np.empty(pixel_random.BLOCK, np.uint64)
    _, ny, nx = planes.shape
    for q in range(len(planes)):
        for r in range(ny):
            # Columns of two runs without light: before and after the pixels, or the whole row in two parts.
            for run in range(2):
                second = columns[1] if rows[0] <= r < rows[1] else columns[0]
                start, end = (0, columns[0]) if run == 0 else (second, nx)
                for first in range(start, end, pixel_random.BLOCK):
                    noise = normals[: min(pixel_random.BLOCK, end - first)]
                    pixel_random.fill_normals(noise, bits, key, (q * ny + r) * nx + first)
                    for i in range(len(noise)):
                        planes[q, r, first + i] += sigmas[q] * noise[i]


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
    apply_to_scans=add_to_scans,
)
