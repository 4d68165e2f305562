"""Load the spectrum of Vega, and compute its AB magnitudes, which convert Vega magnitudes to AB magnitudes."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lake_schema import units
from lake_schema.arrays import Float
from lake_schema.errors import BadInput
from truesky.fluxes import passbands
from truesky.fluxes.libraries.rest_grid import REST_LAST
from truesky.fluxes.passbands import Passband


def vega_magnitude(band: Passband) -> float:
    """Return the AB magnitude of Vega in a band, which converts Vega magnitudes: m_AB = m_Vega + result.

    It is 0.9001, 1.3753 and 1.8474 in 2MASS J, H and Ks. Passbands are photon responses; with energy responses, H would
    be 1.3718. Raises BadInput if Vega's spectrum (900 to 24500 A) does not cover the band.
    """
    return _magnitude(band, *vega())


def vega_magnitudes(bands: Sequence[Passband]) -> list[float | None]:
    """Return the AB magnitude of Vega in each band, or None if Vega's spectrum does not cover the band."""
    wavelength, flux = vega()
    return [
        _magnitude(band, wavelength, flux)
        if wavelength[0] <= band.wavelength[0] and band.wavelength[-1] <= wavelength[-1]
        else None
        for band in bands
    ]


def _magnitude(band: Passband, wavelength: Float, flux: Float) -> float:
    return float(units.mag_of_f_nu(units.ujy_of_cgs(passbands.ab_flux(band, wavelength, flux))))


# Exponent of Vega's f_lambda (Rayleigh-Jeans tail) beyond 22008 A, where the file of the CALSPEC spectrum ends.
_VEGA_SLOPE = -3.95


def vega() -> tuple[Float, Float]:
    """Return wavelengths (A) and f_lambda (erg s-1 cm-2 A-1) of Vega from 900 to 24500 A, two arrays of shape (n,).

    References
    ----------
    CALSPEC alpha_lyr_mod_001, as distributed with GalSim.
    """
    table = np.loadtxt(spectrum_file("vega.txt").read_text().splitlines())
    # Convert nm to A, and flux per nm to flux per A.
    wavelength, flux = table[:, 0] * 10.0, table[:, 1] / 10.0
    tail = np.arange(np.ceil(wavelength[-1]), REST_LAST + 1.0)[1:]
    return np.append(wavelength, tail), np.append(flux, flux[-1] * (tail / wavelength[-1]) ** _VEGA_SLOPE)


def spectrum_file(name: str) -> Path:
    """Return the path of a file with a spectrum in the package GalSim, which is not imported because that is slow.

    Raises BadInput if GalSim is not installed. It is not checked that the file exists.
    """
    spec = importlib.util.find_spec("galsim")
    if spec is None or not spec.submodule_search_locations:
        raise BadInput("package GalSim is not installed: its spectra of galaxies and Vega are required")
    return Path(spec.submodule_search_locations[0]) / "share" / "SEDs" / name
