"""Pixels that are left out: discs about sources, and what touches other pixels.

discs    pixels within a radius of places
grown    pixels of a mask, and their neighbours
"""

from __future__ import annotations

import numpy as np

from lake_schema.arrays import Bool, Float
from truesky.numerics.compiling import exact_jit


@exact_jit
def mark_discs(x: Float, y: Float, radius: Float, out: Bool) -> None:
    """Mark pixels within a radius of places.

    x, y   : [n] pixels, no disc where either is not finite
    radius : [n] pixels, edge included; none where it is 0 or NaN, everything where it is infinite
    out    : bool[ny, nx], what is marked stays marked
    """
    ny, nx = out.shape
    for i in range(len(x)):
        r = radius[i]
        if not (r > 0.0 and np.isfinite(x[i]) and np.isfinite(y[i])):
            continue
        for row in range(int(np.ceil(max(y[i] - r, 0.0))), int(np.floor(min(y[i] + r, ny - 1.0))) + 1):
            half = np.sqrt(max(r * r - (row - y[i]) ** 2, 0.0))
            first, last = max(x[i] - half, 0.0), min(x[i] + half, nx - 1.0)
            for column in range(int(np.ceil(first)), int(np.floor(last)) + 1):
                out[row, column] = True


def dilate(mask: Bool, corners: bool = False, times: int = 1) -> Bool:
    """bool[.., ny, nx]: binary dilation by the neighbours along rows and columns.

    corners : diagonal neighbours, too;  times : number of iterations
    """
    out = mask.copy()
    for _ in range(times):
        previous = out.copy()
        out[..., 1:, :] |= previous[..., :-1, :]
        out[..., :-1, :] |= previous[..., 1:, :]
        across = out.copy() if corners else previous
        out[..., 1:] |= across[..., :-1]
        out[..., :-1] |= across[..., 1:]
    return out
