"""The diffuse sky against published surface brightnesses and astropy's ecliptic."""

from dataclasses import replace

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import BarycentricMeanEcliptic, GeocentricMeanEcliptic, SkyCoord, get_sun
from astropy.time import Time
from astropy.utils import iers
from hypothesis import given
from hypothesis import strategies as st

from lake_schema import units
from lake_schema.errors import OutOfRange
from lake_schema.mission.configuration import resolve
from lake_schema.sky import ecliptic
from truesky.fluxes import passbands
from truesky.fluxes.passbands import Passband
from truesky.render.camera import detectors
from truesky.render.psf import sub_bands
from truesky.render.sky import diffuse_light

MISSION = resolve()
J2000 = "J2000"


@pytest.fixture(autouse=True)
def _offline():
    with iers.conf.set_temp("auto_download", False):
        yield


@given(st.floats(0, 360, exclude_max=True), st.floats(-90, 90))
def test_ecliptic_coordinates(ra, dec):
    theirs = SkyCoord(ra, dec, unit="deg").transform_to(BarycentricMeanEcliptic(equinox=J2000))
    longitude, latitude = ecliptic.ecliptic(ra, dec)
    ours = SkyCoord(longitude, latitude, unit="deg", frame=BarycentricMeanEcliptic(equinox=J2000))
    assert ours.separation(theirs).arcsec < 0.1


@given(st.floats(41500, 61500))
def test_the_sun(mjd):
    theirs = get_sun(Time(mjd, format="mjd")).transform_to(GeocentricMeanEcliptic(equinox=J2000)).lon.deg
    assert (diffuse_light.sun_longitude(mjd) - theirs + 180) % 360 - 180 == pytest.approx(0.0, abs=0.02)


def at(from_sun, latitude, mjd=60950.0):
    """ICRS position of an ecliptic latitude and a longitude from the Sun."""
    lon = diffuse_light.sun_longitude(mjd) + from_sun
    place = SkyCoord(lon * u.deg, latitude * u.deg, frame=BarycentricMeanEcliptic(equinox=J2000)).icrs
    return place.ra.deg, place.dec.deg, mjd


def zodiacal_rate(ra, dec, mjd, band, area, pixel_scale):
    """Electrons per second in a pixel of a camera that sees the zodiacal light alone."""
    return diffuse_light.sky_rate(diffuse_light.zodiacal_sky(band, area, pixel_scale, MISSION), ra, dec, mjd, MISSION)


@given(st.floats(-720, 720), st.floats(-90, 90))
def test_zodiacal_light_is_smooth_and_symmetric(from_sun, latitude):
    value = diffuse_light.zodiacal_intensity(from_sun, latitude, MISSION)
    # Faintest and brightest entries of the table.
    assert 71e-8 <= value <= 11501e-8
    for mirrored in ((-from_sun, latitude), (from_sun, -latitude), (from_sun + 360, latitude)):
        assert diffuse_light.zodiacal_intensity(*mirrored, MISSION) == pytest.approx(value, rel=1e-9, abs=0.0)


@pytest.mark.parametrize(
    ("from_sun", "latitude", "value"),
    [(90, 0, 259), (90, 90, 77), (135, 45, 90), (180, 0, 230), (60, 30, 183)],
)
def test_the_table_is_met_at_its_nodes(from_sun, latitude, value):
    assert diffuse_light.zodiacal_intensity(from_sun, latitude, MISSION) == pytest.approx(
        value * 1e-8, rel=1e-12, abs=0.0
    )


def test_a_latitude_beyond_the_pole_is_refused():
    with pytest.raises(OutOfRange, match="latitude"):
        diffuse_light.zodiacal_intensity(90.0, 91.0, MISSION)
    with pytest.raises(OutOfRange, match="latitude"):
        diffuse_light.zodiacal_intensity(90.0, float("nan"), MISSION)


@pytest.mark.parametrize(("latitude", "rate"), [(0, 0.503), (15, 0.374), (30, 0.255), (60, 0.167), (90, 0.149)])
def test_vis_zodiacal_rate_at_quadrature(latitude, rate):
    """e-/s in a VIS pixel: Leinert et al. 1998 through the throughput, to the model's 10 %."""
    found = zodiacal_rate(*at(90, latitude), passbands.load("euclid_vis"), 0.9926, 0.1)
    assert found == pytest.approx(rate, rel=0.10)


def test_vis_zodiacal_rate_through_the_design_s_curve():
    """0.219 e-/s, 0.86 of the current best estimate's: the curve of 2015 has less light."""
    table = np.array(resolve(ladder=("DES", "CBE", "BLT", "SIM", "REQ")).numbers("vis.euclid_vis.throughput"))
    wavelength = np.arange(10 * table[0, 0], 10 * table[-1, 0] + 1)
    band = Passband("design", wavelength, np.interp(wavelength, *(table.T * [[10.0], [1.0]])), "vacuum")
    assert units.zero_point(9926.0, passbands.log_width(band)) == pytest.approx(25.76, abs=0.02)
    found = zodiacal_rate(*at(90, 30), band, 0.9926, 0.1)
    assert found == pytest.approx(0.219, rel=0.10)


