"""Night sky of a ground camera (airglow, zodiacal light, moonlight, twilight), and extinction of sources.

The mission database has one sky level per band. If it is the mean of a survey (parameter `sky_model` 0), it is used
unchanged. Otherwise it is the level at the zenith of a dark night, from which the sky at other airmasses, dates and
Moon phases, and in twilight, is computed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lake_schema import units
from lake_schema.arrays import Float
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.sky import separation
from lake_schema.sky.ecliptic import equatorial
from truesky.fluxes import passbands
from truesky.fluxes.passbands import Passband
from truesky.render.camera import pointing
from truesky.render.camera.detectors import Detector
from truesky.render.sky import diffuse_light, observatory, twilight
from truesky.render.sky.diffuse_light import SkyBand
from truesky.render.sky.observatory import Site

# The published sky level of a dark night is assumed to contain the zodiacal light at this ecliptic latitude, deg.
_POLE = 90.0
# Smallest fraction of the published sky level that is airglow. The zodiacal light in this level is reduced if it would
# leave less airglow.
_MIN_AIRGLOW = 0.2
# Factor in the conversion of a V surface brightness (mag per arcsec2) to nanolamberts, 34.08 exp(20.7233 - 0.92104 V).
_NANOLAMBERTS = 34.08
# Constant in the exponent of the conversion of a V surface brightness (mag per arcsec2) to nanolamberts, 34.08
# exp(20.7233 - 0.92104 V).
_V_ZERO = 20.7233
# Wavelength of the V band, angstrom.
_V = 5510.0
# Smallest distance from the Moon (deg) for which moonlight is computed; nearer fields have the light at this distance.
_NEAREST_MOON = 5.0
# Distance from the field centre (arcsec) at which the gradient of the sky is measured.
_GRADIENT_STEP = 1800.0


@dataclass(frozen=True, slots=True)
class Night:
    """Properties of the night sky that are the same for all exposures of a ground camera in a band.

    Attributes
    ----------
    level : float
        Brightness of the sky in the mission database, electrons per second and pixel.
    modelled : bool
        True if `level` is the sky at the zenith of a dark night, and the sky of an exposure is computed from it. False
        if `level` is used for all exposures.
    zodiacal : float
        Zodiacal light that is contained in `level` (that of the ecliptic pole), electrons per second and pixel.
    moon : float
        Electrons per second and pixel for one nanolambert of moonlight in the V band.
    sky : SkyBand
        Coefficients that give the zodiacal light at any position and date, from the passband and the collecting area.
    scale : float
        Electrons of a source according to the published zero point, divided by those expected from passband and
        collecting area. Zodiacal light from `sky` is multiplied by it.
    extinction : float
        Atmospheric extinction in the band, mag per airmass.
    reference_airmass : float
        Airmass for which the published zero point is valid.
    site : Site
        The observatory.
    curve : Passband
        Response of the band.
    """

    level: float
    modelled: bool
    zodiacal: float
    moon: float
    sky: SkyBand
    scale: float
    extinction: float
    reference_airmass: float
    site: Site
    curve: Passband

    @classmethod
    def from_detector(
        cls, detector: Detector, band: str, photometry: tuple[float, float], mission: MissionConfiguration,
        curve: Passband | None,
    ) -> Night:  # fmt: skip
        """Compute the properties of the night sky for the camera of a detector.

        Parameters
        ----------
        detector : Detector
            Any detector of the ground camera.
        band : str
            Name of the passband.
        photometry : (float, float)
            Zero point (AB magnitude of a source with 1 electron per second), and sky level in the mission database
            (electrons per second and pixel).
        mission : MissionConfiguration
            Mission database, with site, collecting area and extinction of the camera.
        curve : Passband or None
            Response of the band; None for the passband of truesky.

        Returns
        -------
        Night
            The properties. A band without extinction in the mission database has 0.
        """
        (zero_point, level), section, curve = photometry, detector.section, curve or passbands.load(band)
        area, pixel = mission.value(f"{section}.collecting_area", "m2"), detector.pixel_scale
        sky = diffuse_light.zodiacal_sky(curve, area, pixel, mission)
        scale = 10.0 ** (0.4 * (zero_point - units.zero_point(1e4 * area, passbands.log_width(curve))))
        ra, dec = (float(x) for x in equatorial(0.0, _POLE))
        pole = scale * diffuse_light.sky_rate(sky, ra, dec, 0.0, mission)
        moon = 10.0 ** (0.4 * (zero_point - _sun_colour(curve, mission))) * pixel**2 * np.exp(-_V_ZERO) / _NANOLAMBERTS
        key = f"{section}.{band}.extinction"
        extinction = mission.value(key, "mag") if key in mission else 0.0
        return cls(
            level, mission.value(f"{section}.sky_model") == 1.0, min(pole, (1.0 - _MIN_AIRGLOW) * level), float(moon),
            sky, scale, extinction, mission.value(f"{section}.zero_point_airmass"), Site.from_mission(section, mission),
            curve,
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Components:
    """Light of which the sky of a ground exposure consists, in electrons per second and pixel.

    `dark` is airglow and zodiacal light, or the mean sky of a survey. `moon` and `twilight` are scattered moonlight and
    sunlight.
    """

    dark: float
    moon: float = 0.0
    twilight: float = 0.0

    @property
    def total(self) -> float:
        """Sum of all light."""
        return self.dark + self.moon + self.twilight


def sky_rate(night: Night, ra: float, dec: float, mjd: float, mission: MissionConfiguration) -> float:
    """Return the rate of the night sky for a ground exposure.

    Parameters
    ----------
    night : Night
        Properties of camera and band.
    ra, dec : float
        ICRS position of the field in degrees.
    mjd : float
        Date (MJD).
    mission : MissionConfiguration
        Mission database, with the table of zodiacal light.

    Returns
    -------
    float
        Electrons per second and pixel: the sum of `sky_components`.
    """
    return sky_components(night, ra, dec, mjd, mission).total


def sky_components(night: Night, ra: float, dec: float, mjd: float, mission: MissionConfiguration) -> Components:
    """Return the light of which the night sky of a ground exposure consists.

    Parameters
    ----------
    night : Night
        Properties of camera and band.
    ra, dec : float
        ICRS position of the field in degrees.
    mjd : float
        Date (MJD).
    mission : MissionConfiguration
        Mission database, with the table of zodiacal light.

    Returns
    -------
    Components
        Airglow and zodiacal light, moonlight and twilight. Only the dark sky, `night.level`, unless `night.modelled`.

    Notes
    -----
    The dark sky has an error of 10 %; changes of the airglow with the activity of the Sun (by half) are neglected.
    Moonlight has an error of 20 %. In the y band, where the air absorbs light, it is 50 % too bright.

    References
    ----------
    Krisciunas & Schaefer 1991, PASP 103, 1033; zodiacal light, Leinert et al. 1998.
    """
    if not night.modelled:
        return Components(night.level)
    airmass, _ = observatory.airmass_and_zenith(ra, dec, mjd, night.site)
    dimmed = 10.0 ** (-0.4 * night.extinction * (airmass - 1.0))
    airglow = (night.level - night.zodiacal) * _path_length(float(np.arcsin(1.0 / airmass))) * dimmed
    zodiacal = night.scale * diffuse_light.sky_rate(night.sky, ra, dec, mjd, mission)
    moon = night.moon * moonlight(night, ra, dec, mjd, airmass)
    return Components(float(airglow + zodiacal * dimmed), float(moon), _twilight_rate(night, ra, dec, mjd))


def twilight_slopes(
    night: Night, place: tuple[float, float], position_angle: float, mjd: float, mission: MissionConfiguration
) -> tuple[float, float]:
    """Return the change of the sky over the field of view by the gradient of twilight.

    Parameters
    ----------
    night : Night
        Properties of camera and band.
    place : (float, float)
        ICRS right ascension and declination of the field centre in degrees.
    position_angle : float
        Position angle of the y axis of the focal plane in degrees.
    mjd : float
        Date (MJD).
    mission : MissionConfiguration
        Mission database, with the table of zodiacal light.

    Returns
    -------
    (float, float)
        Relative change of the whole sky per degree along the x and y axes of the focal plane; 0 without twilight.
    """
    if not night.modelled or _twilight_rate(night, *place, mjd) == 0.0:
        return 0.0, 0.0
    steps = _GRADIENT_STEP * np.array([(-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0)])
    ra, dec = pointing.sky_of_plane(steps[:, 0], steps[:, 1], *place, position_angle)
    rates = [_twilight_rate(night, float(lon), float(lat), mjd) for lon, lat in zip(ra, dec, strict=True)]
    scale = 2.0 * _GRADIENT_STEP / 3600.0 * sky_rate(night, *place, mjd, mission)
    return (rates[1] - rates[0]) / scale, (rates[3] - rates[2]) / scale


def _twilight_rate(night: Night, ra: float, dec: float, mjd: float) -> float:
    """Return the light of twilight in a direction in electrons per second and pixel."""
    sun_altitude, sun_azimuth = observatory.sun_direction(mjd, night.site)
    altitude, azimuth = observatory.altitude_and_azimuth(ra, dec, mjd, night.site)
    airmass = float(observatory.airmass(altitude))
    return night.level * twilight.ratio(night.curve, sun_altitude, azimuth - sun_azimuth, airmass)


def extra_extinction(night: Night, airmass: float) -> float:
    """Return by how many magnitudes a source at an airmass is fainter than at the airmass of the zero point.

    The result is negative at a lower airmass.
    """
    return night.extinction * (airmass - night.reference_airmass)


def moonlight(night: Night, ra: float, dec: float, mjd: float, airmass: float) -> float:
    """Return the surface brightness of moonlight scattered by the atmosphere.

    It is computed with the published formula for the V band, but with the extinction in the band of `night`.

    Parameters
    ----------
    night : Night
        Properties of camera and band.
    ra, dec : float
        ICRS position of the field in degrees.
    mjd : float
        Date (MJD).
    airmass : float
        Airmass of the field.

    Returns
    -------
    float
        Surface brightness in nanolamberts; 0 if the Moon is below the horizon.

    References
    ----------
    Krisciunas & Schaefer 1991, eqs. 3, 15, 17 to 21.
    """
    moon_ra, moon_dec, phase = (float(x) for x in observatory.moon_position(mjd))
    up = float(observatory.moon_altitude(mjd, night.site))
    if up <= 0.0:
        return 0.0
    away = max(float(separation(ra, dec, moon_ra, moon_dec)), _NEAREST_MOON)
    moon_brightness = 10.0 ** (-0.4 * (3.84 + 0.026 * abs(phase) + 4e-9 * phase**4))
    scattered = 10.0**5.36 * (1.06 + np.cos(np.radians(away)) ** 2) + 10.0 ** (6.15 - away / 40.0)
    transmission = 10.0 ** (-0.4 * night.extinction * _path_length(float(np.radians(up))))
    scattered_fraction = 1.0 - 10.0 ** (-0.4 * night.extinction * _path_length(float(np.arcsin(1.0 / airmass))))
    return float(moon_brightness * scattered * transmission * scattered_fraction)


def _path_length(altitude: float) -> float:
    """Return the path length of light through a thin layer high in the atmosphere, in units of the layer's thickness.

    `altitude` is the angle of the field above the horizon in radians.

    References
    ----------
    Krisciunas & Schaefer 1991, eq. 3.
    """
    return float((1.0 - 0.96 * np.cos(altitude) ** 2) ** -0.5)


def _sun_colour(band: Passband, mission: MissionConfiguration) -> float:
    """Return the colour of sunlight: its AB magnitude in a band minus its AB magnitude at the wavelength of V."""
    photons = band.response / band.wavelength

    def f_nu(wavelength: Float) -> Float:
        return diffuse_light.solar_irradiance(wavelength / 10.0, mission) * wavelength**2

    mean = float((photons * f_nu(band.wavelength)).sum() / photons.sum())
    return float(-2.5 * np.log10(mean / f_nu(np.array([_V]))[0]))
