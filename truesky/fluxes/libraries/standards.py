"""Compute spectra of calibration sources: Vega, a white dwarf and a planetary nebula."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from lake_schema.arrays import Float
from truesky.fluxes import passbands
from truesky.fluxes.libraries import stellar

NAMES = ("Vega", "white dwarf DA", "planetary nebula")

# Effective temperature (K) of a hot white dwarf of type DA such as GD 71: Bohlin, Hubeny & Rauch 2020.
_WHITE_DWARF_TEFF = 33_590.0
# Depth and Gaussian sigma (A) of the Balmer lines of this white dwarf; both are adopted.
_BALMER_DEPTH, _BALMER_WIDTH = 0.45, 25.0
# Lower level of the Balmer series of hydrogen.
_LOWER_LEVEL = 2.0
NEBULA = Path(__file__).with_name("planetary_nebula.csv")
# Equivalent width (A) of H beta over the flat continuum of the nebula, adopted.
_HBETA_WIDTH = 500.0
# Gaussian sigma (A) of the lines of the nebula, adopted.
_NEBULA_SIGMA = 1.0


def spectra(vega_wavelength: Float, vega_flux: Float) -> Float:
    """Return the normalised spectra of the sources in `NAMES`: Vega, a white dwarf and a planetary nebula.

    Parameters
    ----------
    vega_wavelength : float array, shape (m,)
        Wavelengths of Vega's spectrum in A.
    vega_flux : float array, shape (m,)
        Vega's f_lambda in any unit.

    Returns
    -------
    float array, shape (3, 23401)
        f_lambda at 600 to 24000 A in steps of 1 A, with mean 1 between 5450 and 5550 A.
    """
    grid = passbands.grid()
    vega = np.interp(grid, vega_wavelength, vega_flux, left=0.0)
    balmer = stellar.feature_profile("series", grid, _LOWER_LEVEL, _BALMER_WIDTH)
    white_dwarf = stellar.planck(grid, _WHITE_DWARF_TEFF) * (1.0 - _BALMER_DEPTH * balmer)
    return stellar.normalise(grid, np.stack([vega, white_dwarf, _nebula(grid)]))


def _nebula(grid: Float) -> Float:
    """Return f_lambda of the planetary nebula: emission lines, averaged over bins of 1 A, on a flat continuum of 1."""
    from scipy.special import erf

    edges = np.append(grid, grid[-1] + 1.0) - 0.5
    flux = np.ones_like(grid)
    with NEBULA.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            centre, strength = float(row["wavelength"]), float(row["flux"]) / 100.0 * _HBETA_WIDTH
            flux += 0.5 * strength * np.diff(erf((edges - centre) / (np.sqrt(2.0) * _NEBULA_SIGMA)))
    return flux
