"""Convert quantities of visits of the Rubin Observatory's scheduler (OpSim): seeing and rotator angles.

References
----------
Package rubin_scheduler (Rubin Observatory): seeing_model, rotskypos and output schema; SMTN-002, SMTN-019
"""

from __future__ import annotations

import numpy as np

from lake_schema.errors import BadInput
from lake_schema.mission.configuration import MissionConfiguration

# Width of the images that telescope, optics and camera would give at the zenith without an atmosphere, arcsec: 0.25,
# 0.08 and 0.3 added in quadrature.
SYSTEM_WIDTH = float(np.sqrt(0.25**2 + 0.08**2 + 0.3**2))
# Effective FWHM = 1.16 sqrt(system^2 + 1.04 atmosphere^2), and power of airmass and of wavelength in both widths.
_EFFECTIVE, _AIR, _AIRMASS_POWER, _WAVELENGTH_POWER = 1.16, 1.04, 0.6, -0.3
# Effective width of the PSF of truesky relative to this formula, for the same atmosphere. It has an aureole and an
# outer scale, so that its effective area is larger by 3 % (poor seeing in u) to 16 % (y), and by 10 % on average.
WIDTH_RATIO = float(np.sqrt(1.10))
# Wavelength of the seeing at the zenith, angstrom.
_REFERENCE_WAVELENGTH = 5000.0
# Largest difference (deg) between two angles of a visit that describe the same rotation, and the part of it that grows
# near the zenith, where the parallactic angle depends on the exact position.
_TOLERANCE, _ZENITH_TOLERANCE, _SMALLEST_SINE = 1.0, 0.5, 0.02


def zenith_seeing(effective_fwhm: float, airmass: float, wavelength: float, width_ratio: float = 1.0) -> float:
    """Return the seeing at the zenith and 500 nm that belongs to the effective FWHM of a visit.

    Parameters
    ----------
    effective_fwhm : float
        FWHM in arcsec of the Gaussian with the same effective area as the PSF (`seeingFwhmEff`).
    airmass : float
        Airmass.
    wavelength : float
        Effective wavelength of the band, angstrom.
    width_ratio : float, optional
        Effective width of the PSF relative to the formula of OpSim; 1 gives `seeingFwhm500` of its tables.

    Returns
    -------
    float
        FWHM of the atmosphere in arcsec.

    Raises
    ------
    BadInput
        If the telescope alone has a larger effective FWHM.
    """
    scale = width_ratio * _EFFECTIVE * airmass**_AIRMASS_POWER
    at_zenith = effective_fwhm / scale
    if at_zenith <= SYSTEM_WIDTH:
        smallest = f"{SYSTEM_WIDTH * scale:.3f} arcsec"
        raise BadInput(f"seeingFwhmEff = {effective_fwhm:g} arcsec: telescope and camera alone have {smallest}")
    air = np.sqrt((at_zenith**2 - SYSTEM_WIDTH**2) / _AIR)
    return float(air * (wavelength / _REFERENCE_WAVELENGTH) ** -_WAVELENGTH_POWER)


def position_angle(
    angles: tuple[float | None, float | None], parallactic: float, altitude: float, section: str,
    mission: MissionConfiguration,
) -> float:  # fmt: skip
    """Return the position angle of the focal plane's y axis of a visit.

    Parameters
    ----------
    angles : (float or None, float or None)
        rotSkyPos: position angle of the y axis. rotTelPos: angle to which the rotator turns the camera. Both in
        degrees; at least one is a number.
    parallactic : float
        Position angle of the zenith at the field, deg.
    altitude : float
        Altitude of the field, deg.
    section : str
        Beginning of the camera's parameter names in the mission database.
    mission : MissionConfiguration
        Mission database, with limit and offset of the rotator.

    Returns
    -------
    float
        Angle in degrees from north through east, 0 to 360.

    Raises
    ------
    BadInput
        If the rotator cannot reach the angle, the camera has no rotator, or the two angles disagree.

    Notes
    -----
    In current tables rotSkyPos = parallactic - rotTelPos + offset, where the offset is -90 deg for LSSTCam. Tables
    before 2025 have rotSkyPos = rotTelPos - parallactic, the angle of the sky in the camera, which has the other sign.
    If both columns agree with this equation, rotTelPos is used.
    """
    rot_sky, rot_tel = angles
    key = f"{section}.rotator"
    if f"{key}.limit" not in mission:
        if rot_sky is None:
            raise BadInput(f"rotTelPos: {section.rpartition('.')[2]} has no rotator in the mission database")
        return rot_sky % 360.0
    if rot_tel is None:
        return (rot_sky or 0.0) % 360.0
    limit, turned = mission.value(f"{key}.limit", "deg"), _wrap(rot_tel)
    if abs(turned) > limit:
        raise BadInput(f"rotTelPos = {rot_tel:g} deg is outside the range of the rotator, -{limit:g} to {limit:g} deg")
    from_rotator = (parallactic - turned + mission.value(f"{key}.offset", "deg")) % 360.0
    if rot_sky is None:
        return from_rotator
    sine = max(float(np.cos(np.radians(altitude))), _SMALLEST_SINE)
    tolerance = _TOLERANCE + _ZENITH_TOLERANCE / sine
    if abs(_wrap(rot_sky - from_rotator)) <= tolerance:
        return rot_sky % 360.0
    if abs(_wrap(rot_sky - (turned - parallactic))) <= tolerance:
        return from_rotator
    raise BadInput(
        f"rotSkyPos = {rot_sky:g} and rotTelPos = {rot_tel:g} deg disagree: with a parallactic angle of "
        f"{_wrap(parallactic):.2f} deg, rotTelPos gives rotSkyPos = {from_rotator:.2f} deg"
    )


def _wrap(angle: float) -> float:
    """Return an angle in degrees between -180 and 180."""
    return (angle + 180.0) % 360.0 - 180.0
