"""The diffuse sky: electrons per second in a pixel.

starlit_sky, thermal_sky, ground_sky   of a band, as different cameras see it
sky_rate              of a band, at a position and date;  photons : by wavelength;  warm : the thermal ones of them
zodiacal_intensity    W m-2 sr-1 um-1 at 500 nm
zodiacal_sky          zodiacal light through a passband, for `sky_rate`
starlight             of a field's stars, of which the telescope scatters some
solar                 the Sun's spectrum
sun_longitude
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

_MJD_J2000 = 51544.5
# Mean longitude, mean anomaly (value at J2000, rate a day) and equation of the centre, deg: The Astronomical
# Almanac, low-precision formula for the Sun (0.01 deg, 1950-2050); general precession a day turns "of date"
# into J2000.
_SUN_LONGITUDE = (280.460, 0.9856474)
_SUN_ANOMALY = (357.528, 0.9856003)
_SUN_CENTRE = (1.915, 0.020)
_PRECESSION = 1.39697 / 36525.0
# Unit of the table of Leinert et al. 1998.
_TABLE_UNIT = 1e-8
# The band that the mission's scattered light is of.
_VIS = "euclid_vis"
_ARCSEC = np.pi / 180.0 / 3600.0


@dataclass(frozen=True, slots=True)
class SkyBand:
    """What of a band's sky depends neither on the place nor on the date.

    constant            : electrons per second in a pixel: thermal light, the ground's sky
    zodi, red, blue     : electrons per second in a pixel for a unit of intensity at 500 nm: of the Sun's spectrum,
                          and of it times the decades of wavelength on either side of 500 nm
    stars               : electrons per second in a pixel: scattered light of the stars of |b| = 60 deg
    """

    constant: float
    zodi: float = 0.0
    red: float = 0.0
    blue: float = 0.0
    stars: float = 0.0


def starlit_sky(detector: Detector, band: str, mission: MissionConfiguration, curve: Passband | None = None) -> SkyBand:
    """Zodiacal light, and starlight that the telescope scatters.

    detector, band : of the camera, and the band's name;  mission : the mission database
    curve          : the passband, None = the embedded one
    """
    rate = mission.value(f"{detector.section}.scattered_light", "electron / (s pix)")
    # Of the light that a telescope scatters a band has its part, which for flat f_nu goes with its width.
    part = passbands.log_width(curve) / passbands.log_width(passbands.load(_VIS)) if curve else 1.0
    return SkyBand(0.0, *_zodiacal_terms(detector, band, mission, curve), rate * part)


def thermal_sky(detector: Detector, band: str, mission: MissionConfiguration, curve: Passband | None = None) -> SkyBand:
    """Zodiacal light, thermal light of telescope and instrument, and what starlight they scatter.

    detector, band : of the camera, and the band's name;  mission : the mission database
    curve          : the passband, None = the embedded one
    """
    section, key = detector.section, f"{detector.section}.{band}.scattered_light"
    warm = thermal.rate(section, band, curve or passbands.load(band), mission)
    scattered = mission.value(key, "electron / (s pix)") if key in mission else 0.0
    return SkyBand(warm, *_zodiacal_terms(detector, band, mission, curve), scattered)


def ground_sky(detector: Detector, band: str, mission: MissionConfiguration, curve: Passband | None = None) -> SkyBand:
    """The band's dark-sky rate of the mission database, or what follows from its surface brightness and zero point.

    detector, band : of the camera, and the band's name;  mission : the mission database
    curve          : is not asked for: the sky of a band is as published
    """
    section = detector.section
    if f"{section}.{band}.sky" in mission:
        return SkyBand(mission.value(f"{section}.{band}.sky", "electron / (s pix)"))
    zero_point = mission.value(f"{section}.{band}.zero_point", "mag")
    contrast = zero_point - mission.value(f"{section}.{band}.sky_brightness", "mag / arcsec2")
    return SkyBand(float(10.0 ** (0.4 * contrast) * detector.pixel_scale**2))


def sky_rate(sky_band: SkyBand, ra: float, dec: float, mjd: float, mission: MissionConfiguration) -> float:
    """Electrons per second in a pixel of a band, at a place and date.

    own          : of a band;  mission : the mission database
    ra, dec, mjd : deg, and date
    """
    scattered = sky_band.stars * starlight(ra, dec, mission) if sky_band.stars else 0.0
    return sky_band.constant + scattered + (_zodiacal_rate(sky_band, ra, dec, mjd, mission) if sky_band.zodi else 0.0)


def photons(section: str, rate: float, band: Passband, mission: MissionConfiguration) -> Float:
    """float64[n] electrons a second in a pixel at the wavelengths of a band, which are 1 A apart.

    section : of the camera in the mission database, with its temperatures
    rate    : of all of the sky, e-/s;  band : passband;  mission : the mission database
    Error   : what is not thermal is taken as zodiacal light 90 deg from the Sun
    """
    warm_light = thermal_photons(section, band, mission)
    red, blue = _reddening_slopes(90.0, mission)
    decades = np.log10(band.wavelength / (10.0 * mission.value("env.zodi.reference_wavelength", "nm")))
    reddened = 1.0 + red * np.maximum(decades, 0.0) + blue * np.minimum(decades, 0.0)
    sun = solar_irradiance(band.wavelength / 10.0, mission) * band.response * band.wavelength * reddened
    return np.asarray(warm_light + max(rate - float(warm_light.sum()), 0.0) * sun / sun.sum())


def thermal_photons(section: str, band: Passband, mission: MissionConfiguration) -> Float:
    """float64[n] what of `photons` is thermal light: 0 where the mission has none in the band."""
    if f"{section}.{band.name}.thermal" not in mission:
        return np.zeros(len(band.wavelength))
    return thermal.photons(section, band.name, band, mission)


def starlight(ra: float, dec: float, mission: MissionConfiguration) -> float:
    """Light of a field's stars over its mean at a Galactic latitude of 60 deg, bilinear in the logarithm.

    Error : without dust: within 10 deg of the Galactic plane too bright, several times in the plane
    """
    longitude, latitude = (float(angle) for angle in galactic(ra, dec))
    longitudes, latitudes, logarithms = _starlight_table(mission.numbers("env.straylight.map"))
    along = [np.interp(abs(latitude), latitudes, line) for line in logarithms]
    return float(np.exp(np.interp(min(longitude, 360.0 - longitude), longitudes, along)))


@lru_cache(maxsize=8)
def _starlight_table(rows: tuple[tuple[float, ...], ...]) -> tuple[Float, Float, Float]:
    """Longitudes [l] folded at 180 deg, latitudes [b], deg, logarithms [l, b]."""
    table = np.array(sorted(rows))
    longitudes, latitudes = np.unique(table[:, 0]), np.unique(table[:, 1])
    return longitudes, latitudes, np.log(table[:, 2]).reshape(len(longitudes), len(latitudes))


def sun_longitude(mjd: float) -> float:
    """Ecliptic longitude of the Sun from the Earth, deg, mean equinox J2000.  Error: 0.02 deg, 1950-2050."""
    days = mjd - _MJD_J2000
    longitude = _SUN_LONGITUDE[0] + (_SUN_LONGITUDE[1] - _PRECESSION) * days
    anomaly = np.radians(_SUN_ANOMALY[0] + _SUN_ANOMALY[1] * days)
    return float((longitude + _SUN_CENTRE[0] * np.sin(anomaly) + _SUN_CENTRE[1] * np.sin(2 * anomaly)) % 360.0)


def zodiacal_intensity(from_sun: float, latitude: float, mission: MissionConfiguration) -> float:
    """Zodiacal light at 500 nm seen from the Earth, W m-2 sr-1 um-1.

    from_sun : deg, ecliptic longitude minus the Sun's;  latitude : deg, ecliptic
    Error    : 10 %; within 15 deg of the Sun, where the table is empty, its nearest value
    Ref      : Leinert et al. 1998, Table 17, bilinear in the logarithm
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


