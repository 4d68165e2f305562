"""Cosmic rays that arrive while the detector is read: their charge is registered at later rows.

apply_readout, READOUT   in the readout, on quadrants
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lake_schema.arrays import Int
from truesky.numerics.compiling import jit
from truesky.render.effects.charge import cosmic_rays
from truesky.render.effects.effect import Effect, nothing
from truesky.render.effects.readout import charge_transfer
from truesky.render.effects.readout.traps import Traps
from truesky.render.effects.scene import Frame, Scene

# Electrons in traps that are not followed further.
_LEAST = 1e-3


def apply_readout(
    frame: Frame, expected: float, quantiles: Frame, rows: int, prescan: int, columns: int, silicon: Traps | None,
    rng: np.random.Generator,
) -> Frame:  # fmt: skip
    """quadrants [q, ny, nx] e- in readout order -> plus the tracks that hit while they were read.

    expected : tracks on one quadrant's rows x columns pixels;  prescan : first column that is a pixel
    silicon  : what is on the way down the columns, None: nothing
    frame     : the quadrants;  rows, columns : of a quadrant's pixels
    quantiles : as of cosmic_rays.tracks;  rng : random numbers of the tracks
    """
    out = np.array(frame, dtype=float)
    for quadrant in out.reshape(-1, *frame.shape[-2:]):
        count = cosmic_rays.event_count(expected, rng)
        part = quadrant[:, prescan : prescan + columns]
        if not rows or not part.size:
            continue
        event, column, row, charge = cosmic_rays.hits(cosmic_rays.events(count, rows, columns, quantiles, rng))
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
        cosmic_rays.add_track(quadrant, packet, column, charge)
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


def _expected_readout(scene: Scene) -> float:
    return cosmic_rays.rate(scene, float((scene.nx // 2) * scene.half_rows)) * scene.value("readout_time", "s")


def _readout(scene: Scene) -> tuple[float, Frame, int, int, int, Traps | None]:
    prescan, half = int(scene.value("fpa.prescan", "pix")), scene.nx // 2
    silicon = charge_transfer.lattice(scene, "parallel") if charge_transfer.PARALLEL.applied(scene) else None
    return _expected_readout(scene), cosmic_rays.quantiles(scene), scene.half_rows, prescan, half, silicon


READOUT = Effect(
    "readout_cosmic_rays",
    apply_readout,
    _readout,
    lambda scene: cosmic_rays.in_a_pixel(scene, _expected_readout(scene)),
    cost=6.5e-3,
    repeated=nothing,
)
