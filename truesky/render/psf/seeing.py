"""The PSF of a ground telescope: a Gaussian, a Moffat profile, or turbulent air and optics.

of_exposure   that which the mission database chooses;  edges_of : what shines beyond it;  check : is there one?
ground_psf    a Moffat profile
"""

from __future__ import annotations

import galsim

from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.tables.exposures import ExposureRow
from truesky.fluxes.passbands import Passband
from truesky.render.camera.detectors import Detector
from truesky.render.psf import ground, model
from truesky.render.psf.model import Psf
from truesky.render.psf.spikes import Edges

# Values of <section>.psf.profile.
_GAUSSIAN, _MOFFAT = 0.0, 1.0


def exposure_psf(
    exposure: ExposureRow, detector: Detector, band: Passband, mission: MissionConfiguration, positions: int
) -> Psf:
    """The PSF of a detector of a ground camera, as wide as the exposure's seeing.

    exposure  : its row;  detector : of its camera;  band : passband;  mission : the mission database
    positions : where what changes across the detector is computed, one of euclid.DEGREES
    """
    section, scale = detector.section, detector.pixel_scale
    profile = mission.value(f"{section}.psf.profile")
    if profile == _GAUSSIAN:
        return model.from_profile(galsim.Gaussian(fwhm=exposure.seeing), scale)
    if profile == _MOFFAT:
        return moffat_psf(exposure.seeing, mission.value(f"{section}.psf.moffat_beta"), scale)
    return ground.atmospheric_psf(ground.exposure_air(exposure, detector, mission), detector, band, mission, positions)


def check(seeing: float, detector: Detector, band: Passband, mission: MissionConfiguration) -> None:
    """Refuse a seeing, arcsec, or a pupil that there is no PSF of.

    detector : of a ground camera;  band : passband;  mission : the mission database
    """
    if mission.value(f"{detector.section}.psf.profile") not in (_GAUSSIAN, _MOFFAT):
        ground.check(seeing, detector, band, mission)


def typical_edges(detector: Detector, band: Passband, mission: MissionConfiguration) -> Edges | None:
    """What shines beyond the planes, in the seeing that is usual; None of a profile without planes.

    detector : of a ground camera;  band : passband;  mission : the mission database
    """
    section = detector.section
    if mission.value(f"{section}.psf.profile") in (_GAUSSIAN, _MOFFAT):
        return None
    key = f"{section}.{band.name}.seeing"
    typical_seeing = mission.value(key, "arcsec") if key in mission else 1.0
    return ground.edges(ground.Air(typical_seeing), detector, band, mission)


def moffat_psf(seeing: float, beta: float, pixel_scale: float) -> Psf:
    """A round Moffat profile.

    seeing : FWHM, arcsec;  beta : exponent, > 1;  pixel_scale : arcsec
    """
    # galsim ends it where 1e-5 of the light is left; of bright stars that is seen.
    accuracy_settings = galsim.GSParams(xvalue_accuracy=1e-12)
    return model.from_profile(galsim.Moffat(beta=beta, fwhm=seeing, gsparams=accuracy_settings), pixel_scale)
