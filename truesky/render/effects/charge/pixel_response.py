"""Pixel response: each pixel's own sensitivity (PRNU), dead pixels, dark columns, dust that lies on the detector."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from lake_schema.errors import OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.effects import pixel_random
from truesky.render.effects.effect import Effect
from truesky.render.effects.scene import Frame, Scene

Segments = Sequence[tuple[int, int, bool]]
# Of `response`, without shape and random numbers.
Parameters = tuple[float, float, float, tuple[float, float, float], Segments]

# What a dead pixel still sees, at most.
_MAX_DEAD = 0.5
# Standard deviations of a grain's shadow that are drawn.
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
    """frame [ny, nx] e- -> times `response`.

    rms, dead, dark_columns, dust, runs, rng : as of `response`
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
    """Sensitivity of every pixel, mean 1 but for the defects, never below 0.

    rms : between pixels;  dead : fraction of pixels that see little
    dark_columns : mean number of columns that see nothing from some row on, away from their register
    dust : grains a pixel; mean rms of their shadows, pixels, exponentially distributed; what a shadow's middle lacks
    runs : pieces of a column: first row, the one past the last, whether the register lies above
    shape : ny, nx;  rng : random numbers of the detector's pixels
    """
    grains, radius, depth = dust
    for name, value, highest in (
        ("pixel response rms", rms, 1.0), ("dead pixels", dead, 1.0), ("dark columns", dark_columns, 1e4),
        ("dust", grains, 0.1), ("dust radius", radius, 1e3), ("dust depth", depth, 1.0),
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
        # Charge from beyond the defect does not come past it to its register.
        for first, past, register_above in segments:
            if first <= row < past:
                out[..., slice(first, row + 1) if register_above else slice(row, past), column] = 0.0
    count = int(rng.poisson(grains * ny * nx))
    shadows = rng.random((count, 2)) * (ny, nx), radius * rng.standard_exponential(count)
    for (y, x), sigma in zip(shadows[0].tolist(), shadows[1].tolist(), strict=True):
        _multiply_shadow(out, y, x, sigma, depth)
    return out


def _multiply_shadow(out: Frame, y: float, x: float, sigma: float, depth: float) -> None:
    """Multiplies by a grain's shadow, which is soft."""
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
    """Of `response`."""
    dust = scene.value("dust", ""), scene.value("dust_radius", "pix"), scene.value("dust_depth", "")
    rms, dead, columns = (scene.value(key, "") for key in ("prnu", "dead_pixels", "dark_columns"))
    return rms, dead, columns, dust, scene.column_segments


def _contribution(scene: Scene) -> float:
    rms, dead, columns, (grains, *_, depth), _ = parameters(scene)
    brightest = scene.peak_electrons + scene.sky_electrons
    shadow = depth * (grains > 0)
    return max(rms * brightest, scene.sky_electrons * max(float(dead > 0 or columns > 0), shadow))


EFFECT = Effect("pixel_response", apply, parameters, _contribution, fixed=True, cost=1.2e-2)
