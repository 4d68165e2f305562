"""What the amplifiers of a detector do, as maps of its pixels and undone: of quadrants and of a ground camera's alike.

of_pixels         their numbers as a map
unread            pixels that none of them reads
linearised        the inverse of their response
without_crosstalk what each sees of the others, taken off
"""

from __future__ import annotations

import numpy as np

from jobs.render.channels.readout import pixels, planes
from jobs.render.effects.readout import crosstalk, nonlinearity
from jobs.render.effects.scene import Scene
from lake_schema.arrays import Bool, Float


def of_pixels(numbers: float | Float, scene: Scene) -> float | Float:
    """Numbers [q] of the amplifiers as a map [ny, nx] of their pixels, 0 between them; one number stays one."""
    if np.ndim(numbers) == 0:
        return numbers
    values = np.asarray(numbers, float).reshape(-1, 1, 1)
    own = scene.layout
    if own is None:
        return pixels(np.broadcast_to(values, (4, scene.half_rows, scene.nx // 2)), scene)
    return pixels(np.broadcast_to(values, (len(values), own.height + own.rows, own.scans + own.width)), scene)


def unread(scene: Scene) -> Bool:
    """[ny, nx] rows between the halves, streets between cells."""
    if scene.layout is not None:
        return scene.layout.streets
    out = np.zeros((scene.ny, scene.nx), bool)
    out[slice(*scene.unread)] = True
    return out


def linearised(frame: Float, scene: Scene) -> Float:
    """Electrons [ny, nx] above the bias, as the amplifiers gave them -> as they came."""
    curve = nonlinearity.parameters(scene)
    if all(np.ndim(number) == 0 for number in curve):
        return nonlinearity.linearised(frame, *curve)
    return np.asarray(pixels(nonlinearity.linearised(planes(frame, scene), *curve), scene))


def without_crosstalk(frame: Float, scene: Scene) -> Float:
    """Electrons [ny, nx] above the bias -> without what each amplifier saw of the others, by the mission."""
    return np.asarray(pixels(crosstalk.removed(planes(frame, scene), crosstalk.coefficients(scene)), scene))
