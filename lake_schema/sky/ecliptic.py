"""Convert ecliptic coordinates, and divide the sky into survey tiles: rows of fields along ecliptic parallels."""

from __future__ import annotations

from functools import cache

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Float, Int
from lake_schema.errors import OutOfRange
from lake_schema.sky import wrap_angle

# Obliquity of the ecliptic at J2000, in deg (IAU 1976).
OBLIQUITY = 23.4392911
# Number of rows of tiles between the ecliptic poles. A row is as high as the step between fields of
# the survey, 0.7 deg. A tile has about the area of Euclid's field of view, 0.5 deg2 (Serrano et al. 2024).
_ROW_COUNT = 257
# Largest width of a tile in deg on the sky, along the middle of its row.
_TILE_WIDTH = 0.714


def ecliptic(ra: npt.ArrayLike, dec: npt.ArrayLike) -> tuple[Float, Float]:
    """Convert ICRS ra, dec (any shape) to ecliptic longitude, 0 to 360, and latitude of J2000, all in deg.

    Notes
    -----
    The error is 0.1 arcsec, because the frame bias between ICRS and the equator of J2000 is neglected.
    """
    return _rotate(ra, dec, OBLIQUITY)


def equatorial(lon: npt.ArrayLike, lat: npt.ArrayLike) -> tuple[Float, Float]:
    """Convert ecliptic longitude and latitude of J2000 (any shape) to ICRS ra, 0 to 360, and dec, all in deg.

    Notes
    -----
    The error is 0.1 arcsec, because the frame bias between ICRS and the equator of J2000 is neglected.
    """
    return _rotate(lon, lat, -OBLIQUITY)


def _rotate(lon: npt.ArrayLike, lat: npt.ArrayLike, angle: float) -> tuple[Float, Float]:
    lon_rad, lat_rad, tilt = (np.radians(np.asarray(value, float)) for value in (lon, lat, angle))
    x, y, z = np.cos(lat_rad) * np.cos(lon_rad), np.cos(lat_rad) * np.sin(lon_rad), np.sin(lat_rad)
    across = np.cos(tilt) * y + np.sin(tilt) * z
    up = np.cos(tilt) * z - np.sin(tilt) * y
    return wrap_angle(np.degrees(np.arctan2(across, x))), np.degrees(np.arctan2(up, np.hypot(x, across)))


# ------------------------------------- survey tiles, about one field of view each


def tile_count() -> int:
    """Return the number of survey tiles on the whole sky, each of about the area of the field of view.

    Tiles are numbered from 0: rows from the southern to the northern ecliptic pole, and eastward in each row.
    """
    return int(_first_tile_of_row()[-1])


def tile_corners(tile: int) -> Float:
    """Return the corners of a survey tile: south-west, south-east, north-east, north-west in ecliptic coordinates.

    Returns
    -------
    float array, shape (4, 2)
        ICRS ra, dec in deg.

    Raises
    ------
    OutOfRange
        If `tile` is negative or not below `tile_count()`.
    """
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
    """Return the number of the first tile of each row of tiles, and as the last element the number of all tiles."""
    row_centre = -90.0 + 180.0 * (np.arange(_ROW_COUNT) + 0.5) / _ROW_COUNT
    counts = np.maximum(np.ceil(360.0 * np.cos(np.radians(row_centre)) / _TILE_WIDTH), 3)
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
