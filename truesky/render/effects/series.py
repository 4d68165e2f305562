"""The exponential function near 0 by its series, without a branch, so that loops over pixels work on several at a time.

small_expm1   exp(x) - 1 for |x| < SMALL;  small_exp   exp(x) for |x| < SMALL_EXP
"""

from __future__ import annotations

from typing import Any

from truesky.numerics.compiling import jit

SMALL, SMALL_EXP = 0.25, 1.2


@jit
def small_expm1(x: Any) -> Any:
    """exp(x) - 1 by its series, to 1e-14 for |x| < SMALL."""
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
    """exp(x) by the fourth power of the series of a quarter of it, to 1e-12 for |x| < SMALL_EXP."""
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
