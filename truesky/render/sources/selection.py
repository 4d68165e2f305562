"""Select the HEALPix cells and the sources of a catalogue that may shine on a detector.

A task is a row of the table `tasks`, with a circle on the sky that contains a detector and its surroundings. Galaxies
are stored under the cells of their observed positions. Stars move away from the cell under which they are stored, so
that circles are enlarged by their largest motion.
"""

from __future__ import annotations

from collections.abc import Mapping, Set
from functools import lru_cache
from typing import Any

import numpy as np

from lake_schema import sky
from lake_schema.arrays import Bool, Float, Int
from lake_schema.ids import GENERATION_ORDER, cell_from_id

# Largest distance from a detector, in arcsec, up to which the outskirts of galaxies are drawn on it; diffraction spikes
# of stars have the same limit.
FARTHEST = 1200.0
# Enlargement in degrees of circles on the sky for which HEALPix cells are searched; it exceeds rounding errors.
_ROUNDING = 1e-9
# A catalogue may lack HEALPix cells around a detector. The distance at which the first cell is missing is searched with
# this step, arcsec.
_STEP = 1.0


def cells_of_task(task: Mapping[str, Any], deflection: float) -> list[int]:
    """Return the order-8 HEALPix cells under which the sources in the circle of a task may be stored.

    The circle is `ra`, `dec` and `radius` (deg) of the task. `deflection` is the largest distance (deg) of a source
    from the cell under which it is stored.
    """
    return _cells(task, deflection)


def cells_of_ids(identifiers: Int, is_moved: bool) -> list[int]:
    """Return the order-8 HEALPix cells under which sources may be stored.

    Parameters
    ----------
    identifiers : int64 array, shape (n,)
        Identifiers of the sources. Cells that do not exist are left out.
    is_moved : bool
        Whether a source may be stored in a cell next to that in its identifier, because its observed position differs
        from the true one.

    Returns
    -------
    list of int
        Sorted nested indices of the cells.
    """
    cells = np.unique(cell_from_id(identifiers))
    cells = cells[(cells >= 0) & (cells < 12 << 2 * GENERATION_ORDER)]
    if is_moved and len(cells):
        radius = 1.01 * sky.cell_radius(GENERATION_ORDER)
        centres = zip(*sky.cell_centres(GENERATION_ORDER, cells), strict=True)
        cells = np.unique(np.concatenate([sky.cells_in_cone(*at, radius, GENERATION_ORDER) for at in centres]))
    return [int(cell) for cell in cells]


def cells_within_reach(task: Mapping[str, Any], deflection: float, reach: float) -> list[int]:
    """Return the order-8 HEALPix cells under which sources in an enlarged circle of a task may be stored.

    Parameters
    ----------
    task : mapping
        Row of the table `tasks`, with `ra`, `dec` and `radius` (deg) of a circle around a detector.
    deflection : float
        Largest distance of a source from the cell under which it is stored, deg.
    reach : float
        Distance beyond the circle up to which sources may shine on the detector, arcsec.

    Returns
    -------
    list of int
        Nested indices of the cells.
    """
    return _cells(task, deflection + reach / 3600.0)


def cells_beyond_task(
    task: Mapping[str, Any], deflection: float, reach_arcsec: float, catalogue_cells: Set[int]
) -> tuple[list[int], float]:
    """Return the order-8 HEALPix cells of a catalogue around the circle of a task, without the cells of the circle.

    Parameters
    ----------
    task : mapping
        Row of the table `tasks`, with `ra`, `dec` and `radius` (deg) of a circle around a detector.
    deflection : float
        Largest distance of a source from the cell under which it is stored, deg.
    reach_arcsec : float
        Distance beyond the circle up to which a source may shine on the detector, arcsec.
    catalogue_cells : set of int
        Order-8 cells for which the catalogue was simulated.

    Returns
    -------
    (list of int, float)
        Sorted cells, and the distance beyond the circle in arcsec up to which the catalogue has all cells. It is
        `reach_arcsec`, or a smaller multiple of 1 arcsec if the catalogue lacks cells.
    """
    inner = set(_cells(task, deflection))
    cells = set(_cells(task, deflection + reach_arcsec / 3600.0))
    if cells <= catalogue_cells:
        return sorted(cells - inner), reach_arcsec
    steps = np.arange(0.0, reach_arcsec, _STEP)
    low, high = 0, len(steps)
    while high - low > 1:
        middle = (low + high) // 2
        has = set(_cells(task, deflection + steps[middle] / 3600.0)) <= catalogue_cells
        low, high = (middle, high) if has else (low, middle)
    return sorted((cells - inner) & catalogue_cells), float(steps[low]) if len(steps) else 0.0


def _cells(task: Mapping[str, Any], wider: float) -> list[int]:
    return list(_in_circle(float(task["ra"]), float(task["dec"]), float(task["radius"]) + wider + _ROUNDING))


@lru_cache(maxsize=256)
def _in_circle(ra: float, dec: float, radius: float) -> tuple[int, ...]:
    """Return the order-8 HEALPix cells that overlap a circle (degrees; the radius is limited to 180).

    Results are cached, because several tables are read for the same few circles of a detector.
    """
    return tuple(sky.cells_in_cone(ra, dec, min(radius, 180.0), GENERATION_ORDER).tolist())


def within_radius(ra: Float, dec: Float, centre: tuple[float, float], radius: float | Float) -> Bool:
    """Find positions within a radius of a centre.

    It is used to leave out positions more than 90 deg away, which a gnomonic projection would mirror.

    Parameters
    ----------
    ra, dec : float array, shape (n,)
        ICRS positions in degrees.
    centre : (float, float)
        Right ascension and declination of the centre in degrees.
    radius : float or float array, shape (n,)
        Radius in degrees, for all or for each position.

    Returns
    -------
    bool array, shape (n,)
        True for positions within the radius.
    """
    return np.asarray(sky.separation(ra, dec, centre[0], centre[1]) <= radius)


def overlaps_frame(column: Float, row: Float, sizes: Int | Float, nx: int, ny: int) -> Bool:
    """Find sources whose stamps (square images in which they are drawn) overlap a detector.

    Parameters
    ----------
    column, row : float array, shape (n,)
        Pixel positions of the middles of the stamps, counted from 0.
    sizes : int or float array, shape (n,)
        Sides of the stamps, pixels.
    nx, ny : int
        Numbers of columns and rows of the detector.

    Returns
    -------
    bool array, shape (n,)
        True for stamps that overlap the detector, or miss it by less than half a pixel.
    """
    half = sizes / 2 + 1
    across = (column + half > 0) & (column - half < nx - 1)
    return np.asarray(across & (row + half > 0) & (row - half < ny - 1))
