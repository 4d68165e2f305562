"""The loops of sums.product: two orders of going through matrices, one order of adding."""

from __future__ import annotations

from typing import Any

import numpy as np

from truesky.numerics.compiling import exact_jit

# Columns that stay in the processor's nearest memory while they are added to.
_BLOCK = 512


@exact_jit
def of_rows(left: Any, right: Any, out: Any) -> None:
    """Fills out, float64[n, m], with left [n, k] @ right [k, m], four rows of `right` at a time."""
    n, count = left.shape
    m = right.shape[1]
    for first in range(0, m, _BLOCK):
        last = min(first + _BLOCK, m)
        for i in range(n):
            line = out[i, first:last]
            line[:] = 0.0
            for k in range(0, count - 3, 4):
                f0, f1, f2, f3 = (
                    np.float64(left[i, k]), np.float64(left[i, k + 1]),
                    np.float64(left[i, k + 2]), np.float64(left[i, k + 3]),
                )  # fmt: skip
                r0, r1, r2, r3 = (
                    right[k, first:last], right[k + 1, first:last],
                    right[k + 2, first:last], right[k + 3, first:last],
                )  # fmt: skip
                for j in range(last - first):
                    line[j] = (((line[j] + f0 * r0[j]) + f1 * r1[j]) + f2 * r2[j]) + f3 * r3[j]
            for k in range(count - count % 4, count):
                factor, row = np.float64(left[i, k]), right[k, first:last]
                for j in range(last - first):
                    line[j] += factor * row[j]


@exact_jit
def along_rows(left: Any, right: Any, out: Any) -> None:
    """Fills out, float64[n, m], with left [n, k] @ right [m, k] transposed, eight rows of `left` side by side."""
    n, m = len(left), len(right)
    for i in range(0, n - 7, 8):
        a, b, c, d = left[i], left[i + 1], left[i + 2], left[i + 3]
        e, f, g, h = left[i + 4], left[i + 5], left[i + 6], left[i + 7]
        for j in range(m):
            sa = sb = sc = sd = se = sf = sg = sh = 0.0
            for k in range(left.shape[1]):
                x = np.float64(right[j, k])
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
            for k in range(left.shape[1]):
                total += left[i, k] * np.float64(right[j, k])
            out[i, j] = total
