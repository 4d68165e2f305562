"""Pixels that are left out: discs about sources, and what touches other pixels.

discs    pixels within a radius of places
grown    pixels of a mask, and their neighbours
"""

from __future__ import annotations

import numpy as np

from jobs.compiling import exact_jit
from lake_schema.arrays import Bool, Float


@exact_jit
def discs(x: Float, y: Float, radius: Float, out: Bool) -> None:
    """Mark pixels within a radius of places.

    x, y, radius : [n] pixels, no disc where the radius is 0;  out : bool[ny, nx], what is marked stays marked
    """
    ny, nx = out.shape
    for i in range(len(x)):
        r = radius[i]
        if not r > 0.0:
            continue
        for row in range(max(int(np.ceil(y[i] - r)), 0), min(int(np.floor(y[i] + r)) + 1, ny)):
            half = np.sqrt(max(r * r - (row - y[i]) ** 2, 0.0))
            for column in range(max(int(np.ceil(x[i] - half)), 0), min(int(np.floor(x[i] + half)) + 1, nx)):
                out[row, column] = True


def grown(mask: Bool, corners: bool = False, times: int = 1) -> Bool:
    """bool[.., ny, nx]: its pixels, and their neighbours along rows and columns.

    corners : also across;  times : over again
    """
    out = mask.copy()
    for _ in range(times):
        before = out.copy()
        out[..., 1:, :] |= before[..., :-1, :]
        out[..., :-1, :] |= before[..., 1:, :]
        across = out.copy() if corners else before
        out[..., 1:] |= across[..., :-1]
        out[..., :-1] |= across[..., 1:]
    return out
