"""Compute matrix products, inverses, least squares and quadrature nodes with the same bits on every machine.

BLAS is not used because its order of summation depends on threads and processor. Element-wise operations of numpy, sums
along an axis, and einsum without `optimize` are reproducible and need no replacement.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Array, Float

# Products with at most this number of terms per sum use array operations of numpy instead of compiled code, unless the
# result is large.
_FEW_TERMS = 8
# Smallest number of elements of a large result.
_LARGE_SIZE = 1 << 18
# Products with at most this number of terms in all sums together also use array operations of numpy: they are fast, and
# numba need not be imported.
_FEW_TERMS_IN_ALL = 1 << 16
# Smallest number of columns of a product for which it is faster to add multiples of rows of the second factor than to
# compute products of rows and columns.
_WIDE_COLUMNS = 16


def matmul(a: npt.ArrayLike, b: npt.ArrayLike) -> Any:
    """Return the product a @ b of matrices or vectors as float64; for two vectors a float.

    `a` has the shape (..., n, k) or (k,), `b` the shape (k, m) or (k,). If k is 8 or less, `b` may also have the shape
    (..., k, m). The k terms of a sum are added in order, with each product and each sum rounded to float64. The error
    is at most k 2^-53 times the sum of the terms' absolute values. Raises ValueError if the shapes do not match.
    """
    matrix_a, matrix_b = np.asarray(a), np.asarray(b)
    a_is_vector, b_is_vector = matrix_a.ndim == 1, matrix_b.ndim == 1
    matrix_a, matrix_b = (matrix_a[None] if a_is_vector else matrix_a), (matrix_b[:, None] if b_is_vector else matrix_b)
    if matrix_a.shape[-1] != matrix_b.shape[-2]:
        raise ValueError(f"shapes {matrix_a.shape} and {matrix_b.shape} do not match: numbers of terms must be equal")
    is_large = matrix_a.ndim == matrix_b.ndim == 2 and len(matrix_a) * matrix_b.shape[1] >= _LARGE_SIZE
    if matrix_a.shape[-1] <= _FEW_TERMS and not is_large:
        out = _multiply_arrays(matrix_a, matrix_b)
    else:
        multiply = _accumulate if matrix_a.size * matrix_b.shape[1] <= _FEW_TERMS_IN_ALL else _multiply_compiled
        out = multiply(matrix_a.reshape(-1, matrix_a.shape[-1]), matrix_b).reshape(
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


def _accumulate(matrix_a: Array, matrix_b: Array) -> Float:
    terms = np.multiply(matrix_a[:, :, None], matrix_b, dtype=np.float64)
    # Add 0 because a sum of terms -0 is 0, as in the other two functions, in which sums begin with 0.
    return np.asarray(np.add.accumulate(terms, axis=1)[:, -1] + 0.0)


def _multiply_compiled(matrix_a: Array, matrix_b: Array) -> Float:
    # Import compiled code here, because importing numba takes time and small products do not need it.
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
    """Return the inverses of 2 x 2 matrices, shape (..., 2, 2); infinite or NaN for a matrix with determinant 0."""
    m = np.asarray(matrix, float)
    a, b, c, d = m[..., 0, 0], m[..., 0, 1], m[..., 1, 0], m[..., 1, 1]
    adjugate = np.stack([np.stack([d, -b], axis=-1), np.stack([-c, a], axis=-1)], axis=-2)
    return np.asarray(adjugate / determinant(m)[..., None, None])


def determinant(matrix: npt.ArrayLike) -> Float:
    """Return the determinants of 2 x 2 matrices, shape (..., 2, 2) -> (...)."""
    m = np.asarray(matrix, float)
    return np.asarray(m[..., 0, 0] * m[..., 1, 1] - m[..., 0, 1] * m[..., 1, 0])


def least_squares(basis: Float, values: Float) -> Float:
    """Return the vector x that minimises |basis @ x - values|, computed with Householder reflections.

    `basis` has the shape (k, n) with n linearly independent columns and k >= n, which is not checked. `values` has the
    shape (k,) or (k, m) for m independent problems, and x has the shape (n,) or (n, m).

    References
    ----------
    Golub & Van Loan 2013, Matrix Computations, section 5.3.2.
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
    """Return nodes and weights of Gauss-Legendre quadrature on [-1, 1], each with an error of 1e-15.

    Both arrays have the shape (count,) and are read-only. The nodes increase. `count` must be at least 1.
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
    """Return the Legendre polynomial P_count and its derivative at x, for count of 1 or more and -1 < x < 1."""
    previous, current = 1.0, x
    for k in range(2, count + 1):
        previous, current = current, ((2 * k - 1) * x * current - (k - 1) * previous) / k
    return current, count * (x * current - previous) / ((x - 1.0) * (x + 1.0))
