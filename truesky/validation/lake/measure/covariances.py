"""Measure the noise of blank sky in pixels that share charge with their neighbours.

Charge sharing moves variance of a pixel to covariances with its neighbours, which are added to the variance.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lake_schema.arrays import Array, Bool, Float

# Distances (rows, columns) between two pixels of the same row, which are too far apart to share charge. Offsets of rows
# and gradients of the sky correlate them.
_ROW = ((0, 3), (0, 4), (0, 5))
# Distances (rows, columns) between two pixels of the same column, which are too far apart to share charge. Offsets of
# columns and gradients of the sky correlate them.
_COLUMN = ((3, 0), (4, 0), (5, 0))
# Distances (rows, columns) between two pixels in different rows and columns. Only gradients of the sky correlate them.
_INNER = tuple((i, sign * j) for i, j in ((3, 1), (3, 2), (3, 3), (2, 3), (1, 3)) for sign in (-1, 1))
# Distances twice as large as _INNER. The difference of the covariances shows how the effect of gradients depends on
# distance.
_OUTER = tuple((2 * i, 2 * j) for i, j in _INNER)


def pixel_variance(values: Array, mask: Bool, reach: int) -> tuple[float, float]:
    """Return the variance that pixels would have if they did not share charge with their neighbours.

    Covariances with neighbours are added to the variance. The effects of row offsets, column offsets and gradients are
    measured in more distant pixels and subtracted.

    Parameters
    ----------
    values : float array, shape (t, n, n)
        Pixels of t square tiles of blank sky.
    mask : bool array, shape (t, n, n)
        True for pixels to use; at least one in each tile.
    reach : int
        Distance in pixels over which neighbours share charge; 0 if they do not.

    Returns
    -------
    value, error : float
        Variance in the squared unit of `values`, and its standard error from the scatter between tiles.
    """
    n = mask.sum(axis=(1, 2))
    mean = (values * mask).sum(axis=(1, 2), dtype=float) / n
    deviation = np.where(mask, values - mean[:, None, None], 0.0)
    row, column, inner, outer = (
        np.mean([_covariance(deviation, mask, *lag) for lag in lags], 0) for lags in (_ROW, _COLUMN, _INNER, _OUTER)
    )
    # Covariances due to gradients decrease linearly with the squared distance: extrapolate them to small distances.
    nearer = _mean_square_distance(_INNER) - 2.0 * reach * (reach + 1) / 3.0
    smooth = inner + (inner - outer) * nearer / (_mean_square_distance(_OUTER) - _mean_square_distance(_INNER))
    side = 2 * reach + 1
    # Half of the neighbours within `reach`: the covariance at the opposite distance (-i, -j) is the same.
    half = [(i, j) for i in range(reach + 1) for j in range(-reach, reach + 1) if i > 0 or j > 0]
    total = _covariance(deviation, mask, 0, 0) + 2.0 * np.sum([_covariance(deviation, mask, *lag) for lag in half], 0)
    tile_variance = total - side * (row - inner) - side * (column - inner) - side**2 * smooth
    weight = n / n.sum()
    value = float((weight * tile_variance).sum())
    return value, float(np.sqrt((weight**2 * (tile_variance - value) ** 2).sum()))


def _mean_square_distance(lags: Sequence[tuple[int, int]]) -> float:
    return float(np.mean([i**2 + j**2 for i, j in lags]))


def _covariance(deviation: Float, mask: Bool, down: int, across: int) -> Float:
    """Return, for each tile, the covariance of pixels that are `down` (0 or more) rows and `across` columns apart.

    `deviation` has the pixels minus their mean, 0 outside `mask`. Without any pair the covariance is 0.
    """
    ny, nx = deviation.shape[1:]
    first = (slice(None), slice(0, ny - down), slice(max(-across, 0), nx - max(across, 0)))
    second = (slice(None), slice(down, ny), slice(max(across, 0), nx - max(-across, 0)))
    pairs = np.count_nonzero(mask[first] & mask[second], axis=(1, 2))
    return np.asarray(np.einsum("tij,tij->t", deviation[first], deviation[second]) / np.maximum(pairs, 1))
