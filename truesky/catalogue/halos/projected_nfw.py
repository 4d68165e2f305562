"""Projected profile of halos with the profile of Navarro, Frenk & White, cut at R_200m.

x = r / r_s is the projected radius in scale radii and c is the concentration; the profile ends at x = c. The usual
formulae have separate cases for x < 1 and x > 1 and lose precision close to x = 1. The form used here is valid for
both; its variable v changes sign at r_s.

Notes
-----
The error is 1e-7 of F and 1e-6 of m for x >= 1e-8 and 1 <= c <= 60 (tests).

References
----------
Takada & Jain 2003, MNRAS 340, 580 (projected profile) and 344, 857 (shear)
"""

from __future__ import annotations

import numpy as np

from truesky.numerics.compiling import exact_jit

# Below this x, the first terms x^2 ln x are sufficient.
_CENTRE = 1e-4
# The series with this number of terms is used up to this |v|; its error is 0.04^9 / 21 of Psi.
_SERIES_LIMIT, _SERIES_TERMS = 0.04, 9


@exact_jit
def total(c: float) -> float:
    """Return m(c) = M / (4 pi rho_s r_s^3) of a concentration."""
    mass: float = np.log1p(c) - c / (1.0 + c)
    return mass


@exact_jit
def profile(x: float, c: float) -> tuple[float, float]:
    """Return surface density and enclosed mass at projected radius x of a halo with concentration c, 0 < x < c.

    The results are F with Sigma = 2 rho_s r_s F, and m with the mass 4 pi rho_s r_s^3 m inside the circle.
    """
    if x < _CENTRE:
        centre = np.log(2.0 / x) + np.log(c / (1.0 + c)) - c / (1.0 + c)
        return centre, 0.5 * x * x * (centre + 0.5)
    v = (1.0 - x) * (c - x) / ((1.0 + x) * (c + x))
    s = np.sqrt((c - x) / (c + x))
    if abs(v) < _SERIES_LIMIT:
        psi = 0.0
        for i in range(_SERIES_TERMS):
            psi = psi * v + 1.0 / (2.0 * (_SERIES_TERMS - i) + 1.0)
        phi = 1.0 + v * psi
    else:
        root = np.sqrt(abs(v))
        if v > 0.0:
            # 1 - v in a form without loss of precision.
            rest = 2.0 * x * (1.0 + c) / ((1.0 + x) * (c + x))
            phi = (np.log1p(root) - 0.5 * np.log(rest)) / root
        else:
            phi = np.arctan(root) / root
        psi = (phi - 1.0) / v
    psi_term = 2.0 * (c - x) * psi / ((1.0 + x) ** 2 * (c + x))
    surface = s / (1.0 + x) * (psi_term + (c + 2.0 + x) / ((1.0 + x) * (1.0 + c)))
    edge = c + s * (c + x)
    mass = -x * x / ((1.0 + c) * edge) + np.log(x * (1.0 + c) / edge) + 2.0 * s * phi / (1.0 + x)
    return surface, mass
