"""Night sky of a ground site (airglow, zodiacal light and moonlight), and extinction of sources.

If the level of a band in the mission database is the mean of a survey (`sky_model` 0), it is used unchanged. Otherwise
it is the level of a dark zenith, and depends on airmass, date and Moon.
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
from truesky.render.camera.detectors import Detector
from truesky.render.sky import diffuse_light, observatory
from truesky.render.sky.diffuse_light import SkyBand
from truesky.render.sky.observatory import Site

# Ecliptic latitude with the least zodiacal light, deg; smallest fraction of a dark sky that is airglow.
_POLE, _MIN_AIRGLOW = 90.0, 0.2
# V band: nanolamberts are B = 34.08 exp(20.7233 - 0.92104 V); and its wavelength, Angstrom.
_NANOLAMBERTS, _V_ZERO, _V = 34.08, 20.7233, 5510.0
# Smallest distance of the Moon at which the model is evaluated, deg. Smaller distances use this value.
_NEAREST_MOON = 5.0


@dataclass(frozen=True, slots=True)
class Night:
    """Properties of the night sky that are the same for all exposures of a ground camera in a band.

    Attributes
    ----------
    level : float
        Level in the mission database, electrons per second and pixel.
    modelled : bool
        True if the level is that of a dark zenith.
    zodiacal : float
        Part of the level that is zodiacal light at the ecliptic pole.
    moon : float
        Electrons per second and pixel for one nanolambert of moonlight in V.
    sky : SkyBand
        Zodiacal light for the passband and the collecting area.
    scale : float
        Electrons of the camera, divided by those expected from passband and area.
    extinction : float
        Extinction, mag per airmass.
    reference_airmass : float
        Airmass of the zero point.
    site : Site
        The observatory.
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

    @classmethod
    def from_detector(
        cls, detector: Detector, band: str, photometry: tuple[float, float], mission: MissionConfiguration,
        curve: Passband | None,
    ) -> Night:  # fmt: skip
        """Read the properties for a detector's camera.

        Parameters
        ----------
        detector : Detector
            Detector of the camera.
        band : str
            Name of the passband.
        photometry : (float, float)
            AB magnitude of 1 electron per second, and level of the sky in the mission database, electrons per second
            and pixel.
        mission : MissionConfiguration
            Mission database.
        curve : Passband or None
            The passband; None for the embedded one.

        Returns
        -------
        Night
            The properties.
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
        )  # fmt: skip


def sky_rate(night: Night, ra: float, dec: float, mjd: float, mission: MissionConfiguration) -> float:
    """Electrons per second and pixel of the night sky.

    Parameters
    ----------
    night : Night
        Properties of the band.
    ra, dec : float
        Position, deg.
    mjd : float
        Date.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    float
        Electrons per second and pixel.

    Notes
    -----
    The error is 10 % of the dark sky, whose airglow changes by half with the Sun's activity. It is 20 % of moonlight,
    which is too bright by a half if the air absorbs light (y band).

    References
    ----------
    Krisciunas & Schaefer 1991, PASP 103, 1033; zodiacal light, Leinert et al. 1998.
    """
    if not night.modelled:
        return night.level
    airmass, _ = observatory.airmass_and_zenith(ra, dec, mjd, night.site)
    dimmed = 10.0 ** (-0.4 * night.extinction * (airmass - 1.0))
    airglow = (night.level - night.zodiacal) * _path_length(float(np.arcsin(1.0 / airmass))) * dimmed
    zodiacal = night.scale * diffuse_light.sky_rate(night.sky, ra, dec, mjd, mission)
    return float(airglow + zodiacal * dimmed + night.moon * moonlight(night, ra, dec, mjd, airmass))


def extra_extinction(night: Night, airmass: float) -> float:
    """Additional extinction of a source, relative to the airmass of the zero point, mag."""
    return night.extinction * (airmass - night.reference_airmass)


def moonlight(night: Night, ra: float, dec: float, mjd: float, airmass: float) -> float:
    """Moonlight in a V band with the extinction of this band.

    Parameters
    ----------
    night : Night
        Properties of the band.
    ra, dec : float
        Position of the field, deg.
    mjd : float
        Date.
    airmass : float
        Airmass of the field.

    Returns
    -------
    float
        Nanolamberts; 0 if the Moon is below the horizon.

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
    """Path length through a layer high above the ground, relative to its thickness, at an altitude in radian.

    References
    ----------
    Krisciunas & Schaefer 1991, eq. 3.
    """
    return float((1.0 - 0.96 * np.cos(altitude) ** 2) ** -0.5)


def _sun_colour(band: Passband, mission: MissionConfiguration) -> float:
    """AB magnitude of sunlight in a band minus that at the wavelength of V."""
    photons = band.response / band.wavelength

    def f_nu(wavelength: Float) -> Float:
        return diffuse_light.solar_irradiance(wavelength / 10.0, mission) * wavelength**2

    mean = float((photons * f_nu(band.wavelength)).sum() / photons.sum())
    return float(-2.5 * np.log10(mean / f_nu(np.array([_V]))[0]))
