"""What pixels of blank tiles have in common with their neighbours, and a pixel's own variance without it.

own_variance   of a pixel, with what its neighbours share of it; offsets of rows and columns, and slopes, taken off
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lake_schema.arrays import Array, Bool, Float

# (Rows, columns) away where offsets of rows, of columns and slopes alone are in common; of the latter two rings.
_ROW, _COLUMN = ((0, 3), (0, 4), (0, 5)), ((3, 0), (4, 0), (5, 0))
_INNER = tuple((i, sign * j) for i, j in ((3, 1), (3, 2), (3, 3), (2, 3), (1, 3)) for sign in (-1, 1))
_OUTER = tuple((2 * i, 2 * j) for i, j in _INNER)


def pixel_variance(values: Array, mask: Bool, reach: int) -> tuple[float, float]:
    """(variance of a pixel with what its neighbours have of it, its standard error from the scatter of the tiles).

    values : float[t, n, n];  kept : which of them count;  near : pixels to either side that share charge
    """
    n = mask.sum(axis=(1, 2))
    mean = (values * mask).sum(axis=(1, 2), dtype=float) / n
    deviation = np.where(mask, values - mean[:, None, None], 0.0)
    row, column, inner, outer = (
        np.mean([_covariance(deviation, mask, *lag) for lag in lags], 0) for lags in (_ROW, _COLUMN, _INNER, _OUTER)
    )
    # What is smooth falls with the square of the distance: so much higher is it where the pixels are nearer.
    nearer = _mean_square_distance(_INNER) - 2.0 * reach * (reach + 1) / 3.0
    smooth = inner + (inner - outer) * nearer / (_mean_square_distance(_OUTER) - _mean_square_distance(_INNER))
    side = 2 * reach + 1
    # Each stands for that on the other side of the pixel, too.
    half = [(i, j) for i in range(reach + 1) for j in range(-reach, reach + 1) if i > 0 or j > 0]
    total = _covariance(deviation, mask, 0, 0) + 2.0 * np.sum([_covariance(deviation, mask, *lag) for lag in half], 0)
    tile_variance = total - side * (row - inner) - side * (column - inner) - side**2 * smooth
    weight = n / n.sum()
    value = float((weight * tile_variance).sum())
    return value, float(np.sqrt((weight**2 * (tile_variance - value) ** 2).sum()))


def _mean_square_distance(lags: Sequence[tuple[int, int]]) -> float:
    """Mean square of the distance."""
    return float(np.mean([i**2 + j**2 for i, j in lags]))


def _covariance(deviation: Float, mask: Bool, down: int, across: int) -> Float:
    """float[t] of pixels that lie so many rows and columns apart; down is not negative."""
    ny, nx = deviation.shape[1:]
    first = (slice(None), slice(0, ny - down), slice(max(-across, 0), nx - max(across, 0)))
    second = (slice(None), slice(down, ny), slice(max(across, 0), nx - max(-across, 0)))
    pairs = np.count_nonzero(mask[first] & mask[second], axis=(1, 2))
    return np.asarray(np.einsum("tij,tij->t", deviation[first], deviation[second]) / np.maximum(pairs, 1))
