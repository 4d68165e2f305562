"""The PSF of a ground telescope: the atmosphere's, with the pixel."""

from __future__ import annotations

import galsim

from jobs.render.psf import model
from jobs.render.psf.model import Psf


def ground_psf(seeing: float, beta: float, pixel_scale: float) -> Psf:
    """A round Moffat profile.

    seeing : FWHM, arcsec;  beta : exponent, > 1;  pixel_scale : arcsec
    """
    # galsim ends it where 1e-5 of the light is left; of bright stars that is seen.
    far = galsim.GSParams(xvalue_accuracy=1e-12)
    return model.tabulated(galsim.Moffat(beta=beta, fwhm=seeing, gsparams=far), pixel_scale)
