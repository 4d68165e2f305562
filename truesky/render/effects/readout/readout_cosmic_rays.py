"""Cosmic rays that arrive during the readout: their charge appears in the image some rows after the pixels they hit."""

from __future__ import annotations

from typing import Any

import numpy as np

from lake_schema.arrays import Int
from truesky.numerics.compiling import jit
from truesky.render.effects.charge import cosmic_rays, track_charge
from truesky.render.effects.charge.track_charge import Spread
from truesky.render.effects.effect import Effect, copy_frame, zero_contribution
from truesky.render.effects.readout import charge_transfer
from truesky.render.effects.readout.traps import Traps
from truesky.render.effects.scene import Frame, Scene

# Electrons that traps still hold, below which the trail that they release behind a cosmic ray is not followed further.
_NEGLIGIBLE = 1e-3


def apply_readout(
    frame: Frame, expected: float, quantiles: Frame, pixels: tuple[int, int, int], silicon: Traps | None,
    spread: Spread, rng: np.random.Generator, out: Frame | None = None,
) -> Frame:  # fmt: skip
    """Draw the cosmic rays that arrive while the quadrants of a detector are read, and add their charge.

    Parameters
    ----------
    frame : float array, shape (q, ny, nx)
        Electrons of each of the q quadrants, with the pixel at [0, 0] read first.
    expected : float
        Expected number of tracks on the pixels of one quadrant during the readout, 0 to 1e8.
    quantiles : float array, shape (n, 3)
        Distribution of tracks: cumulative probability (ascending), length in pixels and charge in electrons.
    pixels : (int, int, int)
        Number of rows of a quadrant that are pixels (the following rows are overscan), number of prescan columns
        before the pixels, and number of columns that are pixels.
    silicon : Traps or None
        Traps along the columns, which capture and release charge. None to ignore them.
    spread : Spread
        Fluctuations of the charge along the tracks, and diffusion.
    rng : numpy.random.Generator
        Random generator of the tracks.
    out : float64 array, shape of `frame`, optional
        Array for the result, which may be `frame` itself. By default a new array.

    Returns
    -------
    float array, shape of `frame`
        Electrons including the cosmic rays.

    Raises
    ------
    OutOfRange
        If `expected` is outside its limits or NaN.
    """
    out, (rows, prescan, columns) = copy_frame(frame, out), pixels
    for quadrant in out.reshape(-1, *frame.shape[-2:]):
        count = cosmic_rays.draw_event_count(expected, rng)
        part = quadrant[:, prescan : prescan + columns]
        if not rows or not part.size:
            continue
        for batch in cosmic_rays.batches(count, spread):
            events = cosmic_rays.draw_events(batch, rows, columns, quantiles, rng)
            crossings = cosmic_rays.pixels_of_events(events)
            event, column, row, charge = track_charge.distribute(events, crossings, spread, rng)
            # Number of rows that were read before the cosmic ray arrived. Its charge is read that many rows later than
            # its pixel.
            rows_read = rng.integers(0, quadrant.shape[0], batch)
            column, row = column % part.shape[1], row % rows
            packet = row + rows_read[event]
            read = packet < len(part)
            hits = column[read], packet[read], row[read], charge[read]
            if not spread.is_thin:
                hits = _merge_hits(event[read], hits)
            _deposit(part, *hits, silicon)
    return out


def _merge_hits(event: Int, hits: tuple[Int, Int, Int, Frame]) -> tuple[Int, Int, Int, Frame]:
    """Add up the charge that a wide track leaves in a pixel from several parts of its path.

    `event` is the index of the track of each hit, and `hits` has the column, packet, row and electrons, as `_deposit`
    takes them. Each pixel of a track is listed once in the result. Otherwise its parts would fill the same traps.
    """
    column, packet, row, charge = hits
    order = np.lexsort((packet, column, event))
    places = np.stack([event, column, packet])[:, order]
    first = np.flatnonzero(np.append(True, (np.diff(places, axis=1) != 0).any(axis=0))[: len(order)])
    if not len(first):
        return hits
    chosen = order[first]
    return column[chosen], packet[chosen], row[chosen], np.add.reduceat(charge[order], first)


