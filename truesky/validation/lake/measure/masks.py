"""Masks of pixels: discs around sources, and dilation."""

from __future__ import annotations

import numpy as np

from lake_schema.arrays import Bool, Float
from truesky.numerics.compiling import exact_jit


@exact_jit
def mark_discs(x: Float, y: Float, radius: Float, out: Bool) -> None:
    """Mark pixels within a radius of positions.

    Parameters
    ----------
    x, y : float array, shape (n,)
        Positions, pixels; no disc if one is not finite.
    radius : float array, shape (n,)
        Radius in pixels, edge included; 0 or NaN marks nothing, infinity marks all pixels.
    out : bool array, shape (ny, nx)
        Mask, changed in place; pixels that are already marked stay marked.
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
    """Return a mask dilated by neighbours along rows and columns.

    Parameters
    ----------
    mask : bool array, shape (..., ny, nx)
        Mask.
    corners : bool
        If True, diagonal neighbours are included.
    times : int
        Number of iterations.

    Returns
    -------
    bool array, shape (..., ny, nx)
        Dilated mask.
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
