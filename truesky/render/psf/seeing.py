"""PSF of a ground telescope: a Gaussian, a Moffat profile, or turbulent air and optics."""

from __future__ import annotations

from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.tables.exposures import ExposureRow
from truesky.fluxes.passbands import Passband
from truesky.render.camera.detectors import Detector
from truesky.render.psf import ground, model
from truesky.render.psf.model import Psf
from truesky.render.psf.spikes import Edges

# Value of the mission parameter <section>.psf.profile that selects a Gaussian PSF. <section> is the prefix of the
# camera's parameters.
_GAUSSIAN = 0.0
# Value of the mission parameter <section>.psf.profile that selects a Moffat profile as PSF. <section> is the prefix of
# the camera's parameters. Values other than 0 (Gaussian) and 1 (Moffat) select turbulent air.
_MOFFAT = 1.0


def exposure_psf(
    exposure: ExposureRow, detector: Detector, band: Passband, mission: MissionConfiguration, positions: int
) -> Psf:
    """Return the PSF of a detector of a ground camera, with the seeing of the exposure.

    Parameters
    ----------
    exposure : ExposureRow
        Row of the table `exposures`, which contains the seeing (FWHM in arcsec) and the airmass.
    detector : Detector
        Detector of the camera of this exposure.
    band : Passband
        The passband.
    mission : MissionConfiguration
        Mission database (parameters of telescopes and cameras), which selects the kind of profile.
    positions : int
        Number that selects how the PSF changes across the detector: 1, 4, 9 or 25 (keys of `euclid.DEGREES`); 25
        is treated as 9. It is ignored for a Gaussian or Moffat profile, which is the same on the whole detector.

    Returns
    -------
    Psf
        The PSF. For turbulent air, OutOfRange is raised if the seeing is not allowed (`ground.check`).
    """
    import galsim

    section, scale = detector.section, detector.pixel_scale
    profile = mission.value(f"{section}.psf.profile")
    if profile == _GAUSSIAN:
        return model.from_profile(galsim.Gaussian(fwhm=image_fwhm(exposure, detector, band, mission)), scale)
    if profile == _MOFFAT:
        fwhm = image_fwhm(exposure, detector, band, mission)
        return moffat_psf(fwhm, mission.value(f"{section}.psf.moffat_beta"), scale)
    air = ground.exposure_air(exposure, detector, band, mission)
    return ground.atmospheric_psf(air, detector, band, mission, positions)


def image_fwhm(exposure: ExposureRow, detector: Detector, band: Passband, mission: MissionConfiguration) -> float:
    """Return the FWHM (arcsec) of stars in an exposure, without aberrations and pixels: air, telescope and camera.

    Parameters
    ----------
    exposure : ExposureRow
        Row of the table `exposures`, which contains the seeing at the zenith and at 500 nm, and the airmass.
    detector : Detector
        Detector of the camera of this exposure.
    band : Passband
        The passband.
    mission : MissionConfiguration
        Mission database (parameters of telescopes and cameras).

    Returns
    -------
    float
        FWHM, arcsec; widths are added in quadrature.
    """
    airmass = 1.0 if exposure.airmass is None else exposure.airmass
    return ground.air_in_band(exposure.seeing, airmass, detector.section, band, mission).fwhm


def check(seeing: float, airmass: float, detector: Detector, band: Passband, mission: MissionConfiguration) -> None:
    """Check that a PSF can be computed for a seeing and for the pupil of a ground camera.

    Parameters
    ----------
    seeing : float
        FWHM of the image of a star through the air at the zenith and at 500 nm, arcsec.
    airmass : float
        Airmass of the exposure.
    detector : Detector
        Detector of a ground camera.
    band : Passband
        The passband.
    mission : MissionConfiguration
        Mission database (parameters of telescopes and cameras).

    Raises
    ------
    OutOfRange
        If the profile is that of turbulent air, and the seeing or the area of the pupil is not allowed. Gaussian and
        Moffat profiles are not checked.
    """
    if mission.value(f"{detector.section}.psf.profile") not in (_GAUSSIAN, _MOFFAT):
        air = ground.air_in_band(seeing, airmass, detector.section, band, mission)
        ground.check(air.seeing, detector, band, mission)


def typical_edges(detector: Detector, band: Passband, mission: MissionConfiguration) -> Edges | None:
    """Return what causes light beyond the border of the PSF images, for the typical seeing at the zenith.

    Parameters
    ----------
    detector : Detector
        Detector of a ground camera.
    band : Passband
        The passband.
    mission : MissionConfiguration
        Mission database (parameters of telescopes and cameras).

    Returns
    -------
    Edges or None
        Edges of the pupil, and the aureole; None for a Gaussian or Moffat profile, which has no such light.
    """
    section = detector.section
    if mission.value(f"{section}.psf.profile") in (_GAUSSIAN, _MOFFAT):
        return None
    air = ground.air_in_band(mission.value(f"{section}.seeing", "arcsec"), 1.0, section, band, mission)
    return ground.edges(air, detector, band, mission)


def moffat_psf(seeing: float, beta: float, pixel_scale: float) -> Psf:
    """Return a PSF with a round Moffat profile: surface brightness proportional to (1 + (r / r_d)^2)^-beta at radius r.

    The scale radius r_d follows from the FWHM.

    Parameters
    ----------
    seeing : float
        FWHM without the pixel, arcsec.
    beta : float
        Exponent, above 1; galsim raises an error for an exponent that is too small.
    pixel_scale : float
        Arcsec per pixel.

    Returns
    -------
    Psf
        The PSF.
    """
    import galsim

    # By default galsim truncates the profile where 1e-5 of the light remains, which is visible for bright stars.
    accuracy_settings = galsim.GSParams(xvalue_accuracy=1e-12)
    return model.from_profile(galsim.Moffat(beta=beta, fwhm=seeing, gsparams=accuracy_settings), pixel_scale)
