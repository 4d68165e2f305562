"""Which catalogue rows a detector needs.

needed     cells of which every source counts
within     these and whatever cell may matter besides
beyond     cells that lie farther out, of which the bright sources count
near       rows within a circle, before any projection
touching   sources whose stamp overlaps the frame

Cells hold galaxies by where they are seen. Stars move: circles are widened by how far a star may be seen from where its
cell says.
"""

from __future__ import annotations

from collections.abc import Mapping, Set
from functools import lru_cache
from typing import Any

import numpy as np

from lake_schema import sky
from lake_schema.arrays import Bool, Float, Int
from lake_schema.ids import GENERATION_ORDER

# Galaxies are followed so far, arcsec: as far as stars' spikes.
FARTHEST = 1200.0
# Added to circles: more than the rounding of the largest deflection, deg.
_ROUNDING = 1e-9
# Steps in which the completeness beyond a detector is told, arcsec.
_STEP = 1.0


def cells_of_task(task: Mapping[str, Any], deflection: float) -> list[int]:
    """Order-8 cells of every source that is seen within a task's circle.

    task : ra, dec, radius of the table `tasks`;  deflection : largest of the catalogue, deg
    """
    return _cells(task, deflection)


def cells_within_reach(task: Mapping[str, Any], deflection: float, reach: float) -> list[int]:
    """Order-8 cells of every source whose light may be on the detector; reach : stamps.reach, arcsec."""
    return _cells(task, deflection + reach / 3600.0)


def cells_beyond_task(
    task: Mapping[str, Any], deflection: float, reach_arcsec: float, catalogue_cells: Set[int]
) -> tuple[list[int], float]:
    """(the catalogue's order-8 cells outside the needed ones, how far it is complete), as far as sources shine.

    farther : how far beyond the task's circle a source may be seen and reach the detector, arcsec
    drawn   : order-8 cells that the catalogue has
    task    : its row;  deflection : largest of the galaxies, deg
    returns : the second in arcsec beyond the task's circle, at most `farther`, rounded down to 1"
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
    """Of each detector the same few circles are asked for by every table."""
    return tuple(sky.cells_in_cone(ra, dec, min(radius, 180.0), GENERATION_ORDER).tolist())


def within_radius(ra: Float, dec: Float, centre: tuple[float, float], radius: float | Float) -> Bool:
    """[n] True within `radius` deg of a centre; a gnomonic projection is then safe.

    ra, dec : float64[n] deg;  centre : ra, dec deg
    """
    return np.asarray(sky.separation(ra, dec, centre[0], centre[1]) <= radius)


def overlaps_frame(column: Float, row: Float, sizes: Int | Float, nx: int, ny: int) -> Bool:
    """[n] True where a stamp of `sizes` pixels about (column, row) overlaps a frame of nx x ny pixels."""
    half = sizes / 2 + 1
    across = (column + half > 0) & (column - half < nx - 1)
    return np.asarray(across & (row + half > 0) & (row - half < ny - 1))