def test_vis_sky_brightness_in_magnitudes():
    """The designers' mean sky is 22.35 mag arcsec-2 (Leinert et al. 1998 with Aldering 2002)."""
    band = passbands.load("euclid_vis")
    rate = zodiacal_rate(*at(90, 30), band, 0.9926, 0.1)
    surface = 25.93 - 2.5 * np.log10(rate / 0.01)
    assert surface == pytest.approx(22.35, abs=0.15)


def test_rates_scale_with_area_and_pixel():
    band, place = passbands.load("euclid_vis"), at(90, 30)
    one = zodiacal_rate(*place, band, 1.0, 0.1)
    assert zodiacal_rate(*place, band, 2.0, 0.3) == pytest.approx(18 * one)


def test_what_a_camera_sees():
    vis = detectors.detector("vis", "3-4", MISSION)
    place = at(90, 30)
    zodi = zodiacal_rate(*place, passbands.load("euclid_vis"), 0.9926, 0.1)
    scattered = 0.0296 * diffuse_light.starlight(*place[:2], MISSION)
    assert diffuse_light.sky_rate(
        diffuse_light.starlit_sky(vis, "euclid_vis", MISSION), *place, MISSION
    ) == pytest.approx(zodi + scattered)
    lsst = detectors.detector("lsstcam", "R22_S11", MISSION)
    assert diffuse_light.sky_rate(diffuse_light.ground_sky(lsst, "lsst_r", MISSION), *place, MISSION) == 32.95


@pytest.mark.parametrize(
    ("longitude", "latitude", "wanted"),
    [
        (0.0, 60.0, 1.19),
        (330.0, -10.0, 14.6),
        (30.0, 10.0, 14.6),
        (75.0, 60.0, (1.069 * 0.9783) ** 0.5),
        (5.0, 90.0, 0.8116),
    ],
)
def test_scattered_light_is_of_the_field_s_stars(longitude, latitude, wanted):
    """The table's own numbers, where astropy has the place; between them the mean of the logarithms."""
    place = SkyCoord(longitude, latitude, unit="deg", frame="galactic").icrs
    assert diffuse_light.starlight(place.ra.deg, place.dec.deg, MISSION) == pytest.approx(wanted, rel=1e-3)


def test_scattered_light_has_its_mission_value_at_sixty_degrees():
    latitude = MISSION.value("env.straylight.reference_latitude", "deg")
    places = [SkyCoord(lon, latitude, unit="deg", frame="galactic").icrs for lon in np.arange(0.0, 360.0, 15.0)]
    assert np.mean([diffuse_light.starlight(p.ra.deg, p.dec.deg, MISSION) for p in places]) == pytest.approx(
        1.0, rel=0.02
    )


def test_bands_share_the_sky_of_the_one_that_they_make_up():
    """VIS cut into three: what each sees, its part of the scattered starlight with it, is what VIS sees."""
    mission = resolve()
    detector = detectors.detector("vis", "3-4", mission)
    whole = passbands.load("euclid_vis")
    rates = [
        diffuse_light.sky_rate(
            diffuse_light.starlit_sky(detector, "own", mission, curve), 53.1, -27.8, 60905.0, mission
        )
        for curve in (*sub_bands.sub_bands(whole, 3), whole)
    ]
    # The trapezoids between the pieces are lost.
    assert sum(rates[:3]) == pytest.approx(rates[3], rel=2e-3)
    assert rates[3] == diffuse_light.sky_rate(
        diffuse_light.starlit_sky(detector, "euclid_vis", mission), 53.1, -27.8, 60905.0, mission
    )


@pytest.mark.parametrize(
    ("latitude", "rates"),
    [
        (0, (2.30, 2.81, 2.33)),
        (10, (2.00, 2.44, 2.02)),
        (15, (1.71, 2.09, 1.74)),
        (20, (1.47, 1.80, 1.49)),
        (30, (1.17, 1.43, 1.19)),
        (45, (0.92, 1.13, 0.94)),
        (60, (0.76, 0.93, 0.77)),
        (90, (0.68, 0.84, 0.69)),
    ],
)
def test_nisp_zodiacal_rates_at_quadrature(latitude, rates):
    """e-/s in a NISP pixel in Y, J and H: Leinert et al. 1998, to the model's 10 %."""
    nisp = detectors.detector("nisp", "DET11", MISSION)
    for name, rate in zip(("euclid_y", "euclid_j", "euclid_h"), rates, strict=True):
        sky = diffuse_light.thermal_sky(nisp, name, MISSION)
        zodi = diffuse_light.sky_rate(replace(sky, constant=0.0, stars=0.0), *at(90, latitude), MISSION)
        assert zodi == pytest.approx(rate, rel=0.10), name


def test_what_an_infrared_camera_sees():
    """Zodiacal light, half a percent to 2 % of thermal light in H and none in Y, a tenth of starlight."""
    nisp, place = detectors.detector("nisp", "DET23", MISSION), at(90, 30)
    for name, warm in (("euclid_y", 0.0), ("euclid_j", 0.001), ("euclid_h", 0.02)):
        sky = diffuse_light.thermal_sky(nisp, name, MISSION)
        assert sky.constant == pytest.approx(warm)
        zodi = zodiacal_rate(*place, passbands.load(name), 0.9926, 0.3)
        assert sky.stars == pytest.approx(0.1 * zodi, rel=0.2)
        found = diffuse_light.sky_rate(sky, *place, MISSION)
        assert found == pytest.approx(zodi + warm + sky.stars * diffuse_light.starlight(*place[:2], MISSION))
