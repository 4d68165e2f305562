"""Compute spectra of calibration sources: Vega, a white dwarf and a planetary nebula."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np

from lake_schema.arrays import Float
from truesky.fluxes import passbands
from truesky.fluxes.libraries import stellar

NAMES = ("Vega", "white dwarf DA", "planetary nebula")

# A hot DA such as GD 71 (Teff of Bohlin, Hubeny & Rauch 2020). Depth and width (A) of its Balmer lines are adopted.
_WHITE_DWARF_TEFF, _BALMER_DEPTH, _BALMER_WIDTH, _LOWER_LEVEL = 33_590.0, 0.45, 25.0, 2.0
NEBULA = Path(__file__).with_name("planetary_nebula.csv")
# Equivalent width of H beta in the nebula's flat continuum (A), and sigma of the lines (A); both are adopted.
_HBETA_WIDTH, _NEBULA_SIGMA = 500.0, 1.0


def spectra(vega_wavelength: Float, vega_flux: Float) -> Float:
    """Return the spectra of the sources in `NAMES`.

    Parameters
    ----------
    vega_wavelength : float array, shape (m,)
        Wavelengths of Vega's spectrum in A.
    vega_flux : float array, shape (m,)
        Vega's f_lambda.

    Returns
    -------
    float array, shape (3, 23401)
        f_lambda on passbands.grid() with mean 1 between 5450 and 5550 A.
    """
    grid = passbands.grid()
    vega = np.interp(grid, vega_wavelength, vega_flux, left=0.0)
    balmer = stellar.feature_profile("series", grid, _LOWER_LEVEL, _BALMER_WIDTH)
    white_dwarf = stellar.planck(grid, _WHITE_DWARF_TEFF) * (1.0 - _BALMER_DEPTH * balmer)
    return stellar.normalise(grid, np.stack([vega, white_dwarf, _nebula(grid)]))


def _nebula(grid: Float) -> Float:
    """Return lines in bins of 1 A on a flat continuum of 1."""
    from scipy.special import erf

    edges = np.append(grid, grid[-1] + 1.0) - 0.5
    flux = np.ones_like(grid)
    with NEBULA.open(newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            centre, strength = float(row["wavelength"]), float(row["flux"]) / 100.0 * _HBETA_WIDTH
            flux += 0.5 * strength * np.diff(erf((edges - centre) / (np.sqrt(2.0) * _NEBULA_SIGMA)))
    return flux
