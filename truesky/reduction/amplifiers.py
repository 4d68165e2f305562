"""Give each pixel the value (such as the gain) of its amplifier, and correct crosstalk and nonlinearity of amplifiers.

Detectors are read either in four quadrants (VIS of Euclid) or in the layout of amplifiers of a ground camera. Large
detectors of ground cameras are processed a few rows at a time to limit memory.
"""

from __future__ import annotations

from collections.abc import Callable, Container

import numpy as np

from lake_schema.arrays import Array, Bool, Float
from truesky.render.channels.readout import assemble_frame, split_frame
from truesky.render.effects.readout import crosstalk, nonlinearity
from truesky.render.effects.scene import Scene

# Number of rows of each amplifier that are processed at a time, to limit memory.
_ROWS = 64


def to_pixels(numbers: float | Float, scene: Scene, rows: slice = slice(None)) -> float | Float:
    """Return an image in which each pixel has the value of the amplifier that reads it.

    Parameters
    ----------
    numbers : float or float array, shape (q,)
        Value of each of the q amplifiers, such as its gain. A scalar is returned unchanged.
    scene : Scene
        Exposure of the detector, which contains the layout of the amplifiers.
    rows : slice, optional
        Rows of the detector to return; all by default.

    Returns
    -------
    float or float array, shape (number of rows, nx)
        Values of the pixels; 0 for pixels that no amplifier reads.
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
    """Compare each pixel of a frame with a limit that depends on the amplifier, such as the saturation level.

    Parameters
    ----------
    frame : array, shape (ny, nx)
        Pixels of the frame.
    numbers : float or float array, shape (q,)
        Limit of each of the q amplifiers in the unit of `frame`, or one limit for all pixels.
    scene : Scene
        Exposure of the detector, which contains the layout of the amplifiers.

    Returns
    -------
    bool array, shape (ny, nx)
        True for pixels at or above their limit. If limits depend on the amplifier, pixels that no amplifier reads have
        the limit 0.
    """
    out = np.empty(frame.shape, bool)
    for first in range(0, len(frame), _ROWS):
        rows = slice(first, min(first + _ROWS, len(frame)))
        out[rows] = frame[rows] >= to_pixels(numbers, scene, rows)
    return out


def unread_pixels(scene: Scene) -> Bool:
    """Return a mask that is True for pixels that no amplifier reads, bool[ny, nx].

    In VIS these are the rows between the two halves of the CCD, which are read in opposite directions. In detectors
    made of separate cells (GPC1) these are the gaps between cells.
    """
    if scene.layout is not None:
        return scene.layout.unread_pixels
    out = np.zeros((scene.ny, scene.nx), bool)
    out[slice(*scene.unread_rows)] = True
    return out


def undo_effects(frame: Float, scene: Scene, effects: Container[str]) -> Float:
    """Correct a frame for crosstalk between amplifiers and for their nonlinear response.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Measured electrons above the bias. The array is overwritten by the result, to save memory.
    scene : Scene
        Exposure of the detector with its mission parameters, which define both effects exactly.
    effects : container of str
        Effects to correct: "crosstalk", "nonlinearity" or both; other names are ignored. Without these two, the
        electrons of pixels that an amplifier reads are returned unchanged.

    Returns
    -------
    float array, shape (ny, nx)
        `frame` with corrected electrons, 0 in pixels that no amplifier reads.
    """
    table = crosstalk.coefficients(scene) if crosstalk.EFFECT.name in effects else None
    curve = nonlinearity.parameters(scene) if nonlinearity.EFFECT.name in effects else None

    def correct(amplifier_planes: Float) -> Float:
        signal = amplifier_planes if table is None else crosstalk.remove(amplifier_planes, table)
        return signal if curve is None else nonlinearity.linearise(signal, *curve)

    return _apply_by_rows(frame, scene, correct)


def _apply_by_rows(frame: Float, scene: Scene, change: Callable[[Float], Float]) -> Float:
    """Apply `change` to the pixels of a frame [ny, nx], arranged by the q amplifiers, in place, and return the frame.

    `change` gets and returns arrays [q, rows, columns] in which the same position is read at the same time by all
    amplifiers. Pixels that no amplifier reads become 0.
    """
    layout = scene.layout
    if layout is None:
        frame[:] = assemble_frame(change(split_frame(frame, scene)), scene)
        return frame
    frame[layout.unread_pixels] = 0.0
    for first in range(0, layout.height, _ROWS):
        rows = slice(first, min(first + _ROWS, layout.height))
        changed_planes = change(
            np.stack(
                [layout.to_detector_axes(frame[a.pixels.slices], q)[rows] for q, a in enumerate(layout.amplifiers)]
            )
        )
        for q, (amplifier, plane) in enumerate(zip(layout.amplifiers, changed_planes, strict=True)):
            layout.to_detector_axes(frame[amplifier.pixels.slices], q)[rows] = plane
    return frame
