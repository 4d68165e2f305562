"""Offsets of ghosts from their stars: polynomials of the star's position in the focal plane.

A plate of the telescope reflects light twice and causes ghosts. Light of order n was reflected n times by the back of
the plate. The mission database has the offset of order 1 in the middle of the field (`<camera>.<plate>.offset_y`) and
may have a table `<camera>.<plate>.offsets`, whose polynomials multiply it. Without a table there is one order, with the
same offset everywhere.

References
----------
Euclid Data Product Description Document, VIS Ghost Position Model: two orders, polynomials of the position
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Float
from lake_schema.mission.configuration import MissionConfiguration

# Plates that cause ghosts, by camera: the dichroic, and the filter of NISP.
PLATES = {"vis": ("ghost",), "nisp": ("ghost", "filter_ghost")}
# Polynomials of a plate without a table: order, powers of x and y, coefficients of the offsets along x and y.
_CONSTANT = ((1.0, 0.0, 0.0, 0.0, 1.0),)
# Number of positions along each axis of the focal plane at which offsets are checked.
_CHECKED = 9


def orders(mission: MissionConfiguration, camera: str, plate: str) -> tuple[int, ...]:
    """Return the orders of the ghosts of a plate.

    Parameters
    ----------
    mission : MissionConfiguration
        Mission database.
    camera : str
        "vis" or "nisp".
    plate : str
        Part of parameter names that follows the camera, one of `PLATES`.

    Returns
    -------
    tuple of int
        Numbers of reflections by the back of the plate, from 1, ascending.
    """
    return tuple(sorted({int(row[0]) for row in _rows(mission, camera, plate)}))


def offset(
    mission: MissionConfiguration, plate: tuple[str, str], order: int, x: npt.ArrayLike, y: npt.ArrayLike
) -> tuple[Float, Float]:
    """Return the offsets of ghosts from their stars along the axes of the focal plane.

    Parameters
    ----------
    mission : MissionConfiguration
        Mission database.
    plate : (str, str)
        Camera, "vis" or "nisp", and plate, one of `PLATES`.
    order : int
        Order of the ghost, one of `orders`.
    x, y : array_like, shape (n,)
        Positions of the stars in the focal plane, degrees from its centre.

    Returns
    -------
    dx, dy : float64 array, shape (n,)
        Offsets in pixels.
    """
    scale = mission.value(".".join((*plate, "offset_y")), "pix")
    total = np.zeros((2, *np.broadcast_shapes(np.shape(x), np.shape(y))))
    for of_order, i, j, *coefficients in _rows(mission, *plate):
        if of_order == order:
            power = np.asarray(x, float) ** i * np.asarray(y, float) ** j
            total += scale * np.multiply.outer(coefficients, power)
    return total[0], total[1]


def _rows(mission: MissionConfiguration, camera: str, plate: str) -> tuple[tuple[float, ...], ...]:
    key = f"{camera}.{plate}.offsets"
    return mission.numbers(key) if key in mission else _CONSTANT


def faults(mission: MissionConfiguration) -> Iterator[str]:
    """Yield a sentence for each plate whose ghosts leave the focal plane; it names the lowest order that does.

    An offset leaves the focal plane if it exceeds half of its width along x or half of its height along y, for a star
    anywhere in the plane. The ghost of a star in the middle would then be outside.
    """
    for camera, plates in PLATES.items():
        fpa = {key: mission.value(f"{camera}.fpa.{key}") for key in ("nx", "ny", "columns", "rows", "pixel_scale")}
        gaps = [mission.value(f"{camera}.fpa.gap_{axis}", "arcsec") / fpa["pixel_scale"] for axis in "xy"]
        sides = [(fpa["columns"], fpa["nx"], gaps[0]), (fpa["rows"], fpa["ny"], gaps[1])]
        half = 0.5 * np.array([count * (size + gap) - gap for count, size, gap in sides])
        x, y = (fpa["pixel_scale"] / 3600.0 * side * np.linspace(-1.0, 1.0, _CHECKED) for side in half)
        places = [axis.ravel() for axis in np.meshgrid(x, y)]
        for plate in plates:
            for order in orders(mission, camera, plate):
                offsets = np.abs(np.stack(offset(mission, (camera, plate), order, *places)))
                # A coefficient that is not a number leaves the plane, too.
                leaves = ~(offsets <= half[:, None]).all(axis=0)
                if leaves.any():
                    worst = int(np.argmax(np.where(leaves, np.nan_to_num(offsets, nan=np.inf).max(axis=0), -1.0)))
                    place = f"x = {places[0][worst]:.2f}, y = {places[1][worst]:.2f} deg"
                    displaced = f"{offsets[0, worst]:.0f} and {offsets[1, worst]:.0f} pixels"
                    yield (
                        f"mission parameter {camera}.{plate}.offset_y: the ghost of order {order} of a star at {place} "
                        f"is displaced by {displaced} and leaves the focal plane ({half[0]:.0f} and {half[1]:.0f} "
                        "pixels from its middle to its edges)"
                    )
                    break
