"""Compute factors that scale template spectra to the magnitudes of galaxies and stars in the catalogues."""

from __future__ import annotations

from functools import lru_cache

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
# Smallest f_nu in a band that counts as light, erg s-1 cm-2 Hz-1. A normalised template has f_lambda near
# 1 erg s-1 cm-2 A-1, and f_nu of about 1e-11. Thirty decades below it, single precision has no digits left.
_MIN_F_NU = 1e-41


def continuum_scale(mag_r01: Float, f_nu_observed: Float) -> Float:
    """Return the factor that scales the continuum of each galaxy to its apparent magnitude.

    Parameters
    ----------
    mag_r01 : float array, shape (n,)
        Apparent AB magnitude in the reference band 0.1r (SDSS r, shifted to the blue by a factor 1.1).
    f_nu_observed : float array, shape (n,)
        f_nu of the unscaled, redshifted continuum in this band, in erg s-1 cm-2 Hz-1.

    Returns
    -------
    float array, shape (n,)
        Factors by which the unscaled continuum is multiplied.

    Raises
    ------
    BadInput
        If a galaxy has (almost) no light in the reference band, for example because of dust, or NaN.

    References
    ----------
    Serrano et al. 2024, appendix B, eq. f_continuum.
    """
    if dark := int(np.sum(~(f_nu_observed > _MIN_F_NU))):
        raise BadInput(f"{dark} galaxies have no light in the reference band: mag_r01 cannot be met")
    return np.asarray(units.cgs_of_ujy(units.f_nu_of_mag(mag_r01)) / f_nu_observed)


def star_scale(stars: Stars, library: Library) -> Float:
    """Return the factors that scale stars' mixtures of templates to their H magnitudes before extinction, float64[n].

    Notes
    -----
    H in the catalogue is a Vega magnitude, which is 1.375 mag below the AB magnitude. Serrano et al. 2024, appendix B,
    insert it in the formula for AB magnitudes.
    """
    template, vega_magnitude = _templates_in_h(library)
    mag_ab = stars.mag_h + vega_magnitude
    return np.asarray(units.cgs_of_ujy(units.f_nu_of_mag(mag_ab)) / (stars.frac * template[stars.sed]).sum(0))


@lru_cache(maxsize=4)
def _templates_in_h(library: Library) -> tuple[Float, float]:
    """Return f_nu in the H band of each template as it is stored, and the AB magnitude of Vega in H."""
    band = passbands.load(STAR_BAND)
    spectra = library.flux[:, band.first : band.first + len(band.wavelength)].astype(float)
    return matrices.matmul(spectra, passbands.weights(band)), vega.vega_magnitude(band)
