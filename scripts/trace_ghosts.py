"""Trace light through the dichroic of Euclid, and write the offsets of ghosts of VIS to lake_schema/mission/models.

    python -m scripts.trace_ghosts

The optical model of the telescope, from which the polynomials of the Euclid pipeline are made, is not public. This
script takes the dichroic as a plane-parallel plate at the exit pupil, and traces the chief ray of each star: directly
to the focal plane, and after one or two reflections by the back of the plate. Only the thickness is fixed by the
radius of the ghosts in the mission database; the tilt follows from the published offset in the middle of the field.
The result is a polynomial of the third degree for each order. All of it is assumed: its numbers are as simulated.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.optimize import brentq

from lake_schema.arrays import Float
from lake_schema.mission.configuration import MissionConfiguration, resolve

TABLE = Path(__file__).parents[1] / "lake_schema" / "mission" / "models" / "vis_ghosts.csv"
# Assumed: refractive index of the dichroic (fused silica), and distance in mm from the exit pupil to the focal plane.
INDEX, PUPIL_DISTANCE_MM = 1.45, 2000.0
# Orders of ghosts: numbers of reflections by the back of the plate.
ORDERS = (1, 2)
# Half of the width of the field that is traced (deg), number of stars along each axis, and degree of the polynomials.
_HALF_FIELD, _STARS, _DEGREE = 0.42, 43, 3
_HEADER = """\
# Ghosts of VIS: offset of a ghost from its star, over the offset of order 1 in the middle of the field
# (vis.ghost.offset_y). x, y: position of the star, degrees from the centre of the focal plane; to_x, to_y: coefficients
# of x^x_power y^y_power. Order: number of reflections by the back of the dichroic (Euclid Data Product Description
# Document). Assumed: a plane-parallel plate {thickness:.1f} mm thick, of index {index:.2f}, at the exit pupil
# {distance:.0f} mm from the focal plane, tilted by {tilt:.2f} deg, which gives the offset of the mission database.
# Error of the fit: {error:.2f} pixels. Written by scripts/trace_ghosts.py. Do not edit.
"""


def thickness_mm(mission: MissionConfiguration) -> float:
    """Return the thickness of the plate: the light of order 1 is out of focus by twice the thickness over the index."""
    radius = mission.value("vis.ghost.radius_out", "pix") * mission.value("vis.fpa.pixel_size", "mm / pix")
    return radius * INDEX * mission.value("plm.f_ratio")


def offsets_mm(x: Float, y: Float, tilt: float, thickness: float, order: int) -> tuple[Float, Float]:
    """Trace chief rays, and return the offsets of ghosts along x and y in mm.

    Parameters
    ----------
    x, y : float array, shape (n,)
        Positions of the stars in the focal plane, mm from its centre.
    tilt : float
        Angle between the plate's normal and the axis of the reflected light, rad, about the x axis.
    thickness : float
        Thickness of the plate, mm.
    order : int
        Number of reflections by the back of the plate.

    Returns
    -------
    dx, dy : float array, shape (n,)
        Offsets in mm.
    """
    ray = np.stack([x, y, np.full_like(x, PUPIL_DISTANCE_MM)])
    ray /= np.linalg.norm(ray, axis=0)
    normal = np.array([0.0, -np.sin(tilt), np.cos(tilt)])
    along = ray - np.outer(normal, normal @ ray)
    sine = np.linalg.norm(along, axis=0)
    # Light leaves the plate parallel to the direct ray, displaced along the plate.
    place = 2.0 * order * thickness / np.sqrt(INDEX**2 - sine**2) * along
    dx, dy, _ = place - ray * place[2] / ray[2]
    return dx, dy


def tilt_of(offset_mm: float, thickness: float) -> float:
    """Return the tilt of the plate (rad) for which a ghost of order 1 in the middle has an offset."""
    middle = np.zeros(1)
    return float(brentq(lambda a: offsets_mm(middle, middle, a, thickness, 1)[1][0] - offset_mm, 0.0, 0.6))


def text(mission: MissionConfiguration) -> str:
    """Return the table of polynomials as text."""
    pixel = mission.value("vis.fpa.pixel_size", "mm / pix")
    middle = mission.value("vis.ghost.offset_y", "pix") * pixel
    thickness = thickness_mm(mission)
    tilt = tilt_of(middle, thickness)
    x, y = (axis.ravel() for axis in np.meshgrid(*[np.linspace(-_HALF_FIELD, _HALF_FIELD, _STARS)] * 2))
    to_mm = 3600.0 * pixel / mission.value("vis.fpa.pixel_scale", "arcsec / pix")
    powers = [(i, n - i) for n in range(_DEGREE + 1) for i in range(n, -1, -1)]
    terms = np.stack([x**i * y**j for i, j in powers], axis=1)
    lines, error = ["order,x_power,y_power,to_x,to_y"], 0.0
    for order in ORDERS:
        relative = np.stack(offsets_mm(to_mm * x, to_mm * y, tilt, thickness, order), axis=1) / middle
        fitted = np.round(np.linalg.lstsq(terms, relative, rcond=None)[0], 5)
        error = max(error, np.abs(terms @ fitted - relative).max() * middle / pixel)
        lines += [f"{order},{i},{j},{a:g},{b:g}" for (i, j), (a, b) in zip(powers, fitted + 0.0, strict=True) if a or b]
    header = _HEADER.format(
        thickness=thickness, index=INDEX, distance=PUPIL_DISTANCE_MM, tilt=np.degrees(tilt), error=error
    )
    return header + "\n".join(lines) + "\n"


if __name__ == "__main__":
    TABLE.write_text(text(resolve()), encoding="utf-8")
