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
_FEW_TERMS, _LARGE_SIZE = 8, 1 << 18
# Columns from which on it is faster to add rows of the second factor than to follow rows of the first.
_WIDE_COLUMNS = 16


def matmul(a: npt.ArrayLike, b: npt.ArrayLike) -> Any:
    """float64[..., n, m]: what `one @ other` is, up to rounding.

    one   : [..., n, k] or [k], float32 or float64
    other : [k, m] or [k]; of few terms also [..., k, m]
    Error : k 2^-53 of the sum of the terms' sizes
    """
    matrix_a, matrix_b = np.asarray(a), np.asarray(b)
    a_is_vector, b_is_vector = matrix_a.ndim == 1, matrix_b.ndim == 1
    matrix_a, matrix_b = (matrix_a[None] if a_is_vector else matrix_a), (matrix_b[:, None] if b_is_vector else matrix_b)
    if matrix_a.shape[-1] != matrix_b.shape[-2]:
        raise ValueError(f"shapes {matrix_a.shape} and {matrix_b.shape} do not fit")
    is_large = matrix_a.ndim == matrix_b.ndim == 2 and len(matrix_a) * matrix_b.shape[1] >= _LARGE_SIZE
    if matrix_a.shape[-1] <= _FEW_TERMS and not is_large:
        out = _multiply_arrays(matrix_a, matrix_b)
    else:
        out = _multiply_compiled(matrix_a.reshape(-1, matrix_a.shape[-1]), matrix_b).reshape(
            *matrix_a.shape[:-1], matrix_b.shape[-1]
        )
    out = out[..., 0] if b_is_vector else out
    out = (out[0] if b_is_vector else out[..., 0, :]) if a_is_vector else out
    return float(out) if np.ndim(out) == 0 else out


def _multiply_arrays(matrix_a: Array, matrix_b: Array) -> Float:
    shape = np.broadcast_shapes(matrix_a.shape[:-2], matrix_b.shape[:-2])
    out = np.zeros((*shape, matrix_a.shape[-2], matrix_b.shape[-1]))
    for k in range(matrix_a.shape[-1]):
        out += np.multiply(matrix_a[..., :, k, None], matrix_b[..., k, None, :], dtype=np.float64)
    return out


def _multiply_compiled(matrix_a: Array, matrix_b: Array) -> Float:
    # Compiled code is imported where it is wanted.
    from truesky.numerics import compiled_products

    out = np.empty((len(matrix_a), matrix_b.shape[1]))
    matrix_a = np.ascontiguousarray(matrix_a, matrix_a.dtype if matrix_a.dtype == np.float32 else np.float64)
    matrix_b = np.asarray(matrix_b, matrix_b.dtype if matrix_b.dtype == np.float32 else np.float64)
    if matrix_b.shape[1] < _WIDE_COLUMNS:
        compiled_products.multiply_transposed(matrix_a, np.ascontiguousarray(matrix_b.T), out)
    else:
        compiled_products.multiply_rows(matrix_a, np.ascontiguousarray(matrix_b), out)
    return out


def inverse(matrix: npt.ArrayLike) -> Float:
    """[..., 2, 2] -> [..., 2, 2]."""
    m = np.asarray(matrix, float)
    a, b, c, d = m[..., 0, 0], m[..., 0, 1], m[..., 1, 0], m[..., 1, 1]
    adjugate = np.stack([np.stack([d, -b], axis=-1), np.stack([-c, a], axis=-1)], axis=-2)
    return np.asarray(adjugate / determinant(m)[..., None, None])


def determinant(matrix: npt.ArrayLike) -> Float:
    """[..., 2, 2] -> [...]."""
    m = np.asarray(matrix, float)
    return np.asarray(m[..., 0, 0] * m[..., 1, 1] - m[..., 0, 1] * m[..., 1, 0])


def least_squares(basis: Float, values: Float) -> Float:
    """The x [n] or [n, m] that makes basis @ x nearest to the values.

    basis : [k, n] of n independent columns, k >= n;  values : [k] or [k, m]
    Ref   : Golub & Van Loan 2013, Matrix Computations, section 5.3.2
    """
    upper, rhs = np.array(basis, float), np.array(values, float)
    n = upper.shape[1]
    for i in range(n):
        reflector = upper[i:, i].copy()
        reflector[0] += math.copysign(math.sqrt(np.sum(reflector * reflector)), reflector[0])
        reflector /= math.sqrt(np.sum(reflector * reflector))
        upper[i:, i:] -= 2.0 * np.multiply.outer(reflector, matmul(reflector, upper[i:, i:]))
        rhs[i:] -= 2.0 * np.multiply.outer(reflector, matmul(reflector, rhs[i:]))
    solution = np.zeros((n, *rhs.shape[1:]))
    for i in reversed(range(n)):
        rest = matmul(upper[i, i + 1 : n], solution[i + 1 :]) if i + 1 < n else 0.0
        solution[i] = (rhs[i] - rest) / upper[i, i]
    return solution


@lru_cache(maxsize=8)
def gauss_legendre(count: int) -> tuple[Float, Float]:
    """Nodes, ascending, and weights of Gauss's quadrature on [-1, 1], [count] each: read-only.

    Error : 1e-15
    """
    nodes, weights = np.empty((2, count))
    for i in range((count + 1) // 2):
        x = math.cos(math.pi * (i + 0.75) / (count + 0.5))
        for _ in range(8):
            value, slope = _legendre(count, x)
            x -= value / slope
        x = 0.0 if 2 * i + 1 == count else x
        slope = _legendre(count, x)[1]
        nodes[i], nodes[count - 1 - i] = -x, x
        weights[i] = weights[count - 1 - i] = 2.0 / ((1.0 - x) * (1.0 + x) * slope * slope)
    nodes.flags.writeable = weights.flags.writeable = False
    return nodes, weights


def _legendre(count: int, x: float) -> tuple[float, float]:
    """P_count and its derivative."""
    previous, current = 1.0, x
    for k in range(2, count + 1):
        previous, current = current, ((2 * k - 1) * x * current - (k - 1) * previous) / k
    return current, count * (x * current - previous) / ((x - 1.0) * (x + 1.0))
