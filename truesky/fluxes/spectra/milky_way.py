"""Interpolate the extinction law of the Milky Way at wavelengths that are not whole numbers."""

from __future__ import annotations

import numpy as np

from lake_schema.arrays import Float
from truesky.fluxes import passbands
from truesky.fluxes.spectra import extinction


def law(wavelength: Float) -> Float:
    """Return A(lambda) / A(V) of the Milky Way at wavelengths in A; constant outside 600 to 24000 A."""
    grid = passbands.grid()
    return np.asarray(np.interp(wavelength, grid, extinction.milky_way_table(int(grid[0]), len(grid))))
