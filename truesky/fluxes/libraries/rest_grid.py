"""Define the rest-frame wavelengths of galaxy templates."""

from __future__ import annotations

import numpy as np

from lake_schema.arrays import Float

# First and last rest-frame wavelength of galaxy templates, A: 600 A observed at z = 6.5, and 24000 A observed at
# z = -0.02.
_REST_FIRST, REST_LAST = 80, 24500


def rest_grid() -> Float:
    """Return the rest-frame wavelengths of galaxy templates, 80 to 24500 A in steps of 1 A: float64[24421]."""
    return np.arange(_REST_FIRST, REST_LAST + 1, dtype=float)
