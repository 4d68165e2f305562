"""Diffuse light of the sky in a camera, in electrons per second and pixel.

It consists of zodiacal light, starlight that the telescope scatters, and thermal light; ground cameras have a published
sky level instead.
"""

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

# MJD of the epoch J2000.
_MJD_J2000 = 51544.5
# Mean longitude of the Sun at J2000 (deg) and its rate (deg per day), from the low-precision formula of The
# Astronomical Almanac, which is accurate to 0.01 deg from 1950 to 2050.
_SUN_LONGITUDE = (280.460, 0.9856474)
# Mean anomaly of the Sun at J2000 (deg) and its rate (deg per day).
_SUN_ANOMALY = (357.528, 0.9856003)
# Coefficients of the Sun's equation of the centre (deg), for the sine of the mean anomaly and of twice the anomaly.
_SUN_CENTRE = (1.915, 0.020)
# General precession in deg per day, which converts longitudes from the equinox of date to J2000.
_PRECESSION = 1.39697 / 36525.0
# Unit of the intensity of zodiacal light in the table of Leinert et al. 1998, W m-2 sr-1 um-1.
_TABLE_UNIT = 1e-8
# Name of the VIS passband, for which the mission database gives the starlight that the telescope scatters.
_VIS = "euclid_vis"
# One arcsec in radians.
_ARCSEC = np.pi / 180.0 / 3600.0


@dataclass(frozen=True, slots=True)
class SkyBand:
    """Coefficients from which the diffuse light of the sky in a band is computed at any position and date.

    All are in electrons per second and pixel.

    Attributes
    ----------
    constant : float
        Thermal light, or the whole sky of a ground camera.
    zodi : float
        Zodiacal light with exactly the Sun's spectrum, for an intensity of 1 W m-2 sr-1 um-1 at 500 nm.
    red, blue : float
        Zodiacal light as in `zodi`, but with the Sun's spectrum multiplied by log10(wavelength / 500 nm). `red` is the
        sum over wavelengths above 500 nm, and `blue` (negative) below. They describe the reddening of zodiacal light.
    stars : float
        Starlight that the telescope scatters, for the mean star density at a Galactic latitude of 60 deg.
    """

    constant: float
    zodi: float = 0.0
    red: float = 0.0
    blue: float = 0.0
    stars: float = 0.0


def starlit_sky(detector: Detector, band: str, mission: MissionConfiguration, curve: Passband | None = None) -> SkyBand:
    """Return the sky of a camera without thermal light (VIS): zodiacal light, and starlight scattered by the telescope.

    Parameters
    ----------
    detector : Detector
        Any detector of the camera.
    band : str
        Name of the band.
    mission : MissionConfiguration
        Mission database, with the scattered light, the zodiacal light and the collecting area.
    curve : Passband, optional
        Response of the band; None means the passband of truesky.

    Returns
    -------
    SkyBand
        Coefficients of the sky in electrons per second and pixel.
    """
    rate = mission.value(f"{detector.section}.scattered_light", "electron / (s pix)")
    # Scale the scattered light of the VIS band to another band by the width of the passbands, for light with flat f_nu.
    part = passbands.log_width(curve) / passbands.log_width(passbands.load(_VIS)) if curve else 1.0
    return SkyBand(0.0, *_zodiacal_terms(detector, band, mission, curve), rate * part)


def thermal_sky(detector: Detector, band: str, mission: MissionConfiguration, curve: Passband | None = None) -> SkyBand:
    """Return the sky of an infrared camera: zodiacal light, thermal light, and starlight that the telescope scatters.

    Parameters
    ----------
    detector : Detector
        Any detector of the camera.
    band : str
        Name of the band.
    mission : MissionConfiguration
        Mission database, with the temperatures, the scattered light, the zodiacal light and the collecting area.
    curve : Passband, optional
        Response of the band; None means the passband of truesky.

    Returns
    -------
    SkyBand
        Coefficients of the sky in electrons per second and pixel. A band without scattered light in the mission
        database has none.
    """
    section, key = detector.section, f"{detector.section}.{band}.scattered_light"
    warm = thermal.rate(section, band, curve or passbands.load(band), mission)
    scattered = mission.value(key, "electron / (s pix)") if key in mission else 0.0
    return SkyBand(warm, *_zodiacal_terms(detector, band, mission, curve), scattered)


def ground_sky(detector: Detector, band: str, mission: MissionConfiguration, curve: Passband | None = None) -> SkyBand:
    """Return the sky of a ground camera in a band: the published rate, or that from the published surface brightness.

    Parameters
    ----------
    detector : Detector
        Any detector of the camera.
    band : str
        Name of the band.
    mission : MissionConfiguration
        Mission database, with the rate of the sky, or else its surface brightness and the zero point.
    curve : Passband, optional
        Not used, because the sky of a band is a published value.

    Returns
    -------
    SkyBand
        Sky that depends neither on position nor on date, in electrons per second and pixel.
    """
    section = detector.section
    if f"{section}.{band}.sky" in mission:
        return SkyBand(mission.value(f"{section}.{band}.sky", "electron / (s pix)"))
    brightness = mission.value(f"{section}.{band}.sky_brightness", "mag / arcsec2")
    zero_point = mission.value(f"{section}.{band}.zero_point", "mag")
    return SkyBand(rate_of_brightness(brightness, detector, band, zero_point, mission))


