"""The rest-frame wavelengths of all templates."""

from __future__ import annotations

import numpy as np

from lake_schema.arrays import Float

# Rest frame of galaxies: 24000 A seen at z = -0.02, and 600 A seen at z = 6.5.
_REST_FIRST, REST_LAST = 80, 24500


def rest_grid() -> Float:
    """Wavelengths of galaxy templates, rest frame: 80 .. 24500 A in steps of 1 A."""
    return np.arange(_REST_FIRST, REST_LAST + 1, dtype=float)
