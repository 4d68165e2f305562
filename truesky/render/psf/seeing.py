"""PSF of a ground telescope: a Gaussian, a Moffat profile, or turbulent air and optics."""

from __future__ import annotations

import galsim

from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.tables.exposures import ExposureRow
from truesky.fluxes.passbands import Passband
from truesky.render.camera.detectors import Detector
from truesky.render.psf import ground, model
from truesky.render.psf.model import Psf
from truesky.render.psf.spikes import Edges

# Values of the mission parameter <section>.psf.profile.
_GAUSSIAN, _MOFFAT = 0.0, 1.0


def exposure_psf(
    exposure: ExposureRow, detector: Detector, band: Passband, mission: MissionConfiguration, positions: int
) -> Psf:
    """PSF of a detector of a ground camera, with the seeing of the exposure.

    Parameters
    ----------
    exposure : ExposureRow
        Row of the table `exposures`.
    detector : Detector
        Detector of its camera.
    band : Passband
        The passband.
    mission : MissionConfiguration
        Mission database, which selects the profile.
    positions : int
        Number of positions at which the PSF is computed, one of `euclid.DEGREES`.

    Returns
    -------
    Psf
        The PSF.
    """
    section, scale = detector.section, detector.pixel_scale
    profile = mission.value(f"{section}.psf.profile")
    if profile == _GAUSSIAN:
        return model.from_profile(galsim.Gaussian(fwhm=exposure.seeing), scale)
    if profile == _MOFFAT:
        return moffat_psf(exposure.seeing, mission.value(f"{section}.psf.moffat_beta"), scale)
    return ground.atmospheric_psf(ground.exposure_air(exposure, detector, mission), detector, band, mission, positions)


def check(seeing: float, detector: Detector, band: Passband, mission: MissionConfiguration) -> None:
    """Refuse a seeing, or a pupil, for which there is no PSF.

    Parameters
    ----------
    seeing : float
        Seeing, arcsec.
    detector : Detector
        Detector of a ground camera.
    band : Passband
        The passband.
    mission : MissionConfiguration
        Mission database.
    """
    if mission.value(f"{detector.section}.psf.profile") not in (_GAUSSIAN, _MOFFAT):
        ground.check(seeing, detector, band, mission)


def typical_edges(detector: Detector, band: Passband, mission: MissionConfiguration) -> Edges | None:
    """Sources of light beyond the planes, for the typical seeing of the band.

    Parameters
    ----------
    detector : Detector
        Detector of a ground camera.
    band : Passband
        The passband.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    Edges or None
        Edges of the pupil, and the aureole; None for a profile without planes.
    """
    section = detector.section
    if mission.value(f"{section}.psf.profile") in (_GAUSSIAN, _MOFFAT):
        return None
    key = f"{section}.{band.name}.seeing"
    typical_seeing = mission.value(key, "arcsec") if key in mission else 1.0
    return ground.edges(ground.Air(typical_seeing), detector, band, mission)


def moffat_psf(seeing: float, beta: float, pixel_scale: float) -> Psf:
    """PSF with a round Moffat profile.

    Parameters
    ----------
    seeing : float
        FWHM, arcsec.
    beta : float
        Exponent, above 1.
    pixel_scale : float
        Arcsec per pixel.

    Returns
    -------
    Psf
        The PSF.
    """
    # By default galsim truncates the profile where 1e-5 of the light remains, which is visible for bright stars.
    accuracy_settings = galsim.GSParams(xvalue_accuracy=1e-12)
    return model.from_profile(galsim.Moffat(beta=beta, fwhm=seeing, gsparams=accuracy_settings), pixel_scale)
