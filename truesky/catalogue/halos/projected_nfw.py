"""Surface density and enclosed projected mass of NFW halos (Navarro, Frenk & White) that are cut at R_200m.

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

# Below this projected radius x, only the leading terms in x are used.
_CENTRE = 1e-4
# For |v| up to _SERIES_LIMIT, the function (artanh(sqrt(v)) / sqrt(v) - 1) / v is computed as a power series with
# _SERIES_TERMS terms; the error is 0.04^9 / 21.
_SERIES_LIMIT, _SERIES_TERMS = 0.04, 9


@exact_jit
def total(c: float) -> float:
    """Return the mass of a halo with concentration c in units of 4 pi rho_s r_s^3: ln(1 + c) - c / (1 + c)."""
    mass: float = np.log1p(c) - c / (1.0 + c)
    return mass


@exact_jit
def profile(x: float, c: float) -> tuple[float, float]:
    """Return surface density and enclosed projected mass of a halo at projected radius x (scale radii), 0 < x < c.

    c is the concentration. The surface density F is in units of 2 rho_s r_s. The mass m inside the circle of radius x
    is in units of 4 pi rho_s r_s^3. The range of x is not checked.
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
            # rest = 1 - v, in a form without loss of precision for v close to 1.
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
