"""Compute the exponential function near 0 by its series.

The functions have no branches, so that the compiler vectorises loops over pixels.
"""

from __future__ import annotations

from typing import Any

from truesky.numerics.compiling import jit

SMALL, SMALL_EXP = 0.25, 1.2


@jit
def small_expm1(x: Any) -> Any:
    """Return exp(x) - 1 by its series, with an error of 1e-14 for |x| < SMALL."""
    out = 1.0 + x * (1.0 / 11.0)
    out = 1.0 + x * (1.0 / 10.0) * out
    out = 1.0 + x * (1.0 / 9.0) * out
    out = 1.0 + x * (1.0 / 8.0) * out
    out = 1.0 + x * (1.0 / 7.0) * out
    out = 1.0 + x * (1.0 / 6.0) * out
    out = 1.0 + x * (1.0 / 5.0) * out
    out = 1.0 + x * (1.0 / 4.0) * out
    out = 1.0 + x * (1.0 / 3.0) * out
    out = 1.0 + x * (1.0 / 2.0) * out
    return x * out


@jit
def small_exp(x: Any) -> Any:
    """Return exp(x) as the fourth power of the series of exp(x / 4), with an error of 1e-12 for |x| < SMALL_EXP."""
    x = 0.25 * x
    out = 1.0 + x * (1.0 / 10.0)
    out = 1.0 + x * (1.0 / 9.0) * out
    out = 1.0 + x * (1.0 / 8.0) * out
    out = 1.0 + x * (1.0 / 7.0) * out
    out = 1.0 + x * (1.0 / 6.0) * out
    out = 1.0 + x * (1.0 / 5.0) * out
    out = 1.0 + x * (1.0 / 4.0) * out
    out = 1.0 + x * (1.0 / 3.0) * out
    out = 1.0 + x * (1.0 / 2.0) * out
    out = 1.0 + x * out
    out = out * out
    return out * out