# Columns of the table.
_LATITUDES = np.array([0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0, 45.0, 60.0, 75.0, 90.0])


def _zodiacal_table(mission: MissionConfiguration) -> tuple[Float, Float]:
    """|longitude from the Sun| [19] deg, values [19, 11]; an empty entry takes the next away from the Sun."""
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
    """Zodiacal light alone.

    band : passband;  area : m2, collecting;  pixel_scale : arcsec;  mission : the mission database
    Spectrum : the Sun's, reddened with the wavelength and the elongation
    Ref      : Leinert et al. 1998, section 8
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
    # W m-2 sr-1 um-1 over steps of 1 A = 1e-4 um.
    photons = spectrum * band.response / energy * (1e-4 * area * (pixel_scale * _ARCSEC) ** 2)
    decades = np.log10(wavelength / reference)
    weights = (np.ones_like(decades), np.maximum(decades, 0.0), np.minimum(decades, 0.0))
    zodi, red, blue = (float(np.trapezoid(photons * weight, band.wavelength)) for weight in weights)
    return zodi, red, blue


def solar_irradiance(wavelength: Float, mission: MissionConfiguration) -> Float:
    """Solar spectral irradiance, W m-2 nm-1, 25 nm means; wavelength in nm.  Ref: Gueymard 2004."""
    table = np.array(mission.numbers("env.sun.spectrum"))
    if wavelength.min() < table[0, 0] or wavelength.max() > table[-1, 0]:
        raise BadInput(f"the solar spectrum covers {table[0, 0]:g}-{table[-1, 0]:g} nm, the band wants more")
    return np.asarray(np.interp(wavelength, table[:, 0], table[:, 1]))


def _reddening_slopes(elongation: float, mission: MissionConfiguration) -> tuple[float, float]:
    """Slopes k of f_co = 1 + k log10(lambda / 500 nm), Leinert et al. 1998: red of 500 nm, blue of it."""
    ends = [mission.value(f"env.zodi.elongation_{end}", "deg") for end in ("near", "far")]
    red, blue = (
        float(np.interp(elongation, ends, [mission.value(f"env.zodi.colour_{side}_{end}") for end in ("near", "far")]))
        for side in ("red", "blue")
    )
    return red, blue
