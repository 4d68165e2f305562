"""Compute factors that scale template spectra to the magnitudes in the catalogue."""

from __future__ import annotations

import numpy as np

from lake_schema import units
from lake_schema.arrays import Float
from lake_schema.errors import BadInput
from truesky.fluxes import passbands
from truesky.fluxes.libraries import vega
from truesky.fluxes.libraries.templates import Library
from truesky.fluxes.sources import Stars
from truesky.numerics import matrices

STAR_BAND = "twomass_h"
# f_nu of a normalised template is 1e-11. Single precision has no digits left 30 decades below.
_MIN_F_NU = 1e-41


def continuum_scale(mag_r01: Float, f_nu_observed: Float) -> Float:
    """Return the factor that scales the continuum of a galaxy to its magnitude.

    Parameters
    ----------
    mag_r01 : float array, shape (n,)
        Apparent AB magnitude in the reference band.
    f_nu_observed : float array, shape (n,)
        f_nu of the unscaled continuum in the reference band in erg s-1 cm-2 Hz-1.

    Returns
    -------
    float array, shape (n,)
        Factors.

    Raises
    ------
    BadInput
        If dust leaves no light in the reference band.

    References
    ----------
    Serrano et al. 2024, appendix B, eq. f_continuum.
    """
    if dark := int(np.sum(~(f_nu_observed > _MIN_F_NU))):
        raise BadInput(f"{dark} galaxies have no light in the reference band: mag_r01 cannot be met")
    return np.asarray(units.cgs_of_ujy(units.f_nu_of_mag(mag_r01)) / f_nu_observed)


def star_scale(stars: Stars, library: Library) -> Float:
    """Return the factor for each star's mixture of templates, from its H magnitude before extinction.

    Notes
    -----
    H in the catalogue is a Vega magnitude, 1.375 mag below AB. Serrano et al. 2024, appendix B, use the AB formula for
    it.
    """
    band = passbands.load(STAR_BAND)
    spectra = library.flux[:, band.first : band.first + len(band.wavelength)].astype(float)
    template = matrices.matmul(spectra, passbands.weights(band))
    mag_ab = stars.mag_h + vega.vega_magnitude(band)
    return np.asarray(units.cgs_of_ujy(units.f_nu_of_mag(mag_ab)) / (stars.frac * template[stars.sed]).sum(0))
