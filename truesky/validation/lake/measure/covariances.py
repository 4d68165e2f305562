"""Covariances between neighbouring pixels of blank tiles, and the variance of a pixel corrected for them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lake_schema.arrays import Array, Bool, Float

# Lags (rows, columns) at which only offsets of rows, offsets of columns, or slopes cause covariances; two rings for
# slopes.
_ROW, _COLUMN = ((0, 3), (0, 4), (0, 5)), ((3, 0), (4, 0), (5, 0))
_INNER = tuple((i, sign * j) for i, j in ((3, 1), (3, 2), (3, 3), (2, 3), (1, 3)) for sign in (-1, 1))
_OUTER = tuple((2 * i, 2 * j) for i, j in _INNER)


def pixel_variance(values: Array, mask: Bool, reach: int) -> tuple[float, float]:
    """Return the variance of a pixel with charge shared with neighbours, free of row and column offsets and slopes.

    Parameters
    ----------
    values : float array, shape (t, n, n)
        Pixels of the tiles.
    mask : bool array, shape (t, n, n)
        Pixels to use.
    reach : int
        Distance in pixels over which neighbours share charge.

    Returns
    -------
    value, error : float
        Variance and its standard error from the scatter of the tiles.
    """
    n = mask.sum(axis=(1, 2))
    mean = (values * mask).sum(axis=(1, 2), dtype=float) / n
    deviation = np.where(mask, values - mean[:, None, None], 0.0)
    row, column, inner, outer = (
        np.mean([_covariance(deviation, mask, *lag) for lag in lags], 0) for lags in (_ROW, _COLUMN, _INNER, _OUTER)
    )
    # Covariances from slopes fall with the square of the distance, so they are larger at smaller lags.
    nearer = _mean_square_distance(_INNER) - 2.0 * reach * (reach + 1) / 3.0
    smooth = inner + (inner - outer) * nearer / (_mean_square_distance(_OUTER) - _mean_square_distance(_INNER))
    side = 2 * reach + 1
    # Each lag also represents the opposite one.
    half = [(i, j) for i in range(reach + 1) for j in range(-reach, reach + 1) if i > 0 or j > 0]
    total = _covariance(deviation, mask, 0, 0) + 2.0 * np.sum([_covariance(deviation, mask, *lag) for lag in half], 0)
    tile_variance = total - side * (row - inner) - side * (column - inner) - side**2 * smooth
    weight = n / n.sum()
    value = float((weight * tile_variance).sum())
    return value, float(np.sqrt((weight**2 * (tile_variance - value) ** 2).sum()))


def _mean_square_distance(lags: Sequence[tuple[int, int]]) -> float:
    return float(np.mean([i**2 + j**2 for i, j in lags]))


def _covariance(deviation: Float, mask: Bool, down: int, across: int) -> Float:
    """Covariance in each tile of pixels `down` rows (not negative) and `across` columns apart."""
    ny, nx = deviation.shape[1:]
    first = (slice(None), slice(0, ny - down), slice(max(-across, 0), nx - max(across, 0)))
    second = (slice(None), slice(down, ny), slice(max(across, 0), nx - max(-across, 0)))
    pairs = np.count_nonzero(mask[first] & mask[second], axis=(1, 2))
    return np.asarray(np.einsum("tij,tij->t", deviation[first], deviation[second]) / np.maximum(pairs, 1))
