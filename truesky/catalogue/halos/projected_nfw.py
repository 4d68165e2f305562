"""Halos with the profile of Navarro, Frenk & White, cut at R_200m and seen in projection.

surface   what their convergence follows
enclosed  the mass inside a circle

x = r / r_s is the projected radius in scale radii, c the concentration; both end at x = c. The usual forms have cases
for x < 1 and x > 1, and lose all digits between them: here one form holds, whose v changes its sign at r_s.
Error: 1e-7 of F, 1e-6 of m for x >= 1e-8 and 1 <= c <= 60 (tests)
Ref: Takada & Jain 2003, MNRAS 340, 580 (projected profile) and 344, 857 (shear)
"""

from __future__ import annotations

import numpy as np

from truesky.numerics.compiling import exact_jit

# Closer to the centre than this the first terms are enough, x^2 ln x.
_CENTRE = 1e-4
# |v| up to which the series of so many terms is taken: 0.04^9 / 21 of Psi.
_SERIES_LIMIT, _SERIES_TERMS = 0.04, 9


@exact_jit
def total(c: float) -> float:
    """m(c) = M / (4 pi rho_s r_s^3)."""
    mass: float = np.log1p(c) - c / (1.0 + c)
    return mass


@exact_jit
def profile(x: float, c: float) -> tuple[float, float]:
    """(F, m) at 0 < x < c: Sigma = 2 rho_s r_s F, and 4 pi rho_s r_s^3 m inside the circle.

    x : projected radius in scale radii;  c : concentration
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
            # 1 - v, without the difference.
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
