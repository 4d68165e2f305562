"""Products and solutions whose last bit is the same everywhere: no BLAS, which adds as threads and processor have it.

product         of matrices: every sum runs upwards, each product and each sum rounded to float64 as it is made
inverse         of 2 x 2 matrices;  determinant : theirs
least_squares   by Householder's reflections
gauss_legendre  nodes and weights of quadrature

What numpy does element by element, sums along an axis, or by einsum without `optimize` needs none of them.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Array, Float

# Up to so many terms a sum is made of whole arrays, without compiled code; but for matrices of so many numbers.
_FEW, _LARGE = 8, 1 << 18
# Columns from which on it is faster to add rows of the second factor than to follow rows of the first.
_WIDE = 16


def product(one: npt.ArrayLike, other: npt.ArrayLike) -> Any:
    """float64[..., n, m]: what `one @ other` is, up to rounding.

    one   : [..., n, k] or [k], float32 or float64
    other : [k, m] or [k]; of few terms also [..., k, m]
    Error : k 2^-53 of the sum of the terms' sizes
    """
    left, right = np.asarray(one), np.asarray(other)
    rows, columns = left.ndim == 1, right.ndim == 1
    left, right = (left[None] if rows else left), (right[:, None] if columns else right)
    if left.shape[-1] != right.shape[-2]:
        raise ValueError(f"shapes {left.shape} and {right.shape} do not fit")
    large = left.ndim == right.ndim == 2 and len(left) * right.shape[1] >= _LARGE
    if left.shape[-1] <= _FEW and not large:
        out = _of_few(left, right)
    else:
        out = _of_many(left.reshape(-1, left.shape[-1]), right).reshape(*left.shape[:-1], right.shape[-1])
    out = out[..., 0] if columns else out
    out = (out[0] if columns else out[..., 0, :]) if rows else out
    return float(out) if np.ndim(out) == 0 else out


def _of_few(left: Array, right: Array) -> Float:
    shape = np.broadcast_shapes(left.shape[:-2], right.shape[:-2])
    out = np.zeros((*shape, left.shape[-2], right.shape[-1]))
    for k in range(left.shape[-1]):
        out += np.multiply(left[..., :, k, None], right[..., k, None, :], dtype=np.float64)
    return out


def _of_many(left: Array, right: Array) -> Float:
    # Compiled code is imported where it is wanted.
    from truesky.numerics import compiled_sums

    out = np.empty((len(left), right.shape[1]))
    left = np.ascontiguousarray(left, left.dtype if left.dtype == np.float32 else np.float64)
    right = np.asarray(right, right.dtype if right.dtype == np.float32 else np.float64)
    if right.shape[1] < _WIDE:
        compiled_sums.along_rows(left, np.ascontiguousarray(right.T), out)
    else:
        compiled_sums.of_rows(left, np.ascontiguousarray(right), out)
    return out


def inverse(matrix: npt.ArrayLike) -> Float:
    """[..., 2, 2] -> [..., 2, 2]."""
    m = np.asarray(matrix, float)
    a, b, c, d = m[..., 0, 0], m[..., 0, 1], m[..., 1, 0], m[..., 1, 1]
    turned = np.stack([np.stack([d, -b], axis=-1), np.stack([-c, a], axis=-1)], axis=-2)
    return np.asarray(turned / determinant(m)[..., None, None])


def determinant(matrix: npt.ArrayLike) -> Float:
    """[..., 2, 2] -> [...]."""
    m = np.asarray(matrix, float)
    return np.asarray(m[..., 0, 0] * m[..., 1, 1] - m[..., 0, 1] * m[..., 1, 0])


def least_squares(basis: Float, values: Float) -> Float:
    """The x [n] or [n, m] that makes basis @ x nearest to the values.

    basis : [k, n] of n independent columns, k >= n;  values : [k] or [k, m]
    Ref   : Golub & Van Loan 2013, Matrix Computations, section 5.3.2
    """
    upper, wanted = np.array(basis, float), np.array(values, float)
    n = upper.shape[1]
    for i in range(n):
        mirror = upper[i:, i].copy()
        mirror[0] += math.copysign(math.sqrt(np.sum(mirror * mirror)), mirror[0])
        mirror /= math.sqrt(np.sum(mirror * mirror))
        upper[i:, i:] -= 2.0 * np.multiply.outer(mirror, product(mirror, upper[i:, i:]))
        wanted[i:] -= 2.0 * np.multiply.outer(mirror, product(mirror, wanted[i:]))
    found = np.zeros((n, *wanted.shape[1:]))
    for i in reversed(range(n)):
        rest = product(upper[i, i + 1 : n], found[i + 1 :]) if i + 1 < n else 0.0
        found[i] = (wanted[i] - rest) / upper[i, i]
    return found


@lru_cache(maxsize=8)
def gauss_legendre(count: int) -> tuple[Float, Float]:
    """Nodes, ascending, and weights of Gauss's quadrature on [-1, 1], [count] each: read-only.

    Error : 1e-15
    """
    nodes, weights = np.empty((2, count))
    for i in range((count + 1) // 2):
        x = math.cos(math.pi * (i + 0.75) / (count + 0.5))
        for _ in range(8):
            now, slope = _legendre(count, x)
            x -= now / slope
        x = 0.0 if 2 * i + 1 == count else x
        slope = _legendre(count, x)[1]
        nodes[i], nodes[count - 1 - i] = -x, x
        weights[i] = weights[count - 1 - i] = 2.0 / ((1.0 - x) * (1.0 + x) * slope * slope)
    nodes.flags.writeable = weights.flags.writeable = False
    return nodes, weights


def _legendre(count: int, x: float) -> tuple[float, float]:
    """P_count and its derivative."""
    before, now = 1.0, x
    for k in range(2, count + 1):
        before, now = now, ((2 * k - 1) * x * now - (k - 1) * before) / k
    return now, count * (x * now - before) / ((x - 1.0) * (x + 1.0))
