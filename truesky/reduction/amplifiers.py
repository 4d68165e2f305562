"""Map values of amplifiers to pixels, and undo the effects of amplifiers, for quadrants and for ground cameras.

Large detectors of ground cameras are processed a few rows at a time to limit memory.
"""

from __future__ import annotations

from collections.abc import Callable, Container

import numpy as np

from lake_schema.arrays import Array, Bool, Float
from truesky.render.channels.readout import assemble_frame, split_frame
from truesky.render.effects.readout import crosstalk, nonlinearity
from truesky.render.effects.scene import Scene

# Rows of each amplifier that are processed at a time.
_ROWS = 64


def to_pixels(numbers: float | Float, scene: Scene, rows: slice = slice(None)) -> float | Float:
    """Return a map of the pixels with the value of each pixel's amplifier.

    Parameters
    ----------
    numbers : float or float array, shape (q,)
        Values of the amplifiers. A scalar is returned unchanged.
    scene : Scene
        Scene with the layout of the amplifiers.
    rows : slice, optional
        Rows of the detector; all by default.

    Returns
    -------
    float or float array, shape (ny, nx)
        Map, 0 between amplifiers.
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
    """Return True for pixels at or above the value of their amplifier, or at or above 0 between amplifiers.

    Parameters
    ----------
    frame : array, shape (ny, nx)
        The frame.
    numbers : float or float array, shape (q,)
        Values of the amplifiers.
    scene : Scene
        Scene with the layout of the amplifiers.

    Returns
    -------
    bool array, shape (ny, nx)
        Mask.
    """
    out = np.empty(frame.shape, bool)
    for first in range(0, len(frame), _ROWS):
        rows = slice(first, min(first + _ROWS, len(frame)))
        out[rows] = frame[rows] >= to_pixels(numbers, scene, rows)
    return out


def unread_pixels(scene: Scene) -> Bool:
    """Return the mask of pixels that no amplifier reads, bool[ny, nx].

    These are the rows between the two halves of a detector and the gaps between its cells.
    """
    if scene.layout is not None:
        return scene.layout.unread_pixels
    out = np.zeros((scene.ny, scene.nx), bool)
    out[slice(*scene.unread_rows)] = True
    return out


def undo_effects(frame: Float, scene: Scene, effects: Container[str]) -> Float:
    """Undo crosstalk and the nonlinear response of the amplifiers.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Measured electrons above the bias.
    scene : Scene
        Scene with the mission parameters of these effects.
    effects : container of str
        Names of the effects to undo.

    Returns
    -------
    float array, shape (ny, nx)
        Corrected electrons, 0 in pixels that no amplifier reads.
    """
    table = crosstalk.coefficients(scene) if crosstalk.EFFECT.name in effects else None
    curve = nonlinearity.parameters(scene) if nonlinearity.EFFECT.name in effects else None

    def correct(amplifier_planes: Float) -> Float:
        signal = amplifier_planes if table is None else crosstalk.remove(amplifier_planes, table)
        return signal if curve is None else nonlinearity.linearise(signal, *curve)

    return _apply_by_rows(frame, scene, correct)


def _apply_by_rows(frame: Float, scene: Scene, change: Callable[[Float], Float]) -> Float:
    """Apply `change` to arrays [q, rows, columns] of simultaneously read pixels; pixels without amplifier become 0."""
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
