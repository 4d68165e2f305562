"""Ecliptic coordinates, and the tiles that the sky is cut into along them.

ecliptic, equatorial     ICRS <-> ecliptic longitude and latitude
tile_count, tile_corners number of tiles, and where a tile lies
"""

from __future__ import annotations

from functools import cache

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Float, Int
from lake_schema.errors import OutOfRange
from lake_schema.sky import wrap_angle

# IAU 1976 obliquity at J2000, deg.
OBLIQUITY = 23.4392911
# Tiles are about 0.5 deg2, the field of view (Serrano et al. 2024); rows as high as a field's step.
_ROW_COUNT, _TILE_WIDTH = 257, 0.714


def ecliptic(ra: npt.ArrayLike, dec: npt.ArrayLike) -> tuple[Float, Float]:
    """ICRS [n] -> ecliptic longitude [0, 360) and latitude [n], deg, J2000.  Error: 0.1 arcsec (frame bias)."""
    return _rotate(ra, dec, OBLIQUITY)


def equatorial(lon: npt.ArrayLike, lat: npt.ArrayLike) -> tuple[Float, Float]:
    """Ecliptic longitude and latitude [n], J2000 -> ICRS ra [0, 360), dec [n], deg.  Error: 0.1 arcsec"""
    return _rotate(lon, lat, -OBLIQUITY)


def _rotate(lon: npt.ArrayLike, lat: npt.ArrayLike, angle: float) -> tuple[Float, Float]:
    lon_rad, lat_rad, tilt = (np.radians(np.asarray(value, float)) for value in (lon, lat, angle))
    x, y, z = np.cos(lat_rad) * np.cos(lon_rad), np.cos(lat_rad) * np.sin(lon_rad), np.sin(lat_rad)
    across = np.cos(tilt) * y + np.sin(tilt) * z
    up = np.cos(tilt) * z - np.sin(tilt) * y
    return wrap_angle(np.degrees(np.arctan2(across, x))), np.degrees(np.arctan2(up, np.hypot(x, across)))


# ------------------------------------------------------------------------------------------------ tiles


def tile_count() -> int:
    """Number of tiles; they are numbered from 0, rows from the south, eastward in a row."""
    return int(_first_tile_of_row()[-1])


def tile_corners(tile: int) -> Float:
    """[4, 2] ICRS ra, dec deg of a tile's corners, in order around it."""
    first = _first_tile_of_row()
    if not 0 <= tile < first[-1]:
        raise OutOfRange("tile", tile, 0, int(first[-1]) - 1)
    row = int(np.searchsorted(first, tile, "right")) - 1
    count, column = int(first[row + 1] - first[row]), tile - int(first[row])
    west, east = 360.0 * column / count, 360.0 * (column + 1) / count
    south, north = -90.0 + 180.0 * row / _ROW_COUNT, -90.0 + 180.0 * (row + 1) / _ROW_COUNT
    return np.stack(equatorial([west, east, east, west], [south, south, north, north]), axis=1)


@cache
def _first_tile_of_row() -> Int:
    """Number of the first tile of each row, and of all tiles."""
    row_centre = -90.0 + 180.0 * (np.arange(_ROW_COUNT) + 0.5) / _ROW_COUNT
    counts = np.maximum(np.ceil(360.0 * np.cos(np.radians(row_centre)) / _TILE_WIDTH), 3)
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
