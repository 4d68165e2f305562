"""Which catalogue rows a detector needs.

near       rows within a circle, before any projection
touching   sources whose stamp overlaps the frame
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from lake_schema import sky

Float = npt.NDArray[np.float64]
Int = npt.NDArray[np.int64]
Bool = npt.NDArray[np.bool_]


def near(ra: Float, dec: Float, centre: tuple[float, float], radius: float) -> Bool:
    """[n] True within `radius` deg of a centre; a gnomonic projection is then safe."""
    return np.asarray(sky.separation(ra, dec, centre[0], centre[1]) <= radius)


def touching(column: Float, row: Float, sizes: Int, nx: int, ny: int) -> Bool:
    """[n] True where a stamp of `sizes` pixels about (column, row) overlaps a frame of nx x ny pixels."""
    half = sizes / 2 + 1
    across = (column + half > 0) & (column - half < nx - 1)
    return np.asarray(across & (row + half > 0) & (row - half < ny - 1))
