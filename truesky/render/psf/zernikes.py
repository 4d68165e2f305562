"""Zernike polynomials whose sum has the same bits on any processor.

`galsim.zernike.Zernike` multiplies coefficients with BLAS, whose order of summation depends on the processor. Here the
coefficients are added in a fixed order, and galsim evaluates the polynomial.
"""

from __future__ import annotations

from functools import lru_cache
from math import comb, factorial

import numpy as np

from lake_schema.arrays import Float


def sum_of_zernikes(coefficients: Float, x: Float, y: Float) -> Float:
    """Return a sum of Zernike polynomials in the convention of Noll (1976, JOSA 66, 207).

    Parameters
    ----------
    coefficients : float array, shape (z,)
        Coefficients; the index is the Noll number. The first is ignored, because Noll numbers start at 1.
    x, y : float array
        Positions in units of the radius of the circle on which the polynomials have unit variance.

    Returns
    -------
    float array
        The sum in the shape of `x`, in the unit of the coefficients.
    """
    import galsim

    total = np.zeros_like(_polynomial(len(coefficients) - 1, len(coefficients) - 1))
    for noll, value in enumerate(coefficients[1:], start=1):
        total = total + value * _polynomial(noll, len(coefficients) - 1)
    return np.asarray(galsim.utilities.horner2d(x, y, total, dtype=float))


@lru_cache(maxsize=256)
def _polynomial(noll: int, last: int) -> Float:
    """Return a Zernike polynomial as coefficients [i, j] of x**i y**j.

    The array is large enough for all polynomials with Noll numbers up to `last`.
    """
    import galsim

    side = galsim.zernike.noll_to_zern(last)[0] + 1
    n, signed = galsim.zernike.noll_to_zern(noll)
    m = abs(signed)
    # Integers keep the coefficients exact until the last step.
    exact = np.zeros((side, side), dtype=object)
    for k in range((n - m) // 2 + 1):
        radial = (
            (-1) ** k * factorial(n - k) // (factorial(k) * factorial((n + m) // 2 - k) * factorial((n - m) // 2 - k))
        )
        # The term is r**(n - 2 k) cos(m theta), or sin: a power of x**2 + y**2 times a part of (x + i y)**m.
        power = (n - 2 * k - m) // 2
        for a in range(power + 1):
            for b in range(int(signed < 0), m + 1, 2):
                exact[2 * (power - a) + m - b, 2 * a + b] += radial * comb(power, a) * comb(m, b) * (-1) ** (b // 2)
    norm = (n + 1) * (1 if m == 0 else 2)
    return np.asarray(exact.astype(float) * np.sqrt(norm))
