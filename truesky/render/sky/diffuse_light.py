"""Diffuse light of the sky in electrons per second and pixel: zodiacal light, scattered starlight, thermal light."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from lake_schema.arrays import Float
from lake_schema.errors import BadInput, OutOfRange
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.sky import galactic
from lake_schema.sky.ecliptic import ecliptic
from lake_schema.units import LIGHT_ANGSTROM_S, PLANCK_ERG_S
from truesky.fluxes import passbands
from truesky.fluxes.passbands import Passband
from truesky.numerics import matrices
from truesky.render.camera.detectors import Detector
from truesky.render.sky import thermal

_MJD_J2000 = 51544.5
# Mean longitude and mean anomaly (value at J2000 and rate per day) and equation of the centre, deg: The Astronomical
# Almanac, low-precision formula for the Sun (0.01 deg, 1950-2050). The general precession per day converts from the
# equinox of date to J2000.
_SUN_LONGITUDE = (280.460, 0.9856474)
_SUN_ANOMALY = (357.528, 0.9856003)
_SUN_CENTRE = (1.915, 0.020)
_PRECESSION = 1.39697 / 36525.0
# Unit of the table of Leinert et al. 1998.
_TABLE_UNIT = 1e-8
# Band of the scattered light in the mission database.
_VIS = "euclid_vis"
_ARCSEC = np.pi / 180.0 / 3600.0


@dataclass(frozen=True, slots=True)
class SkyBand:
    """Terms of a band's sky that depend neither on position nor on date, in electrons per second and pixel.

    Attributes
    ----------
    constant : float
        Thermal light, or the sky of a ground camera.
    zodi : float
        Light with the Sun's spectrum, for a unit of intensity (W m-2 sr-1 um-1) at 500 nm.
    red, blue : float
        The same, with the spectrum multiplied by the decades of wavelength from 500 nm, above and below 500 nm.
    stars : float
        Scattered light of the stars at a Galactic latitude of 60 deg.
    """

    constant: float
    zodi: float = 0.0
    red: float = 0.0
    blue: float = 0.0
    stars: float = 0.0


def starlit_sky(detector: Detector, band: str, mission: MissionConfiguration, curve: Passband | None = None) -> SkyBand:
    """Zodiacal light, and starlight that the telescope scatters.

    Parameters
    ----------
    detector : Detector
        Detector of the camera.
    band : str
        Name of the band.
    mission : MissionConfiguration
        Mission database.
    curve : Passband, optional
        The passband; by default the embedded one.

    Returns
    -------
    SkyBand
        Terms of the sky.
    """
    rate = mission.value(f"{detector.section}.scattered_light", "electron / (s pix)")
    # The scattered light in a band is proportional to its width, for flat f_nu.
    part = passbands.log_width(curve) / passbands.log_width(passbands.load(_VIS)) if curve else 1.0
    return SkyBand(0.0, *_zodiacal_terms(detector, band, mission, curve), rate * part)


def thermal_sky(detector: Detector, band: str, mission: MissionConfiguration, curve: Passband | None = None) -> SkyBand:
    """Zodiacal light, thermal light of telescope and instrument, and starlight that they scatter.

    Parameters
    ----------
    detector : Detector
        Detector of the camera.
    band : str
        Name of the band.
    mission : MissionConfiguration
        Mission database.
    curve : Passband, optional
        The passband; by default the embedded one.

    Returns
    -------
    SkyBand
        Terms of the sky.
    """
    section, key = detector.section, f"{detector.section}.{band}.scattered_light"
    warm = thermal.rate(section, band, curve or passbands.load(band), mission)
    scattered = mission.value(key, "electron / (s pix)") if key in mission else 0.0
    return SkyBand(warm, *_zodiacal_terms(detector, band, mission, curve), scattered)


def ground_sky(detector: Detector, band: str, mission: MissionConfiguration, curve: Passband | None = None) -> SkyBand:
    """Dark-sky rate of a band from the mission database, or from its surface brightness and zero point.

    Parameters
    ----------
    detector : Detector
        Detector of the camera.
    band : str
        Name of the band.
    mission : MissionConfiguration
        Mission database.
    curve : Passband, optional
        Not used, since the sky of a band is a published value.

    Returns
    -------
    SkyBand
        A constant sky.
    """
    section = detector.section
    if f"{section}.{band}.sky" in mission:
        return SkyBand(mission.value(f"{section}.{band}.sky", "electron / (s pix)"))
    zero_point = mission.value(f"{section}.{band}.zero_point", "mag")
    contrast = zero_point - mission.value(f"{section}.{band}.sky_brightness", "mag / arcsec2")
    return SkyBand(float(10.0 ** (0.4 * contrast) * detector.pixel_scale**2))


def sky_rate(sky_band: SkyBand, ra: float, dec: float, mjd: float, mission: MissionConfiguration) -> float:
    """Electrons per second and pixel of a band's sky, at a position and date.

    Parameters
    ----------
    sky_band : SkyBand
        Terms of the sky.
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
    """
    scattered = sky_band.stars * starlight(ra, dec, mission) if sky_band.stars else 0.0
    return sky_band.constant + scattered + (_zodiacal_rate(sky_band, ra, dec, mjd, mission) if sky_band.zodi else 0.0)


def photons(section: str, rate: float, band: Passband, mission: MissionConfiguration) -> Float:
    """Spectrum of the sky: electrons per second and pixel at the wavelengths of a band, which are 1 Angstrom apart.

    Parameters
    ----------
    section : str
        Prefix of the camera in the mission database.
    rate : float
        Total rate of the sky, electrons per second and pixel.
    band : Passband
        The passband.
    mission : MissionConfiguration
        Mission database, with the temperatures of the camera.

    Returns
    -------
    float array, shape (n,)
        Electrons per second and pixel. Light that is not thermal has the spectrum of zodiacal light 90 deg from the
        Sun.
    """
    warm_light = thermal_photons(section, band, mission)
    red, blue = _reddening_slopes(90.0, mission)
    decades = np.log10(band.wavelength / (10.0 * mission.value("env.zodi.reference_wavelength", "nm")))
    reddened = 1.0 + red * np.maximum(decades, 0.0) + blue * np.minimum(decades, 0.0)
    sun = solar_irradiance(band.wavelength / 10.0, mission) * band.response * band.wavelength * reddened
    return np.asarray(warm_light + max(rate - float(warm_light.sum()), 0.0) * sun / sun.sum())


def thermal_photons(section: str, band: Passband, mission: MissionConfiguration) -> Float:
    """Thermal part of the spectrum of the sky.

    Parameters
    ----------
    section : str
        Prefix of the camera in the mission database.
    band : Passband
        The passband.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    float array, shape (n,)
        Electrons per second and pixel; 0 if the mission database has no thermal light in the band.
    """
    if f"{section}.{band.name}.thermal" not in mission:
        return np.zeros(len(band.wavelength))
    return thermal.photons(section, band.name, band, mission)


def starlight(ra: float, dec: float, mission: MissionConfiguration) -> float:
    """Light of a field's stars, relative to the mean at a Galactic latitude of 60 deg.

    Parameters
    ----------
    ra, dec : float
        Position, deg.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    float
        Ratio, from bilinear interpolation of the logarithm.

    Notes
    -----
    Dust is neglected. Within 10 deg of the Galactic plane the light is too bright, by several times in the plane
    itself.
    """
    longitude, latitude = (float(angle) for angle in galactic(ra, dec))
    longitudes, latitudes, logarithms = _starlight_table(mission.numbers("env.straylight.map"))
    along = [np.interp(abs(latitude), latitudes, line) for line in logarithms]
    return float(np.exp(np.interp(min(longitude, 360.0 - longitude), longitudes, along)))


@lru_cache(maxsize=8)
def _starlight_table(rows: tuple[tuple[float, ...], ...]) -> tuple[Float, Float, Float]:
    """Longitudes [l] (0 to 180 deg), latitudes [b] (deg) and logarithms of the light [l, b]."""
    table = np.array(sorted(rows))
    longitudes, latitudes = np.unique(table[:, 0]), np.unique(table[:, 1])
    return longitudes, latitudes, np.log(table[:, 2]).reshape(len(longitudes), len(latitudes))


def sun_longitude(mjd: float) -> float:
    """Ecliptic longitude of the Sun from the Earth, deg, mean equinox J2000, to 0.02 deg between 1950 and 2050."""
    days = mjd - _MJD_J2000
    longitude = _SUN_LONGITUDE[0] + (_SUN_LONGITUDE[1] - _PRECESSION) * days
    anomaly = np.radians(_SUN_ANOMALY[0] + _SUN_ANOMALY[1] * days)
    return float((longitude + _SUN_CENTRE[0] * np.sin(anomaly) + _SUN_CENTRE[1] * np.sin(2 * anomaly)) % 360.0)


def zodiacal_intensity(from_sun: float, latitude: float, mission: MissionConfiguration) -> float:
    """Zodiacal light at 500 nm from the Earth.

    Parameters
    ----------
    from_sun : float
        Ecliptic longitude minus that of the Sun, deg.
    latitude : float
        Ecliptic latitude, deg.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    float
        Intensity, W m-2 sr-1 um-1, to 10 %. Within 15 deg of the Sun, where the table is empty, its nearest value is
        used.

    Raises
    ------
    OutOfRange
        If the latitude is not between -90 and 90 deg.

    References
    ----------
    Leinert et al. 1998, Table 17, bilinear in the logarithm.
    """
    if not abs(latitude) <= 90.0:
        raise OutOfRange("ecliptic latitude", latitude, -90.0, 90.0)
    distance, beta = abs((from_sun + 180.0) % 360.0 - 180.0), abs(latitude)
    longitudes, values = _zodiacal_table(mission)
    i = int(np.clip(np.searchsorted(longitudes, distance, "right") - 1, 0, len(longitudes) - 2))
    j = int(np.clip(np.searchsorted(_LATITUDES, beta, "right") - 1, 0, len(_LATITUDES) - 2))
    s = (distance - longitudes[i]) / (longitudes[i + 1] - longitudes[i])
    t = (beta - _LATITUDES[j]) / (_LATITUDES[j + 1] - _LATITUDES[j])
    corner = np.log(values[i : i + 2, j : j + 2])
    mean = matrices.matmul(matrices.matmul(np.array([1 - s, s]), corner), np.array([1 - t, t]))
    return float(np.exp(mean)) * _TABLE_UNIT


# Ecliptic latitudes of the table's columns, deg.
_LATITUDES = np.array([0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 45.0, 60.0, 75.0, 90.0])


def _zodiacal_table(mission: MissionConfiguration) -> tuple[Float, Float]:
    """Longitudes from the Sun [19], deg, and values [19, 11]; empty entries have the next value away from the Sun."""
    return _fill_table(mission.numbers("env.zodi.map"))


@lru_cache(maxsize=8)
def _fill_table(rows: tuple[tuple[float, ...], ...]) -> tuple[Float, Float]:
    table = np.array(rows)
    values = table[:, 1:]
    for row in range(len(values) - 2, -1, -1):
        empty = np.isnan(values[row])
        values[row, empty] = values[row + 1, empty]
    return table[:, 0], values


def zodiacal_sky(band: Passband, area: float, pixel_scale: float, mission: MissionConfiguration) -> SkyBand:
    """Zodiacal light through a passband, without other light.

    Parameters
    ----------
    band : Passband
        The passband.
    area : float
        Collecting area, m^2.
    pixel_scale : float
        Arcsec per pixel.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    SkyBand
        Terms of the sky. The spectrum is that of the Sun, reddened depending on wavelength and elongation.

    References
    ----------
    Leinert et al. 1998, section 8.
    """
    return SkyBand(0.0, *_zodiacal_integrals(band, area, pixel_scale, mission))


def _zodiacal_rate(sky_band: SkyBand, ra: float, dec: float, mjd: float, mission: MissionConfiguration) -> float:
    longitude, latitude = (float(angle) for angle in ecliptic(ra, dec))
    from_sun = longitude - sun_longitude(mjd)
    cosine = np.cos(np.radians(latitude)) * np.cos(np.radians(from_sun))
    elongation = float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))
    red, blue = _reddening_slopes(elongation, mission)
    return zodiacal_intensity(from_sun, latitude, mission) * (sky_band.zodi + red * sky_band.red + blue * sky_band.blue)


def _zodiacal_terms(
    detector: Detector, band: str, mission: MissionConfiguration, curve: Passband | None
) -> tuple[float, float, float]:
    area = mission.value("plm.collecting_area", "m2")
    return _zodiacal_integrals(curve or passbands.load(band), area, detector.pixel_scale, mission)


def _zodiacal_integrals(
    band: Passband, area: float, pixel_scale: float, mission: MissionConfiguration
) -> tuple[float, float, float]:
    wavelength = band.wavelength / 10.0
    reference = mission.value("env.zodi.reference_wavelength", "nm")
    spectrum = solar_irradiance(wavelength, mission) / solar_irradiance(np.array([reference]), mission)
    energy = PLANCK_ERG_S * 1e-7 * LIGHT_ANGSTROM_S / band.wavelength
    # The spectrum is in W m-2 sr-1 um-1, in steps of 1 A = 1e-4 um.
    photons = spectrum * band.response / energy * (1e-4 * area * (pixel_scale * _ARCSEC) ** 2)
    decades = np.log10(wavelength / reference)
    weights = (np.ones_like(decades), np.maximum(decades, 0.0), np.minimum(decades, 0.0))
    zodi, red, blue = (float(np.trapezoid(photons * weight, band.wavelength)) for weight in weights)
    return zodi, red, blue


def solar_irradiance(wavelength: Float, mission: MissionConfiguration) -> Float:
    """Solar spectral irradiance at wavelengths in nm, W m-2 nm-1, averaged over 25 nm.

    Raises
    ------
    BadInput
        If the wavelengths exceed the range of the spectrum.

    References
    ----------
    Gueymard 2004.
    """
    table = np.array(mission.numbers("env.sun.spectrum"))
    if wavelength.min() < table[0, 0] or wavelength.max() > table[-1, 0]:
        band = f"the band extends from {wavelength.min():g} to {wavelength.max():g} nm"
        raise BadInput(f"the solar spectrum covers {table[0, 0]:g}-{table[-1, 0]:g} nm, but {band}")
    return np.asarray(np.interp(wavelength, table[:, 0], table[:, 1]))


def _reddening_slopes(elongation: float, mission: MissionConfiguration) -> tuple[float, float]:
    """Slopes k of f_co = 1 + k log10(lambda / 500 nm) of Leinert et al. 1998, above and below 500 nm."""
    ends = [mission.value(f"env.zodi.elongation_{end}", "deg") for end in ("near", "far")]
    red, blue = (
        float(np.interp(elongation, ends, [mission.value(f"env.zodi.colour_{side}_{end}") for end in ("near", "far")]))
        for side in ("red", "blue")
    )
    return red, blue
