"""Cosmic rays: straight tracks, a pixel thin, that deposit charge along their length.

Those of the integration hit the pixels that collect light. Those of the readout hit a detector whose rows are on their
way: they are placed in readout coordinates (row 0 is read first), where later rows have been exposed for longer. Their
charge is shifted from where it hit, past the traps from there on: they come when all else has passed the traps, with a
trail of their own.

apply, EFFECT            in the integration, on the detector
apply_readout, READOUT   in the readout, on quadrants
tracks                   their charge alone: the truth map
brightest                what they may bring to a pixel
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from jobs.compiling import jit
from jobs.render.effects import charge_transfer
from jobs.render.effects.effect import Effect, Frame, Scene, nothing
from jobs.render.effects.traps import Traps
from lake_schema.errors import OutOfRange

Int = npt.NDArray[np.int64]

_SQUARE_CM = 1e-8
# Quantiles of a track's length (pixels) and charge (electrons).
_TRACKS = "env.cosmic_rays.vis_tracks"
# Electrons in traps that are not followed further.
_LEAST = 1e-3
# Expected tracks that nobody waits for.
_FEW = 1e-3


def apply(frame: Frame, expected: float, quantiles: Frame, rng: np.random.Generator) -> Frame:
    """frame [ny, nx] e- -> plus the charge of Poisson(expected) tracks."""
    out = np.array(frame, dtype=float, order="C")
    _add_tracks(out, expected, quantiles, rng)
    return out


def tracks(shape: tuple[int, ...], expected: float, quantiles: Frame, rng: np.random.Generator) -> Frame:
    """Charge of cosmic rays [ny, nx], whole e-; `expected` of them in the mean.

    quantiles : [q, 3] probability, length (pixels) and charge (e-) that so many are below; their logarithms are linear

    A track that leaves at one edge enters at the other, as its neighbours' tracks do: the density is even.
    """
    out = np.zeros(shape)
    _add_tracks(out, expected, quantiles, rng)
    return out


def _add_tracks(out: Frame, expected: float, quantiles: Frame, rng: np.random.Generator) -> None:
    count = _count(expected, rng)
    if out.size:
        ny, nx = out.shape
        _, column, row, charge = _hits(_events(count, ny, nx, quantiles, rng))
        _add(out, row, column, charge)


def apply_readout(
    frame: Frame, expected: float, quantiles: Frame, rows: int, prescan: int, columns: int, silicon: Traps | None,
    rng: np.random.Generator,
) -> Frame:  # fmt: skip
    """quadrants [q, ny, nx] e- in readout order -> plus the tracks that hit while they were read.

    expected : tracks on one quadrant's rows x columns pixels;  prescan : first column that is a pixel
    silicon  : what is on the way down the columns, None: nothing
    """
    out = np.array(frame, dtype=float)
    for quadrant in out.reshape(-1, *frame.shape[-2:]):
        count = _count(expected, rng)
        part = quadrant[:, prescan : prescan + columns]
        if not rows or not part.size:
            continue
        event, column, row, charge = _hits(_events(count, rows, columns, quantiles, rng))
        # Rows read before the hit: the pixel's charge is read that much later.
        before = rng.integers(0, quadrant.shape[0], count)
        column, row = column % part.shape[1], row % rows
        packet = row + before[event]
        read = packet < len(part)
        _deposit(part, column[read], packet[read], row[read], charge[read], silicon)
    return out


def _deposit(quadrant: Frame, column: Int, packet: Int, row: Int, charge: Frame, silicon: Traps | None) -> None:
    """Adds charge to packets that lie in a row when it hits, in place, less what traps hold back, plus its trail.

    Error : a tenth of what traps do: each knows only how many of its species the hits before have filled
    """
    if silicon is None:
        _add(quadrant, packet, column, charge)
        return
    order = np.lexsort((packet, column))
    column, packet, row = (x[order] for x in (column, packet, row))
    charge = charge[order]
    there = quadrant[packet, column]
    # Traps that a hit reaches above the packet that it finds: from its row down.
    reached = (row + 1) * (silicon.volume(there + charge) - silicon.volume(there))
    released = -np.expm1(-1.0 / np.array(silicon.release))
    _trail(quadrant, column, packet, charge, reached, np.array(silicon.density), released)


@jit
def _add(frame: Any, row: Any, column: Any, charge: Any) -> None:
    """What leaves at one edge enters at the other."""
    ny, nx = frame.shape
    for i in range(len(charge)):
        frame[row[i] % ny, column[i] % nx] += charge[i]


@jit
def _trail(quadrant: Any, column: Any, packet: Any, charge: Any, reached: Any, density: Any, released: Any) -> None:
    """Column by column, each in the order of its packets."""
    held = np.zeros(len(density))
    for i in range(len(column)):
        if i == 0 or column[i] != column[i - 1]:
            held[:] = 0.0
        free = np.maximum(density * reached[i] - held, 0.0)
        taken = min(free.sum(), charge[i])
        held += free * (taken / max(free.sum(), 1e-300))
        quadrant[packet[i], column[i]] += charge[i] - taken
        another = i + 1 < len(column) and column[i + 1] == column[i]
        for p in range(packet[i] + 1, packet[i + 1] + 1 if another else len(quadrant)):
            back = 0.0
            for s in range(len(held)):
                back += held[s] * released[s]
                held[s] -= held[s] * released[s]
            quadrant[p, column[i]] += back
            if held.sum() < _LEAST:
                break


def _count(expected: float, rng: np.random.Generator) -> int:
    if not 0.0 <= expected <= 1e8:
        raise OutOfRange("cosmic rays", expected, 0.0, 1e8)
    return int(rng.poisson(expected))


def _events(count: int, ny: int, nx: int, quantiles: Frame, rng: np.random.Generator) -> tuple[Any, ...]:
    """Start (x, y), direction, length in pixels, whole electrons.

    Length and charge have the same rank, as in Niemi 2015: who crosses more silicon leaves more.
    """
    chance, length, charge = quantiles.T
    angle = 2.0 * np.pi * rng.random(count)
    x, y, rank = nx * rng.random(count), ny * rng.random(count), rng.random(count)
    electrons = np.rint(np.exp(np.interp(rank, chance, np.log(charge))))
    return x, y, np.cos(angle), np.sin(angle), np.exp(np.interp(rank, chance, np.log(length))), electrons


@jit
def _hits(events: tuple[Any, ...]) -> Any:
    """Event, column, row and charge, e-, of every pixel that tracks cross; columns and rows on an endless detector."""
    x, y, cosine, sine, length, electrons = events
    most = 0
    for i in range(len(x)):
        # A track enters a column or a row at a time.
        most += int(length[i] * (abs(cosine[i]) + abs(sine[i]))) + 4
    event, columns, rows = np.empty(most, np.int64), np.empty(most, np.int64), np.empty(most, np.int64)
    charge, n = np.empty(most), 0
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
            event[n], columns[n], rows[n], charge[n] = i, column, row, so_far - given
            n += 1
            given = so_far
            if along >= length[i]:
                break
            if next_x < next_y:
                next_x += per_x
                column += step_x
            else:
                next_y += per_y
                row += step_y
    return event[:n], columns[:n], rows[:n], charge[:n]


def rate(scene: Scene, pixels: float) -> float:
    """Tracks a second on so many pixels."""
    area = pixels * scene.value("fpa.pixel_size", "um / pix") ** 2 * _SQUARE_CM
    return scene.mission.value("env.cosmic_rays.flux_stardust", "cm-2 s-1") * area


def _quantiles(scene: Scene) -> Frame:
    return np.array(scene.mission.numbers(_TRACKS))


def _expected(scene: Scene) -> float:
    return rate(scene, float(scene.nx * scene.ny)) * scene.exposure_time_s


def _expected_readout(scene: Scene) -> float:
    return rate(scene, float((scene.nx // 2) * scene.half_rows)) * scene.value("readout_time", "s")


def _readout(scene: Scene) -> tuple[float, Frame, int, int, int, Traps | None]:
    prescan, half = int(scene.value("fpa.prescan", "pix")), scene.nx // 2
    silicon = charge_transfer.lattice(scene, "parallel") if charge_transfer.PARALLEL.applied(scene) else None
    return _expected_readout(scene), _quantiles(scene), scene.half_rows, prescan, half, silicon


def brightest(scene: Scene) -> float:
    """Electrons in the brightest pixel of a track that is likely: all of it, or what a length of one pixel gets."""
    _, length, charge = _quantiles(scene).T
    return float((charge / np.maximum(length, 1.0)).max())


def _in_a_pixel(scene: Scene, expected: float) -> float:
    """The median track's charge in a pixel, where there is one."""
    _, length, charge = _quantiles(scene).T
    middle = len(length) // 2
    return float(charge[middle] / length[middle]) * (expected > _FEW)


EFFECT = Effect(
    "cosmic_rays",
    apply,
    lambda scene: (_expected(scene), _quantiles(scene)),
    lambda scene: _in_a_pixel(scene, _expected(scene)),
    cost=4e-3,
    repeated=nothing,
)
READOUT = Effect(
    "readout_cosmic_rays",
    apply_readout,
    _readout,
    lambda scene: _in_a_pixel(scene, _expected_readout(scene)),
    cost=6.5e-3,
    repeated=nothing,
)
