"""The sky of a site at night: airglow, zodiacal light and moonlight, and what the air takes of a source's light.

Night        of a band of a ground camera
sky_rate     electrons a second in a pixel;  fainter : magnitudes that the air takes more than it did of the zero point
moonlight    nanolamberts in V

Where the mission database says that a band's level is a survey's own mean (`sky_model` 0), it is taken as it is; else
it is that of a dark zenith, and airmass, date and Moon change it.
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

# Where zodiacal light is least, deg; the airglow has at least this part of a dark sky.
_POLE, _MIN_AIRGLOW = 90.0, 0.2
# V: nanolamberts of B = 34.08 exp(20.7233 - 0.92104 V), and the wavelength, A.
_NANOLAMBERTS, _V_ZERO, _V = 34.08, 20.7233, 5510.0
# The Moon nearer than this is taken as there, deg.
_NEAREST_MOON = 5.0


@dataclass(frozen=True, slots=True)
class Night:
    """What all exposures of a ground camera in a band have in common.

    level      : electrons a second in a pixel, as the mission database has it
    modelled   : whether it is of a dark zenith
    zodiacal   : of it, at the ecliptic pole;  moon : of a nanolambert of moonlight in V
    sky, scale : zodiacal light of the passband and area, and the camera's electrons over theirs
    extinction : mag an airmass;  reference : airmass that the zero point is of
    site       : observatory
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
        """Of a detector's camera.

        band       : name of the passband;  curve : the passband, None = the embedded one
        photometry : AB magnitude of 1 e-/s, and the sky's level in the mission database, e-/s in a pixel
        mission    : the mission database
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
    """Electrons a second in a pixel.

    night : of the band;  ra, dec, mjd : deg, and date;  mission : the mission database
    Error : 10 % of the dark sky, whose airglow changes by half with the Sun's activity; 20 % of moonlight, which is too
            bright by a half where the air absorbs (y)
    Ref   : Krisciunas & Schaefer 1991, PASP 103, 1033; zodiacal light, Leinert et al. 1998
    """
    if not night.modelled:
        return night.level
    airmass, _ = observatory.airmass_and_zenith(ra, dec, mjd, night.site)
    dimmed = 10.0 ** (-0.4 * night.extinction * (airmass - 1.0))
    airglow = (night.level - night.zodiacal) * _path_length(float(np.arcsin(1.0 / airmass))) * dimmed
    zodiacal = night.scale * diffuse_light.sky_rate(night.sky, ra, dec, mjd, mission)
    return float(airglow + zodiacal * dimmed + night.moon * moonlight(night, ra, dec, mjd, airmass))


def extra_extinction(night: Night, airmass: float) -> float:
    """Magnitudes by which the air dims a source more than at the airmass that the zero point is of."""
    return night.extinction * (airmass - night.reference_airmass)


def moonlight(night: Night, ra: float, dec: float, mjd: float, airmass: float) -> float:
    """Nanolamberts of a V band in which the air takes as much as in this one: 0 while the Moon is down.

    night : of the band;  ra, dec, mjd : deg, and date;  airmass : of the field
    Ref   : Krisciunas & Schaefer 1991, eqs. 3, 15, 17 to 21
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
    """Through a layer high above the ground, in its height; altitude : radian.  Ref: Krisciunas & Schaefer, eq. 3."""
    return float((1.0 - 0.96 * np.cos(altitude) ** 2) ** -0.5)


def _sun_colour(band: Passband, mission: MissionConfiguration) -> float:
    """AB magnitude of sunlight in a band less that at V's wavelength."""
    photons = band.response / band.wavelength

    def f_nu(wavelength: Float) -> Float:
        return diffuse_light.solar_irradiance(wavelength / 10.0, mission) * wavelength**2

    mean = float((photons * f_nu(band.wavelength)).sum() / photons.sum())
    return float(-2.5 * np.log10(mean / f_nu(np.array([_V]))[0]))