def rate_of_brightness(
    brightness: float, detector: Detector, band: str, zero_point: float, mission: MissionConfiguration
) -> float:
    """Convert the surface brightness of the sky to a rate of electrons.

    Parameters
    ----------
    brightness : float
        AB mag per arcsec2.
    detector : Detector
        Any detector of the camera.
    band : str
        Name of the band.
    zero_point : float
        AB magnitude of a source with one electron per second. It is not used if the mission database has the surface
        brightness that belongs to a rate (`sky_reference`). Air dims sources, but not the sky in published values of
        its surface brightness, so that this conversion is more accurate.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    float
        Electrons per second and pixel.
    """
    return float(10.0 ** (-0.4 * brightness) * _rate_of_zero_brightness(detector, band, zero_point, mission))


def brightness_of_rate(
    rate: float, detector: Detector, band: str, zero_point: float, mission: MissionConfiguration
) -> float:
    """Convert a rate of electrons to the surface brightness of the sky; the inverse of `rate_of_brightness`.

    Parameters
    ----------
    rate : float
        Electrons per second and pixel, more than 0.
    detector : Detector
        Any detector of the camera.
    band : str
        Name of the band.
    zero_point : float
        AB magnitude of a source with one electron per second, if it is needed.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    float
        AB mag per arcsec2.
    """
    return float(-2.5 * np.log10(rate / _rate_of_zero_brightness(detector, band, zero_point, mission)))


def _rate_of_zero_brightness(detector: Detector, band: str, zero_point: float, mission: MissionConfiguration) -> float:
    """Return the rate, in electrons per second and pixel, of a sky of 0 mag per arcsec2."""
    key = f"{detector.section}.{band}"
    if f"{key}.sky" in mission and f"{key}.sky_reference" in mission:
        reference = mission.value(f"{key}.sky_reference", "mag / arcsec2")
        return float(mission.value(f"{key}.sky", "electron / (s pix)") * 10.0 ** (0.4 * reference))
    return float(10.0 ** (0.4 * zero_point) * detector.pixel_scale**2)


def sky_rate(sky_band: SkyBand, ra: float, dec: float, mjd: float, mission: MissionConfiguration) -> float:
    """Return the rate of the diffuse sky at a position and date.

    Parameters
    ----------
    sky_band : SkyBand
        Coefficients of the sky in a band.
    ra, dec : float
        ICRS position in degrees.
    mjd : float
        Date (MJD), on which the zodiacal light depends.
    mission : MissionConfiguration
        Mission database, with the tables of zodiacal light and of starlight.

    Returns
    -------
    float
        Electrons per second and pixel.
    """
    scattered = sky_band.stars * starlight(ra, dec, mission) if sky_band.stars else 0.0
    return sky_band.constant + scattered + (_zodiacal_rate(sky_band, ra, dec, mjd, mission) if sky_band.zodi else 0.0)


def photons(section: str, rate: float, band: Passband, mission: MissionConfiguration) -> Float:
    """Return the spectrum of the sky at the wavelengths of a band, which are 1 Angstrom apart.

    Parameters
    ----------
    section : str
        Beginning of the camera's parameter names in the mission database, such as "nisp".
    rate : float
        Total rate of the sky in the band, electrons per second and pixel.
    band : Passband
        Response of the band as a function of wavelength.
    mission : MissionConfiguration
        Mission database, with the temperatures of the camera.

    Returns
    -------
    float array, shape (n,)
        Electrons per second and pixel in each Angstrom. The thermal light is that of the mission database. The rest of
        `rate` has the spectrum of zodiacal light 90 deg from the Sun; it is 0 if `rate` is below the thermal light.
    """
    warm_light = thermal_photons(section, band, mission)
    red, blue = _reddening_slopes(90.0, mission)
    decades = np.log10(band.wavelength / (10.0 * mission.value("env.zodi.reference_wavelength", "nm")))
    reddened = 1.0 + red * np.maximum(decades, 0.0) + blue * np.minimum(decades, 0.0)
    sun = solar_irradiance(band.wavelength / 10.0, mission) * band.response * band.wavelength * reddened
    return np.asarray(warm_light + max(rate - float(warm_light.sum()), 0.0) * sun / sun.sum())


def thermal_photons(section: str, band: Passband, mission: MissionConfiguration) -> Float:
    """Return the spectrum of thermal light at the wavelengths of a band, which are 1 Angstrom apart.

    Parameters
    ----------
    section : str
        Beginning of the camera's parameter names in the mission database, such as "nisp".
    band : Passband
        Response of the band as a function of wavelength.
    mission : MissionConfiguration
        Mission database, with the temperatures of the camera.

    Returns
    -------
    float array, shape (n,)
        Electrons per second and pixel in each Angstrom; 0 if the mission database has no thermal light in the band.
    """
    if f"{section}.{band.name}.thermal" not in mission:
        return np.zeros(len(band.wavelength))
    return thermal.photons(section, band.name, band, mission)


