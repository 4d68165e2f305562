"""Make masks of pixels: discs around sources, and masks that are enlarged by neighbouring pixels."""

from __future__ import annotations

import numpy as np

from lake_schema.arrays import Bool, Float
from truesky.numerics.compiling import exact_jit


@exact_jit
def mark_discs(x: Float, y: Float, radius: Float, out: Bool) -> None:
    """Set the pixels of a mask to True whose centres are within discs around positions.

    Parameters
    ----------
    x, y : float array, shape (n,)
        Centres of the discs, pixels from 0. Discs with a coordinate that is not finite are skipped.
    radius : float array, shape (n,)
        Radius of each disc, pixels, edge included; 0 or NaN marks nothing, infinity marks all pixels.
    out : bool array, shape (ny, nx)
        Mask, changed in place; pixels that are already True stay True.
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
    """Return a copy of a mask in which the neighbours of True pixels are also True.

    Parameters
    ----------
    mask : bool array, shape (..., ny, nx)
        One or more masks, which are not changed.
    corners : bool
        If True, the eight neighbours including the diagonal ones are set, otherwise the four along rows and columns.
    times : int
        Number of repetitions; 0 returns an unchanged copy.

    Returns
    -------
    bool array, shape (..., ny, nx)
        Enlarged mask.
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
