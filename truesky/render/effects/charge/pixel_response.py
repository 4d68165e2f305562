"""Pixel response: sensitivity variations from pixel to pixel (PRNU), dead pixels, dark columns, and dust shadows."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lake_schema.errors import OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.camera import windows
from truesky.render.camera.windows import DetectorPart, Window
from truesky.render.effects import pixel_random
from truesky.render.effects.effect import Effect, copy_frame
from truesky.render.effects.scene import Frame, Scene

# Parts of every column that are read through one serial register: each (first row, last row + 1, True if the register
# is above the part and False if it is below).
Segments = Sequence[tuple[int, int, bool]]
# Parameters of the function `response`: standard deviation of the sensitivity between pixels, (fraction of dead pixels,
# mean number of dark columns), three numbers for dust (grains per pixel, mean radius of shadows in pixels, absorbed
# fraction of the light), and parts of the columns (`Segments`).
Parameters = tuple[float, tuple[float, float], tuple[float, float, float], Segments]

# Highest sensitivity of a dead pixel, relative to a normal pixel. It is uniform between 0 and this.
_MAX_DEAD = 0.5
# The Gaussian shadow of a dust grain is drawn up to this distance from its centre, in standard deviations.
_SHADOW_RANGE = 4.0


def apply(
    frame: Frame,
    rms: float,
    defects: tuple[float, float],
    dust: tuple[float, float, float],
    segments: Segments,
    rng: np.random.Generator,
    part: DetectorPart | None = None,
    out: Frame | None = None,
) -> Frame:
    """Multiply a frame by the sensitivity of each pixel, which is the same in every exposure.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Electrons.
    rms : float
        Standard deviation of the sensitivity between pixels, 0 to 1.
    defects : (float, float)
        Fraction of dead pixels (0 to 1) and mean number of dark columns (0 to 1e4). A dark column has no signal on the
        far side of a defect, as seen from the serial register.
    dust : (float, float, float)
        Dust grains per pixel (0 to 0.1), mean radius (Gaussian sigma) of their shadows in pixels (0 to 1000), and
        fraction of light absorbed at the centre of a shadow (0 to 1).
    segments : sequence of (int, int, bool)
        Parts of every column that are read through one serial register, each (first row, last row + 1, True if the
        register is above).
    rng : numpy.random.Generator
        Random generator of the detector, in the same state in every exposure, so that the sensitivity does not change.
    part : DetectorPart, optional
        Part of the detector that the frame shows. By default the frame is the whole detector.
    out : float64 array, shape of `frame`, optional
        Array for the result, which may be `frame` itself. By default a new array.

    Returns
    -------
    float array, shape (ny, nx)
        Detected electrons.

    Raises
    ------
    OutOfRange
        If a number is outside its limits or NaN.
    """
    out = copy_frame(frame, out)
    _multiply_response(out, rms, defects, dust, segments, rng, part or windows.whole(frame.shape))
    return out


def response(
    shape: tuple[int, ...],
    rms: float,
    defects: tuple[float, float],
    dust: tuple[float, float, float],
    segments: Segments,
    rng: np.random.Generator,
    part: DetectorPart | None = None,
) -> Frame:
    """Return the sensitivity of every pixel relative to the mean, with dead pixels, dark columns and dust shadows.

    Parameters
    ----------
    shape : (int, int)
        Number of rows and columns.
    rms : float
        Standard deviation of the sensitivity between pixels, 0 to 1.
    defects : (float, float)
        Fraction of dead pixels (0 to 1) and mean number of dark columns (0 to 1e4). The sensitivity of dead pixels is
        uniform between 0 and 0.5. The number of dark columns has a Poisson distribution. A dark column has a defect in
        a random row. Pixels on the far side of the defect, as seen from the serial register, have a sensitivity of 0.
    dust : (float, float, float)
        Mean number of dust grains per pixel (0 to 0.1), mean radius of their shadows in pixels (0 to 1000), and
        fraction of light absorbed at the centre of a shadow (0 to 1). A radius is the standard deviation of a Gaussian
        shadow; the radii have an exponential distribution.
    segments : sequence of (int, int, bool)
        Parts of every column that are read through one serial register, each (first row, last row + 1, True if the
        register is above).
    rng : numpy.random.Generator
        Random generator of the detector, in the same state in every exposure, so that the sensitivity does not change.
    part : DetectorPart, optional
        Part of the detector that the frame shows. By default the frame is the whole detector.

    Returns
    -------
    float array, shape (ny, nx)
        Sensitivity, 0 or more. Its mean is 1 apart from dead pixels, dark columns and dust.

    Raises
    ------
    OutOfRange
        If `rms` or a number of `defects` or `dust` is outside its limits or NaN.
    """
    out = np.ones(shape)
    _multiply_response(out, rms, defects, dust, segments, rng, part or windows.whole(shape))
    return out


def _multiply_response(
    out: Frame,
    rms: float,
    defects: tuple[float, float],
    dust: tuple[float, float, float],
    segments: Segments,
    rng: np.random.Generator,
    part: DetectorPart,
) -> None:
    """Multiply a frame by the sensitivity of its pixels in place, with the arguments of `response`."""
    (dead, dark_columns), (grains, radius, depth) = defects, dust
    for name, value, highest in (
        ("pixel response rms", rms, 1.0), ("fraction of dead pixels", dead, 1.0), ("dark columns", dark_columns, 1e4),
        ("dust grains per pixel", grains, 0.1), ("dust radius", radius, 1e3), ("dust depth", depth, 1.0),
    ):  # fmt: skip
        if not 0.0 <= value <= highest:
            raise OutOfRange(name, value, 0.0, highest)
    ny, nx, window, frame_key = part.ny, part.nx, part.window, pixel_random.draw_key(rng)
    count = int(rng.binomial(ny * nx, dead))
    is_inside, rows, columns = part.find_pixels(rng.integers(0, max(ny, 1), count), rng.integers(0, max(nx, 1), count))
    # A dead pixel has its own sensitivity in place of the one that all pixels draw.
    dead_pixels = out[rows, columns] * (_MAX_DEAD * rng.random(count))[is_inside]
    if rms > 0.0:
        for run, key in pixel_random.split_key(frame_key, part):
            _multiply_sensitivity(out.reshape(-1)[run], rms, key)
    out[rows, columns] = dead_pixels
    for _ in range(int(rng.poisson(dark_columns)) if nx else 0):
        row, column = int(rng.integers(0, ny)), int(rng.integers(0, nx)) - window.column
        # Charge from pixels beyond the defect cannot pass the defect on its way to the serial register.
        for first, past, register_above in segments:
            if first <= row < past and 0 <= column < window.nx:
                start, end = (first, row + 1) if register_above else (row, past)
                out[max(start - window.row, 0) : max(end - window.row, 0), column] = 0.0
    count = int(rng.poisson(grains * ny * nx))
    shadows = rng.random((count, 2)) * (ny, nx), radius * rng.standard_exponential(count)
    for (y, x), sigma in zip(shadows[0].tolist(), shadows[1].tolist(), strict=True):
        _multiply_shadow(out, (y, x), sigma, depth, window)


def _multiply_shadow(out: Frame, place: tuple[float, float], sigma: float, depth: float, window: Window) -> None:
    """Multiply sensitivities in a window by the Gaussian shadow of one dust grain, in place.

    `place` (y, x) and `sigma` are the centre of the shadow on the detector and its standard deviation in pixels, and
    `depth` is the fraction of light absorbed at the centre. Nothing changes if `sigma` is 0.
    """
    reach = _SHADOW_RANGE * sigma
    (first_row, end_row), (first_column, end_column) = (
        (max(int(at - reach), start), min(int(at + reach) + 1, start + count))
        for at, start, count in zip(place, (window.row, window.column), out.shape, strict=True)
    )
    if sigma == 0.0 or first_row >= end_row or first_column >= end_column:
        return
    up, across = (
        np.exp(-0.5 * ((np.arange(first, end) + 0.5 - at) / sigma) ** 2)
        for at, first, end in ((place[0], first_row, end_row), (place[1], first_column, end_column))
    )
    rows = slice(first_row - window.row, end_row - window.row)
    columns = slice(first_column - window.column, end_column - window.column)
    out[rows, columns] *= 1.0 - depth * up[:, None] * across


@jit
def _multiply_sensitivity(pixels: Any, rms: float, key: Any) -> None:
    """Multiply pixels by random sensitivities with the mean 1 and the standard deviation `rms`, in place."""
    normals, bits = np.empty(pixel_random.BLOCK), np.empty(pixel_random.BLOCK, np.uint64)
    for first in range(0, len(pixels), pixel_random.BLOCK):
        block = pixels[first : first + pixel_random.BLOCK]
        deviates = normals[: len(block)]
        pixel_random.fill_normals(deviates, bits, key, first)
        for i in range(len(block)):
            block[i] *= max(1.0 + rms * deviates[i], 0.0)


def parameters(scene: Scene) -> Parameters:
    """Return the parameters of `response` for the detector of a scene, from the mission database.

    They are the standard deviation of the sensitivity between pixels, (the fraction of dead pixels, the mean number of
    dark columns), three numbers for dust, and the parts of the columns that are read through one serial register. Dust
    has grains per pixel, the mean radius of their shadows in pixels, and the fraction of light absorbed at the centre.
    """
    dust = scene.value("dust", ""), scene.value("dust_radius", "pix"), scene.value("dust_depth", "")
    rms, dead, dark_columns = (scene.value(key, "") for key in ("prnu", "dead_pixels", "dark_columns"))
    return rms, (dead, dark_columns), dust, scene.column_segments


def _contribution(scene: Scene) -> float:
    rms, (dead, dark_columns), (grains, *_, depth), _ = parameters(scene)
    brightest = scene.peak_electrons + scene.sky_electrons
    shadow = depth * (grains > 0)
    return max(rms * brightest, scene.sky_electrons * max(float(dead > 0 or dark_columns > 0), shadow))


EFFECT = Effect("pixel_response", apply, parameters, _contribution, fixed=True, cost=1.2e-2, in_place=True)
