"""What the amplifiers of a detector do, as maps of its pixels and undone: of quadrants and of a ground camera's alike.

of_pixels         their numbers as a map
at_least          pixels that reach their amplifier's number
unread            pixels that none of them reads
undone            what each sees of the others, taken off, and the inverse of their response

A large detector of a ground camera is taken some rows at a time: memory.
"""

from __future__ import annotations

from collections.abc import Callable, Container

import numpy as np

from lake_schema.arrays import Array, Bool, Float
from truesky.render.channels.readout import assemble_frame, split_frame
from truesky.render.effects.readout import crosstalk, nonlinearity
from truesky.render.effects.scene import Scene

# Rows of each amplifier that are taken at a time.
_ROWS = 64


def to_pixels(numbers: float | Float, scene: Scene, rows: slice = slice(None)) -> float | Float:
    """Numbers [q] of the amplifiers as a map [ny, nx] of their pixels, 0 between them; one number stays one.

    rows : of the detector, from the first to one past the last, all of them or some
    """
    if np.ndim(numbers) == 0:
        return numbers
    values, layout = np.asarray(numbers, float), scene.layout
    if layout is None:
        planes_of = np.broadcast_to(values.reshape(-1, 1, 1), (4, scene.half_rows, scene.nx // 2))
        return np.asarray(assemble_frame(planes_of, scene)[rows])
    first, past, _ = rows.indices(layout.ny)
    out = np.zeros((past - first, layout.nx))
    for value, amplifier in zip(values, layout.amplifiers, strict=True):
        low, high = (min(max(y, first), past) for y in (amplifier.pixels.y, amplifier.pixels.y + layout.height))
        out[low - first : high - first, amplifier.pixels.x : amplifier.pixels.x + layout.width] = value
    return out


def pixels_at_least(frame: Array, numbers: float | Float, scene: Scene) -> Bool:
    """Pixels [ny, nx] that are no less than their amplifier's number; those between amplifiers, than 0."""
    out = np.empty(frame.shape, bool)
    for first in range(0, len(frame), _ROWS):
        rows = slice(first, min(first + _ROWS, len(frame)))
        out[rows] = frame[rows] >= to_pixels(numbers, scene, rows)
    return out


def unread_pixels(scene: Scene) -> Bool:
    """[ny, nx] rows between the halves, streets between cells."""
    if scene.layout is not None:
        return scene.layout.unread_pixels
    out = np.zeros((scene.ny, scene.nx), bool)
    out[slice(*scene.unread_rows)] = True
    return out


def undo_effects(frame: Float, scene: Scene, effects: Container[str]) -> Float:
    """Electrons [ny, nx] above the bias, as the amplifiers gave them -> as they came; 0 where none of them reads.

    effects : names of what is undone: crosstalk, by the mission, and then the response
    """
    table = crosstalk.coefficients(scene) if crosstalk.EFFECT.name in effects else None
    curve = nonlinearity.parameters(scene) if nonlinearity.EFFECT.name in effects else None

    def correct(amplifier_planes: Float) -> Float:
        signal = amplifier_planes if table is None else crosstalk.remove(amplifier_planes, table)
        return signal if curve is None else nonlinearity.linearise(signal, *curve)

    return _apply_by_rows(frame, scene, correct)


def _apply_by_rows(frame: Float, scene: Scene, change: Callable[[Float], Float]) -> Float:
    """What `change` makes of [q, rows, columns] that the amplifiers read at the same time; 0 where none reads."""
    layout = scene.layout
    if layout is None:
        return np.asarray(assemble_frame(change(split_frame(frame, scene)), scene))
    out = np.zeros(frame.shape)
    for first in range(0, layout.height, _ROWS):
        rows = slice(first, min(first + _ROWS, layout.height))
        changed_planes = change(
            np.stack(
                [layout.to_detector_axes(frame[a.pixels.slices], q)[rows] for q, a in enumerate(layout.amplifiers)]
            )
        )
        for q, (amplifier, plane) in enumerate(zip(layout.amplifiers, changed_planes, strict=True)):
            layout.to_detector_axes(out[amplifier.pixels.slices], q)[rows] = plane
    return out