def starlight(ra: float, dec: float, mission: MissionConfiguration) -> float:
    """Return the total light of the stars around a position, relative to the mean at a Galactic latitude of 60 deg.

    Parameters
    ----------
    ra, dec : float
        ICRS position in degrees.
    mission : MissionConfiguration
        Mission database, with a table of the light as a function of Galactic longitude and latitude.

    Returns
    -------
    float
        Ratio, from bilinear interpolation of the logarithm of the table. The table is symmetric about the Galactic
        plane and about the Galactic centre.

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
    """Convert rows (Galactic longitude, latitude, light of stars) to a grid.

    Returns n longitudes (0 to 180 deg), m latitudes (deg), and the natural logarithm of the light, shape (n, m).
    """
    table = np.array(sorted(rows))
    longitudes, latitudes = np.unique(table[:, 0]), np.unique(table[:, 1])
    return longitudes, latitudes, np.log(table[:, 2]).reshape(len(longitudes), len(latitudes))


def sun_longitude(mjd: float) -> float:
    """Return the ecliptic longitude of the Sun as seen from the Earth in degrees, 0 to 360 (mean equinox J2000).

    The error is 0.02 deg between 1950 and 2050.
    """
    return float(sun_longitudes(np.array(mjd)))


def sun_longitudes(mjd: Float) -> Float:
    """Return the longitude of `sun_longitude` for an array of dates (MJD) of any shape."""
    days = mjd - _MJD_J2000
    longitude = _SUN_LONGITUDE[0] + (_SUN_LONGITUDE[1] - _PRECESSION) * days
    anomaly = np.radians(_SUN_ANOMALY[0] + _SUN_ANOMALY[1] * days)
    return np.asarray((longitude + _SUN_CENTRE[0] * np.sin(anomaly) + _SUN_CENTRE[1] * np.sin(2 * anomaly)) % 360.0)


def zodiacal_intensity(from_sun: float, latitude: float, mission: MissionConfiguration) -> float:
    """Return the intensity of zodiacal light at 500 nm as seen from the Earth.

    Parameters
    ----------
    from_sun : float
        Ecliptic longitude of the position minus that of the Sun, deg.
    latitude : float
        Ecliptic latitude of the position, deg.
    mission : MissionConfiguration
        Mission database, with the table of zodiacal light.

    Returns
    -------
    float
        Intensity in W m-2 sr-1 um-1, with an error of 10 %. Within 15 deg of the Sun, where the table is empty, its
        next value away from the Sun is used.

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


# Ecliptic latitudes of the columns of the table of zodiacal light, deg.
_LATITUDES = np.array([0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 45.0, 60.0, 75.0, 90.0])


def _zodiacal_table(mission: MissionConfiguration) -> tuple[Float, Float]:
    """Return the table of zodiacal light: longitudes from the Sun in deg, shape (19,), and intensities, shape (19, 11).

    Intensities are in 1e-8 W m-2 sr-1 um-1, with one column per latitude in `_LATITUDES`. Entries that are empty in the
    mission database have the next value away from the Sun.
    """
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
    """Return the zodiacal light through a passband, without other light.

    Parameters
    ----------
    band : Passband
        Response of the band as a function of wavelength.
    area : float
        Collecting area, m^2.
    pixel_scale : float
        Arcsec per pixel.
    mission : MissionConfiguration
        Mission database, with the spectrum of the Sun.

    Returns
    -------
    SkyBand
        Coefficients of the sky in electrons per second and pixel. The spectrum is that of the Sun, reddened depending
        on wavelength and elongation.

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
    # Convert an intensity in W m-2 sr-1 um-1 to detected photons per second, pixel and Angstrom (1e-4 um).
    photons = spectrum * band.response / energy * (1e-4 * area * (pixel_scale * _ARCSEC) ** 2)
    decades = np.log10(wavelength / reference)
    weights = (np.ones_like(decades), np.maximum(decades, 0.0), np.minimum(decades, 0.0))
    zodi, red, blue = (float(np.trapezoid(photons * weight, band.wavelength)) for weight in weights)
    return zodi, red, blue


def solar_irradiance(wavelength: Float, mission: MissionConfiguration) -> Float:
    """Return the spectral irradiance of the Sun in W m-2 nm-1, averaged over 25 nm, at an array of wavelengths in nm.

    Raises
    ------
    BadInput
        If a wavelength is outside the spectrum in the mission database.

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
    """Return the slopes of the reddening of zodiacal light above and below 500 nm, at an angle from the Sun (deg).

    A slope k changes the solar spectrum by the factor 1 + k log10(wavelength / 500 nm) of Leinert et al. 1998.
    """
    ends = [mission.value(f"env.zodi.elongation_{end}", "deg") for end in ("near", "far")]
    red, blue = (
        float(np.interp(elongation, ends, [mission.value(f"env.zodi.colour_{side}_{end}") for end in ("near", "far")]))
        for side in ("red", "blue")
    )
    return red, blue
