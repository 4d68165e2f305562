"""Cosmic rays: straight tracks, a pixel thin, that deposit charge along their length.

Those of the integration hit the pixels that collect light. Those of the readout hit a detector whose rows are on their
way: they are placed in readout coordinates (row 0 is read first), where later rows have been exposed for longer.

apply, EFFECT            in the integration, on the detector
apply_readout, READOUT   in the readout, on quadrants
tracks                   their charge alone: the truth map
"""

from __future__ import annotations

import csv
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np

from jobs.compiling import jit
from jobs.render.effects.effect import Effect, Frame, Scene
from lake_schema.errors import OutOfRange

_SQUARE_CM = 1e-8
# Expected tracks that nobody waits for.
_FEW = 1e-3


def apply(frame: Frame, expected: float, rng: np.random.Generator) -> Frame:
    """frame [ny, nx] e- -> plus the charge of Poisson(expected) tracks."""
    return np.asarray(frame + tracks(frame.shape, expected, rng))


def tracks(shape: tuple[int, ...], expected: float, rng: np.random.Generator) -> Frame:
    """Charge of cosmic rays [ny, nx], whole e-; `expected` of them in the mean.

    A track that leaves at one edge enters at the other, as its neighbours' tracks do: the density is even.
    """
    out = np.zeros(shape)
    count = _count(expected, rng)
    if out.size:
        events = _events(count, shape[0], shape[1], rng)
        _draw(out, events, np.zeros(count, np.int64), shape[0])
    return out


def apply_readout(
    frame: Frame, expected: float, rows: int, prescan: int, columns: int, rng: np.random.Generator
) -> Frame:
    """quadrants [q, ny, nx] e- in readout order -> plus the tracks that hit while they were read.

    expected : tracks on one quadrant's rows x columns pixels;  prescan : first column that is a pixel
    """
    out = np.array(frame, dtype=float)
    for quadrant in out.reshape(-1, *frame.shape[-2:]):
        count = _count(expected, rng)
        if not rows or not columns:
            continue
        events = _events(count, rows, columns, rng)
        # Rows read before the hit: the pixel's charge is read that much later.
        before = rng.integers(0, quadrant.shape[0], count)
        _draw(quadrant[:, prescan : prescan + columns], events, before, rows)
    return out


def _count(expected: float, rng: np.random.Generator) -> int:
    if not 0.0 <= expected <= 1e8:
        raise OutOfRange("cosmic rays", expected, 0.0, 1e8)
    return int(rng.poisson(expected))


def _events(count: int, ny: int, nx: int, rng: np.random.Generator) -> tuple[Any, ...]:
    """Start (x, y), direction, length in pixels, whole electrons.

    Length and charge have the same rank, as in Niemi 2015: who crosses more silicon leaves more.
    """
    chance, length, charge = _quantiles()
    angle = 2.0 * np.pi * rng.random(count)
    x, y, rank = nx * rng.random(count), ny * rng.random(count), rng.random(count)
    electrons = np.rint(np.exp(np.interp(rank, chance, np.log(charge))))
    return x, y, np.cos(angle), np.sin(angle), np.exp(np.interp(rank, chance, np.log(length))), electrons


@cache
def _quantiles() -> tuple[Frame, Frame, Frame]:
    text = (files("jobs.render.effects") / "cosmic_rays.csv").read_text(encoding="utf-8")
    rows = list(csv.DictReader(line for line in text.splitlines() if not line.startswith("#")))
    p, length, charge = (np.array([float(row[key]) for row in rows]) for key in ("P", "length_pix", "energy_e"))
    return p, length, charge


@jit
def _draw(frame: Any, events: tuple[Any, ...], before: Any, rows: int) -> None:
    """Adds tracks on `rows` rows to a frame, in place, each `before` rows further on; what is beyond it is lost."""
    x, y, cosine, sine, length, electrons = events
    ny, nx = frame.shape
    for i in range(len(x)):
        column, row = int(np.floor(x[i])), int(np.floor(y[i]))
        step_x, step_y = (1 if cosine[i] > 0 else -1), (1 if sine[i] > 0 else -1)
        per_x, per_y = 1.0 / max(abs(cosine[i]), 1e-12), 1.0 / max(abs(sine[i]), 1e-12)
        next_x = ((column + 1 - x[i]) if step_x > 0 else (x[i] - column)) * per_x
        next_y = ((row + 1 - y[i]) if step_y > 0 else (y[i] - row)) * per_y
        given = 0.0
        while True:
            along = min(min(next_x, next_y), length[i])
            # Differences of rounded sums: whole electrons, none too many.
            so_far = np.rint(electrons[i] * along / length[i])
            r, c = row % rows + before[i], column % nx
            if r < ny:
                frame[r, c] += so_far - given
            given = so_far
            if along >= length[i]:
                break
            if next_x < next_y:
                next_x += per_x
                column += step_x
            else:
                next_y += per_y
                row += step_y


def rate(scene: Scene, pixels: float) -> float:
    """Tracks a second on so many pixels."""
    area = pixels * scene.value("fpa.pixel_size", "um / pix") ** 2 * _SQUARE_CM
    return scene.mission.value("env.cosmic_rays.flux_stardust", "cm-2 s-1") * area


def _expected(scene: Scene) -> tuple[float]:
    pixels = scene.value("fpa.nx", "pix") * scene.value("fpa.ny", "pix")
    if scene.detector is not None:
        pixels = float(scene.detector.nx * scene.detector.ny)
    return (rate(scene, pixels) * scene.exposure_time_s,)


def _readout(scene: Scene) -> tuple[float, int, int, int]:
    (pixels,) = _expected(scene)
    nx, ny = int(scene.value("fpa.nx", "pix")), int(scene.value("fpa.ny", "pix"))
    if scene.detector is not None:
        nx, ny = scene.detector.nx, scene.detector.ny
    rows, columns = ny // 2, nx // 2
    pixels = rate(scene, float(rows * columns)) * scene.value("readout_time", "s")
    return pixels, rows, int(scene.value("fpa.prescan", "pix")), columns


def _in_a_pixel(expected: float) -> float:
    """The median track's charge in a pixel, where there is one."""
    _, length, charge = _quantiles()
    middle = len(length) // 2
    return float(charge[middle] / length[middle]) * (expected > _FEW)


EFFECT = Effect("cosmic_rays", apply, _expected, lambda scene: _in_a_pixel(*_expected(scene)), cost=4e-3)
READOUT = Effect(
    "readout_cosmic_rays", apply_readout, _readout, lambda scene: _in_a_pixel(_readout(scene)[0]), cost=4e-3
)
