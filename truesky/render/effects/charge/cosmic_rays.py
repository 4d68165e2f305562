"""Cosmic rays: straight tracks, a pixel thin, that deposit charge along their length.

Those of the integration hit the pixels that collect light. Those of the readout hit a detector whose rows are on their
way: they are placed in readout coordinates (row 0 is read first), where later rows have been exposed for longer. Their
charge is shifted from where it hit, past the traps from there on: they come when all else has passed the traps, with a
trail of their own.

apply, EFFECT            in the integration, on the detector
tracks                   their charge alone: the truth map
brightest                what they may bring to a pixel
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lake_schema.errors import OutOfRange
from truesky.numerics.compiling import jit
from truesky.render.camera import amplifiers
from truesky.render.effects.effect import Effect, zero_contribution
from truesky.render.effects.scene import Frame, Scene

_SQUARE_CM = 1e-8
# Quantiles of a track's length (pixels) and charge (electrons).
_TRACKS = "env.cosmic_rays.vis_tracks"
# Length of a vertical track, pixels.
_SHORTEST = 1e-2
# Expected tracks that nobody waits for.
_NEGLIGIBLE = 1e-3


def apply(frame: Frame, expected: float, quantiles: Frame, rng: np.random.Generator) -> Frame:
    """frame [ny, nx] e- -> plus the charge of Poisson(expected) tracks.

    quantiles : as of `tracks`;  rng : random numbers of the tracks
    """
    out = np.array(frame, dtype=float, order="C")
    _add_tracks(out, expected, quantiles, rng)
    return out


def draw_tracks(shape: tuple[int, ...], expected: float, quantiles: Frame, rng: np.random.Generator) -> Frame:
    """Charge of cosmic rays [ny, nx], whole e-; `expected` of them in the mean.

    quantiles : [q, 3] probability, length (pixels) and charge (e-) that so many are below; their logarithms are linear

    A track that leaves at one edge enters at the other, as its neighbours' tracks do: the density is even.
    shape     : ny, nx;  rng : random numbers of the tracks
    """
    out = np.zeros(shape)
    _add_tracks(out, expected, quantiles, rng)
    return out


def _add_tracks(out: Frame, expected: float, quantiles: Frame, rng: np.random.Generator) -> None:
    count = draw_event_count(expected, rng)
    if out.size:
        ny, nx = out.shape
        _, column, row, charge = pixels_of_events(draw_events(count, ny, nx, quantiles, rng))
        add_charge(out, row, column, charge)


@jit
def add_charge(frame: Any, row: Any, column: Any, charge: Any) -> None:
    """What leaves at one edge enters at the other.

    frame       : [ny, nx] e-, to which it is added
    row, column : int[n] pixels, which may lie outside;  charge : [n] e- in each of them
    """
    ny, nx = frame.shape
    for i in range(len(charge)):
        frame[row[i] % ny, column[i] % nx] += charge[i]


def draw_event_count(expected: float, rng: np.random.Generator) -> int:
    if not 0.0 <= expected <= 1e8:
        raise OutOfRange("cosmic rays", expected, 0.0, 1e8)
    return int(rng.poisson(expected))


def draw_events(count: int, ny: int, nx: int, quantiles: Frame, rng: np.random.Generator) -> tuple[Any, ...]:
    """Start (x, y), direction, length in pixels, whole electrons.

    Length and charge have the same rank, as in Niemi 2015: who crosses more silicon leaves more.
    count : tracks;  nx, ny : pixels that they start in
    quantiles, rng : as of `tracks`
    """
    chance, length, charge = quantiles.T
    angle = 2.0 * np.pi * rng.random(count)
    x, y, rank = nx * rng.random(count), ny * rng.random(count), rng.random(count)
    electrons = np.rint(np.exp(np.interp(rank, chance, np.log(charge))))
    return x, y, np.cos(angle), np.sin(angle), np.exp(np.interp(rank, chance, np.log(length))), electrons


@jit
def pixels_of_events(events: tuple[Any, ...]) -> Any:
    """Event, column, row and charge, e-, of every pixel that tracks cross; columns and rows on an endless detector."""
    x, y, cosine, sine, length, electrons = events
    size = 0
    for i in range(len(x)):
        # A track enters a column or a row at a time.
        size += int(length[i] * (abs(cosine[i]) + abs(sine[i]))) + 4
    event, columns, rows = np.empty(size, np.int64), np.empty(size, np.int64), np.empty(size, np.int64)
    charge, n = np.empty(size), 0
    for i in range(len(x)):
        column, row = int(np.floor(x[i])), int(np.floor(y[i]))
        step_x, step_y = (1 if cosine[i] > 0 else -1), (1 if sine[i] > 0 else -1)
        per_x, per_y = 1.0 / max(abs(cosine[i]), 1e-12), 1.0 / max(abs(sine[i]), 1e-12)
        next_x = ((column + 1 - x[i]) if step_x > 0 else (x[i] - column)) * per_x
        next_y = ((row + 1 - y[i]) if step_y > 0 else (y[i] - row)) * per_y
        previous = 0.0
        while True:
            along = min(min(next_x, next_y), length[i])
            # Differences of rounded sums: whole electrons, none too many.
            cumulative = np.rint(electrons[i] * along / length[i])
            event[n], columns[n], rows[n], charge[n] = i, column, row, cumulative - previous
            n += 1
            previous = cumulative
            if along >= length[i]:
                break
            if next_x < next_y:
                next_x += per_x
                column += step_x
            else:
                next_y += per_y
                row += step_y
    return event[:n], columns[:n], rows[:n], charge[:n]


def event_rate(scene: Scene, pixels: float) -> float:
    """Tracks a second on so many pixels: of the site, where a camera has its own rate, else of space."""
    if f"{scene.section}.cosmic_rays.rate" in scene.mission and scene.detector is not None:
        nx, ny = amplifiers.full_size(scene.detector, scene.mission)
        return scene.value("cosmic_rays.rate", "1 / s") * pixels / (nx * ny)
    area = pixels * scene.value("fpa.pixel_size", "um / pix") ** 2 * _SQUARE_CM
    return scene.mission.value("env.cosmic_rays.flux_stardust", "cm-2 s-1") * area


def track_quantiles(scene: Scene) -> Frame:
    """Of `tracks`; where a camera has the rate of its site: of muons in its silicon."""
    if f"{scene.section}.cosmic_rays.rate" in scene.mission:
        deposit = scene.mission.value("env.cosmic_rays.silicon_deposit", "electron / um")
        return muon_quantiles(
            scene.value("cosmic_rays.thickness", "um"), scene.value("fpa.pixel_size", "um / pix"), deposit
        )
    return np.array(scene.mission.numbers(_TRACKS))


def muon_quantiles(thickness: float, pixel: float, deposit: float) -> Frame:
    """Quantiles of tracks straight through a horizontal detector: intensity cos^2, flux cos^3 of the zenith angle.

    thickness, pixel : um;  deposit : e-/um along the track
    Error            : no fluctuations of the energy loss, no electrons of natural radioactivity, whatever the pointing
    """
    cumulative = np.append(np.linspace(0.0, 0.98, 50), [0.99, 0.999, 0.9999, 1.0 - 1e-6])
    cosine = (1.0 - cumulative) ** 0.25
    length = np.maximum(thickness * np.sqrt(1.0 - cosine**2) / (cosine * pixel), _SHORTEST)
    table = np.stack([cumulative, length, deposit * thickness / cosine], axis=1)
    return np.concatenate([table, [[1.0, 1.001 * table[-1, 1], 1.001 * table[-1, 2]]]])


def _expected_events(scene: Scene) -> float:
    return event_rate(scene, float(scene.nx * scene.ny)) * scene.exposure_time_s


def brightest_pixel(scene: Scene) -> float:
    """Electrons in the brightest pixel of a track that is likely: all of it, or what a length of one pixel gets."""
    _, length, charge = track_quantiles(scene).T
    return float((charge / np.maximum(length, 1.0)).max())


def median_pixel(scene: Scene, expected: float) -> float:
    """The median track's charge in a pixel, where there is one."""
    _, length, charge = track_quantiles(scene).T
    middle = len(length) // 2
    return float(charge[middle] / length[middle]) * (expected > _NEGLIGIBLE)


EFFECT = Effect(
    "cosmic_rays",
    apply,
    lambda scene: (_expected_events(scene), track_quantiles(scene)),
    lambda scene: median_pixel(scene, _expected_events(scene)),
    cost=4e-3,
    systematic=zero_contribution,
)
