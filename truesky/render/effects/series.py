"""Compiled functions that compute exp(x) and exp(x) - 1 for small x by a power series.

The functions have no branches, so that the compiler can vectorise loops over pixels that call them.
"""

from __future__ import annotations

from typing import Any

from truesky.numerics.compiling import jit

# Largest |x| for which `small_expm1` has its stated error of 1e-14. Callers use another function for larger |x|.
SMALL = 0.25
# Largest |x| for which `small_exp` has its stated error of 1e-12. Callers use another function for larger |x|.
SMALL_EXP = 1.2


@jit
def small_expm1(x: Any) -> Any:
    """Return exp(x) - 1 by its power series to x^11, with a relative error of 1e-14 for |x| < SMALL = 0.25.

    The argument is not checked: for larger |x| the result is inaccurate.
    """
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
    """Return exp(x) as the fourth power of the series of exp(x / 4), with an error of 1e-12 for |x| < SMALL_EXP = 1.2.

    The argument is not checked: for larger |x| the result is inaccurate.
    """
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
