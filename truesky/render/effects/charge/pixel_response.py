"""Pixel response: sensitivity variations (PRNU), dead pixels, dark columns, and dust on the detector."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lake_schema.errors import OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.effects import pixel_random
from truesky.render.effects.effect import Effect
from truesky.render.effects.scene import Frame, Scene

# Segments of every column: first row, last row + 1, and True if the serial register is above the segment.
Segments = Sequence[tuple[int, int, bool]]
# Arguments of `response` from `rms` to `segments`.
Parameters = tuple[float, float, float, tuple[float, float, float], Segments]

# Highest sensitivity of a dead pixel.
_MAX_DEAD = 0.5
# Radius in standard deviations to which a dust shadow is drawn.
_SHADOW_RANGE = 4.0


def apply(
    frame: Frame,
    rms: float,
    dead: float,
    dark_columns: float,
    dust: tuple[float, float, float],
    segments: Segments,
    rng: np.random.Generator,
) -> Frame:
    """Multiply a frame by the pixel response.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Electrons.
    rms, dead, dark_columns : float
        Same as in `response`.
    dust : (float, float, float)
        Same as in `response`.
    segments : sequence of (int, int, bool)
        Same as in `response`.
    rng : numpy.random.Generator
        Random numbers of the detector, the same in every exposure.

    Returns
    -------
    float array, shape (ny, nx)
        Electrons.
    """
    out = response(frame.shape, rms, dead, dark_columns, dust, segments, rng)
    out *= frame
    return out


def response(
    shape: tuple[int, ...],
    rms: float,
    dead: float,
    dark_columns: float,
    dust: tuple[float, float, float],
    segments: Segments,
    rng: np.random.Generator,
) -> Frame:
    """Relative sensitivity of every pixel.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns.
    rms : float
        Standard deviation of the sensitivity between pixels, 0 to 1.
    dead : float
        Fraction of dead pixels, 0 to 1. Their sensitivity is uniform between 0 and 0.5.
    dark_columns : float
        Mean number of dark columns, 0 to 1e4. A dark column has a defect in a random row; pixels on the far side of
        the defect, as seen from the serial register, have no signal.
    dust : (float, float, float)
        Dust grains per pixel, 0 to 0.1; mean radius (Gaussian sigma) of their shadows in pixels, 0 to 1000,
        exponentially distributed; and fraction of light absorbed at the centre of a shadow, 0 to 1.
    segments : sequence of (int, int, bool)
        Segments of every column: first row, last row + 1, and True if the serial register is above the segment.
    rng : numpy.random.Generator
        Random numbers of the detector, the same in every exposure.

    Returns
    -------
    float array, shape (ny, nx)
        Sensitivity, 0 or more. The mean is 1 apart from defects and dust.

    Raises
    ------
    OutOfRange
        If a parameter is outside its limits.
    """
    grains, radius, depth = dust
    for name, value, highest in (
        ("pixel response rms", rms, 1.0), ("fraction of dead pixels", dead, 1.0), ("dark columns", dark_columns, 1e4),
        ("dust grains per pixel", grains, 0.1), ("dust radius", radius, 1e3), ("dust depth", depth, 1.0),
    ):  # fmt: skip
        if not 0.0 <= value <= highest:
            raise OutOfRange(name, value, 0.0, highest)
    out = np.empty(shape)
    _draw_sensitivity(out.reshape(-1), rms, pixel_random.draw_key(rng))
    ny, nx = shape[-2:]
    count = int(rng.binomial(ny * nx, dead))
    rows, columns = rng.integers(0, max(ny, 1), count), rng.integers(0, max(nx, 1), count)
    out[..., rows, columns] = _MAX_DEAD * rng.random(count)
    for _ in range(int(rng.poisson(dark_columns)) if nx else 0):
        row, column = int(rng.integers(0, ny)), int(rng.integers(0, nx))
        # Charge from beyond the defect cannot pass it on its way to the serial register.
        for first, past, register_above in segments:
            if first <= row < past:
                out[..., slice(first, row + 1) if register_above else slice(row, past), column] = 0.0
    count = int(rng.poisson(grains * ny * nx))
    shadows = rng.random((count, 2)) * (ny, nx), radius * rng.standard_exponential(count)
    for (y, x), sigma in zip(shadows[0].tolist(), shadows[1].tolist(), strict=True):
        _multiply_shadow(out, y, x, sigma, depth)
    return out


def _multiply_shadow(out: Frame, y: float, x: float, sigma: float, depth: float) -> None:
    """Multiply by the Gaussian shadow of a dust grain, in place."""
    if sigma == 0.0:
        return
    (rows, up), (columns, across) = (
        (slice(first, last), np.exp(-0.5 * ((np.arange(first, last) + 0.5 - at) / sigma) ** 2))
        for at, n in ((y, out.shape[-2]), (x, out.shape[-1]))
        for first, last in [(max(int(at - _SHADOW_RANGE * sigma), 0), min(int(at + _SHADOW_RANGE * sigma) + 1, n))]
    )
    out[..., rows, columns] *= 1.0 - depth * up[:, None] * across


@jit
def _draw_sensitivity(out: Any, rms: float, key: Any) -> None:
    for i in range(len(out)):
        out[i] = max(1.0 + rms * pixel_random.normal(pixel_random.pixel_bits(key, i)), 0.0)


def parameters(scene: Scene) -> Parameters:
    """Return the arguments of `response` from `rms` to `segments` for a scene."""
    dust = scene.value("dust", ""), scene.value("dust_radius", "pix"), scene.value("dust_depth", "")
    rms, dead, dark_columns = (scene.value(key, "") for key in ("prnu", "dead_pixels", "dark_columns"))
    return rms, dead, dark_columns, dust, scene.column_segments


def _contribution(scene: Scene) -> float:
    rms, dead, dark_columns, (grains, *_, depth), _ = parameters(scene)
    brightest = scene.peak_electrons + scene.sky_electrons
    shadow = depth * (grains > 0)
    return max(rms * brightest, scene.sky_electrons * max(float(dead > 0 or dark_columns > 0), shadow))


EFFECT = Effect("pixel_response", apply, parameters, _contribution, fixed=True, cost=1.2e-2)
