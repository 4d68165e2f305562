"""What brings a template to the magnitude that the catalogue gives it.

continuum_scale   galaxies: apparent AB magnitude in the reference band
star_scale        stars: Vega magnitude in 2MASS H
"""

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
# f_nu of a normalised template is 1e-11; 30 decades below, single precision has run out of digits.
_MIN_F_NU = 1e-41


def continuum_scale(mag_r01: Float, f_nu_observed: Float) -> Float:
    """Factor for a continuum that gives f_nu_observed (erg s-1 cm-2 Hz-1) in the reference band.

    Errors: BadInput where dust has left nothing to scale
    Ref: Serrano et al. 2024, appendix B, eq. f_continuum
    """
    if dark := int(np.sum(~(f_nu_observed > _MIN_F_NU))):
        raise BadInput(f"{dark} galaxies have no light in the reference band: mag_r01 cannot be met")
    return np.asarray(units.cgs_of_ujy(units.f_nu_of_mag(mag_r01)) / f_nu_observed)


def star_scale(stars: Stars, library: Library) -> Float:
    """Factor for each star's mixture of templates, from its H magnitude before extinction.

    The catalogue's H is Vega, 1.375 mag below AB; Serrano et al. 2024, appendix B, read it by the AB formula.
    """
    band = passbands.load(STAR_BAND)
    spectra = library.flux[:, band.first : band.first + len(band.wavelength)].astype(float)
    template = matrices.matmul(spectra, passbands.weights(band))
    mag_ab = stars.mag_h + vega.vega_magnitude(band)
    return np.asarray(units.cgs_of_ujy(units.f_nu_of_mag(mag_ab)) / (stars.frac * template[stars.sed]).sum(0))
