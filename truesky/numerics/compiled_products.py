"""Compiled loops of the matrix product `matrices.matmul`.

The two functions read the matrices in different orders, each faster for some shapes. They add terms in the same order,
so that their results agree in every bit.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from truesky.numerics.compiling import exact_jit

# Number of columns of the result that are computed together, so that they stay in the cache of the processor.
_BLOCK = 512


@exact_jit
def multiply_rows(matrix_a: Any, matrix_b: Any, out: Any) -> None:
    """Fill `out` with matrix_a @ matrix_b by adding multiples of the rows of `matrix_b`; fast if m is large.

    Parameters
    ----------
    matrix_a : float array, shape (n, k)
        First factor.
    matrix_b : float array, shape (k, m)
        Second factor.
    out : float64 array, shape (n, m)
        Output: the product. Shapes are not checked.
    """
    n, count = matrix_a.shape
    m = matrix_b.shape[1]
    for first in range(0, m, _BLOCK):
        last = min(first + _BLOCK, m)
        for i in range(n):
            line = out[i, first:last]
            line[:] = 0.0
            for k in range(0, count - 3, 4):
                f0, f1, f2, f3 = (
                    np.float64(matrix_a[i, k]), np.float64(matrix_a[i, k + 1]),
                    np.float64(matrix_a[i, k + 2]), np.float64(matrix_a[i, k + 3]),
                )  # fmt: skip
                r0, r1, r2, r3 = (
                    matrix_b[k, first:last], matrix_b[k + 1, first:last],
                    matrix_b[k + 2, first:last], matrix_b[k + 3, first:last],
                )  # fmt: skip
                for j in range(last - first):
                    line[j] = (((line[j] + f0 * r0[j]) + f1 * r1[j]) + f2 * r2[j]) + f3 * r3[j]
            for k in range(count - count % 4, count):
                factor, row = np.float64(matrix_a[i, k]), matrix_b[k, first:last]
                for j in range(last - first):
                    line[j] += factor * row[j]


@exact_jit
def multiply_transposed(matrix_a: Any, matrix_b: Any, out: Any) -> None:
    """Fill `out` with matrix_a @ matrix_b.T by products of rows; fast if m is small.

    Parameters
    ----------
    matrix_a : float array, shape (n, k)
        First factor. Eight of its rows are processed at a time.
    matrix_b : float array, shape (m, k)
        Second factor, transposed.
    out : float64 array, shape (n, m)
        Output: the product. Shapes are not checked.
    """
    n, m = len(matrix_a), len(matrix_b)
    for i in range(0, n - 7, 8):
        a, b, c, d = matrix_a[i], matrix_a[i + 1], matrix_a[i + 2], matrix_a[i + 3]
        e, f, g, h = matrix_a[i + 4], matrix_a[i + 5], matrix_a[i + 6], matrix_a[i + 7]
        for j in range(m):
            sa = sb = sc = sd = se = sf = sg = sh = 0.0
            for k in range(matrix_a.shape[1]):
                x = np.float64(matrix_b[j, k])
                sa += a[k] * x
                sb += b[k] * x
                sc += c[k] * x
                sd += d[k] * x
                se += e[k] * x
                sf += f[k] * x
                sg += g[k] * x
                sh += h[k] * x
            out[i, j], out[i + 1, j], out[i + 2, j], out[i + 3, j] = sa, sb, sc, sd
            out[i + 4, j], out[i + 5, j], out[i + 6, j], out[i + 7, j] = se, sf, sg, sh
    for i in range(n - n % 8, n):
        for j in range(m):
            total = 0.0
            for k in range(matrix_a.shape[1]):
                total += matrix_a[i, k] * np.float64(matrix_b[j, k])
            out[i, j] = total
