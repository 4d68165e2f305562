"""Select the catalogue cells and rows that a detector needs.

Galaxies belong to the cells of their observed positions. Stars move: circles are enlarged by the largest distance
between a star's position and its cell.
"""

from __future__ import annotations

from collections.abc import Mapping, Set
from functools import lru_cache
from typing import Any

import numpy as np

from lake_schema import sky
from lake_schema.arrays import Bool, Float, Int
from lake_schema.ids import GENERATION_ORDER

# Largest distance up to which galaxies are drawn, arcsec: the same as for spikes of stars.
FARTHEST = 1200.0
# Margin of circles, deg: more than the rounding error of the largest deflection.
_ROUNDING = 1e-9
# Steps of the completeness beyond a detector, arcsec.
_STEP = 1.0


def cells_of_task(task: Mapping[str, Any], deflection: float) -> list[int]:
    """Order-8 cells of all sources in a task's circle.

    The task is a row with `ra`, `dec` and `radius` (deg); `deflection` is the largest of the catalogue, deg.
    """
    return _cells(task, deflection)


def cells_within_reach(task: Mapping[str, Any], deflection: float, reach: float) -> list[int]:
    """Order-8 cells of all sources whose light may fall on the detector.

    Parameters
    ----------
    task : mapping
        Row of the task.
    deflection : float
        Largest deflection of the catalogue, deg.
    reach : float
        Distance up to which sources shine, arcsec.

    Returns
    -------
    list of int
        The cells.
    """
    return _cells(task, deflection + reach / 3600.0)


def cells_beyond_task(
    task: Mapping[str, Any], deflection: float, reach_arcsec: float, catalogue_cells: Set[int]
) -> tuple[list[int], float]:
    """Order-8 cells of a catalogue outside the cells of the circle, up to the distance at which sources shine.

    Parameters
    ----------
    task : mapping
        Row of the task.
    deflection : float
        Largest deflection of the catalogue, deg.
    reach_arcsec : float
        Distance beyond the task's circle up to which a source may reach the detector, arcsec.
    catalogue_cells : set of int
        Order-8 cells of the catalogue.

    Returns
    -------
    (list of int, float)
        The cells, and the distance beyond the circle up to which the catalogue is complete: at most `reach_arcsec`,
        rounded down to 1 arcsec.
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
    """Cells in a circle, cached because every table needs the same few circles of a detector."""
    return tuple(sky.cells_in_cone(ra, dec, min(radius, 180.0), GENERATION_ORDER).tolist())


def within_radius(ra: Float, dec: Float, centre: tuple[float, float], radius: float | Float) -> Bool:
    """Find positions within a radius of a centre, for which a gnomonic projection is safe.

    Parameters
    ----------
    ra, dec : float array, shape (n,)
        Positions, deg.
    centre : (float, float)
        Right ascension and declination of the centre, deg.
    radius : float or float array
        Radius, deg.

    Returns
    -------
    bool array, shape (n,)
        True for positions within the radius.
    """
    return np.asarray(sky.separation(ra, dec, centre[0], centre[1]) <= radius)


def overlaps_frame(column: Float, row: Float, sizes: Int | Float, nx: int, ny: int) -> Bool:
    """Find stamps that overlap a frame.

    Parameters
    ----------
    column, row : float array, shape (n,)
        Middles of the stamps, pixels.
    sizes : int or float array, shape (n,)
        Sides of the stamps, pixels.
    nx, ny : int
        Columns and rows of the frame.

    Returns
    -------
    bool array, shape (n,)
        True for stamps that overlap the frame.
    """
    half = sizes / 2 + 1
    across = (column + half > 0) & (column - half < nx - 1)
    return np.asarray(across & (row + half > 0) & (row - half < ny - 1))