def _deposit(quadrant: Frame, column: Int, packet: Int, row: Int, charge: Frame, silicon: Traps | None) -> None:
    """Add the charge of cosmic rays to a quadrant in place; traps capture a part of it and release it as a trail.

    For each hit pixel, `row` is its row, `packet` the row of the image in which its charge is read, `column` its
    column, and `charge` its electrons. Rows count from the one read first. `silicon` are the traps along the columns,
    or None for no traps. As an approximation, traps above the existing charge are empty unless earlier cosmic rays have
    filled them. The error is a tenth of the effect of traps.
    """
    if silicon is None:
        cosmic_rays.add_charge(quadrant, packet, column, charge)
        return
    order = np.lexsort((packet, column))
    column, packet, row = (x[order] for x in (column, packet, row))
    charge = charge[order]
    existing = quadrant[packet, column]
    # Traps on the way down from the hit pixel that the added charge reaches but the existing charge does not. They are
    # counted as a number of pixels with all their traps.
    reached = (row + 1) * (silicon.volume(existing + charge) - silicon.volume(existing))
    released = -np.expm1(-1.0 / np.array(silicon.release))
    _add_trails(quadrant, column, packet, charge, reached, np.array(silicon.density), released)


@jit
def _add_trails(
    quadrant: Any, column: Any, packet: Any, charge: Any, reached: Any, density: Any, released: Any
) -> None:
    """Add the charge of cosmic rays and the trails of charge released from traps to a quadrant, in place.

    The hits are sorted by column, then by `packet` (row of the image, from the one read first). `charge` has the
    electrons of each hit, and `reached` the number of pixels, with fraction, whose traps only this charge reaches.
    `density` is the number of traps per pixel of each species, and `released` the fraction of trapped electrons
    released per row.
    """
    trapped = np.zeros(len(density))
    for i in range(len(column)):
        if i == 0 or column[i] != column[i - 1]:
            trapped[:] = 0.0
        free = np.maximum(density * reached[i] - trapped, 0.0)
        captured = min(free.sum(), charge[i])
        trapped += free * (captured / max(free.sum(), 1e-300))
        quadrant[packet[i], column[i]] += charge[i] - captured
        another = i + 1 < len(column) and column[i + 1] == column[i]
        for p in range(packet[i] + 1, packet[i + 1] + 1 if another else len(quadrant)):
            emitted = 0.0
            for s in range(len(trapped)):
                emitted += trapped[s] * released[s]
                trapped[s] -= trapped[s] * released[s]
            quadrant[p, column[i]] += emitted
            if trapped.sum() < _NEGLIGIBLE:
                break


def _expected_readout(scene: Scene) -> float:
    return cosmic_rays.event_rate(scene, float((scene.nx // 2) * scene.half_rows)) * scene.value("readout_time", "s")


def _readout_parameters(scene: Scene) -> tuple[float, Frame, tuple[int, int, int], Traps | None, Spread]:
    prescan, half = int(scene.value("fpa.prescan", "pix")), scene.nx // 2
    silicon = charge_transfer.silicon_traps(scene, "parallel") if charge_transfer.PARALLEL.is_applied(scene) else None
    pixels, spread = (scene.half_rows, prescan, half), track_charge.of_scene(scene)
    return _expected_readout(scene), cosmic_rays.track_quantiles(scene), pixels, silicon, spread


READOUT = Effect(
    "readout_cosmic_rays",
    apply_readout,
    _readout_parameters,
    lambda scene: cosmic_rays.median_pixel(scene, _expected_readout(scene)),
    cost=6.5e-3,
    systematic=zero_contribution,
    in_place=True,
)
