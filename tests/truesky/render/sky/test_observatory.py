"""Sun, Moon and fields above an observatory agree with astropy. Surveys wait for the night, if a field rises."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lake_schema.mission.configuration import resolve
from lake_schema.sky import separation
from truesky.render.sky import observatory

MISSION = resolve()
LSST, CFHT = (observatory.Site.from_mission(f"ext.{camera}", MISSION) for camera in ("lsstcam", "megacam"))


@pytest.mark.parametrize("site", [LSST, CFHT], ids=["south", "north"])
def test_altitudes_and_zenith_are_astropy_s(site):
    import astropy.units as u
    from astropy.coordinates import AltAz, EarthLocation, SkyCoord, get_body
    from astropy.time import Time
    from astropy.utils import iers

    with iers.conf.set_temp("auto_download", False):
        times = Time(np.linspace(60905.0, 60935.0, 25), format="mjd")
        place = EarthLocation.from_geodetic(site.longitude, site.latitude, site.height)
        frame = AltAz(obstime=times, location=place)
        field = SkyCoord(53.1, -27.8, unit="deg")
        seen = field.transform_to(frame)
        assert np.abs(seen.alt.deg - site.altitude(53.1, -27.8, times.mjd)).max() < 0.2
        azimuths = np.array([site.azimuth(53.1, -27.8, mjd) for mjd in times.mjd])
        turned = ((azimuths - seen.az.deg + 180.0) % 360.0 - 180.0) * np.cos(seen.alt.rad)
        assert np.abs(turned).max() < 0.2
        higher = AltAz(az=seen.az, alt=seen.alt + 0.1 * u.deg, obstime=times, location=place)
        theirs = field.position_angle(SkyCoord(higher).transform_to("icrs")).deg
        ours = np.array([site.zenith(53.1, -27.8, mjd) for mjd in times.mjd])
        assert np.abs((ours - theirs + 180.0) % 360.0 - 180.0).max() < 0.4
        body = get_body("moon", times)
        ra, dec, phase = observatory.moon_position(times.mjd)
        assert separation(ra, dec, body.ra.deg, body.dec.deg).max() < 0.5
        moon = get_body("moon", times, place).transform_to(frame)
        assert np.abs(moon.alt.deg - observatory.moon_altitude(times.mjd, site)).max() < 0.5
    # The Moon is full on 7 September 2025, and new on 21 September.
    days = times.mjd[[np.argmin(phase), np.argmax(phase)]]
    assert abs(days[0] - 60925.76) < 1.3
    assert phase.min() < 15.0 < 165.0 < phase.max()


def test_airmass():
    np.testing.assert_allclose(
        observatory.airmass(np.array([90.0, 60.0, 30.0, 10.0])), [1.0, 1.154, 1.994, 5.59], atol=0.01
    )


@given(st.floats(0.0, 359.9), st.floats(-90.0, 90.0), st.floats(60000.0, 62000.0), st.sampled_from([LSST, CFHT]))
def test_every_field_has_an_airmass(ra, dec, mjd, site):
    found, zenith = observatory.airmass_and_zenith(ra, dec, mjd, site)
    assert 1.0 <= found <= observatory.HIGHEST_AIRMASS
    assert -180.0 <= zenith <= 180.0


@given(st.floats(0.0, 359.9), st.floats(-90.0, 90.0), st.floats(60000.0, 62000.0), st.sampled_from([LSST, CFHT]))
def test_altitude_and_airmass_agree(ra, dec, mjd, site):
    altitude, azimuth = observatory.altitude_and_azimuth(ra, dec, mjd, site)
    found, zenith = observatory.airmass_and_zenith(ra, dec, mjd, site)
    assert observatory.airmass(altitude) == pytest.approx(found, rel=1e-4)
    assert 0.0 <= azimuth <= 360.0
    # A field in the east rises: the position angle of its zenith is negative. On the meridian the sign is not defined.
    if abs(np.sin(np.radians(azimuth))) > 1e-6:
        assert (azimuth < 180.0) == (zenith < 0.0)


@pytest.mark.parametrize("start", [60000.0, 60100.3, 60290.9])
def test_surveys_wait_for_the_night(start):
    found = observatory.next_dark_time(53.1, -27.8, start, LSST, 0.4)
    assert start <= found < start + 180.0
    sun = observatory.equatorial(observatory.sun_longitude(found), 0.0)
    assert LSST.altitude(*sun, found) < -18.0
    assert observatory.airmass_and_zenith(53.1, -27.8, found, LSST)[0] <= 1.21
    ra, dec, _ = observatory.moon_position(found)
    if observatory.moon_altitude(found, LSST) > -2.0:
        assert separation(53.1, -27.8, ra, dec) > 30.0
        assert observatory.moon_lit_fraction(found) <= 0.4


@pytest.mark.parametrize(("ra", "dec"), [(53.1, -27.8), (200.0, 20.0), (10.0, -70.0)])
def test_a_field_is_highest_at_its_dark_transit(ra, dec):
    found = observatory.next_dark_transit(ra, dec, 60000.3, LSST, 0.4)
    assert 60000.3 <= found < 60400.0
    assert observatory.sun_altitude(np.array([found]), LSST)[0] < -18.0
    highest = LSST.altitude(ra, dec, found + np.linspace(-0.5, 0.5, 1001)).max()
    assert LSST.altitude(ra, dec, found) == pytest.approx(highest, abs=1e-3)
    around = found + np.array([-1.0, 0.0, 1.0]) / 24.0
    assert observatory._is_dark(ra, dec, around, LSST, 0.4).all()
    earlier = found - np.arange(1.0, 400.0) / 1.00273791
    for transit in earlier[earlier >= 60000.3]:
        assert not observatory._is_dark(ra, dec, transit + np.array([-1.0, 0.0, 1.0]) / 24.0, LSST, 0.4).all()


def test_a_low_field_crosses_the_meridian_at_night():
    """The field never reaches an airmass of 2."""
    found = observatory.next_dark_transit(30.0, 45.0, 60000.3, LSST, 0.4)
    assert LSST.altitude(30.0, 45.0, found) == pytest.approx(90.0 - 45.0 + LSST.latitude, abs=0.3)
    assert observatory.sun_altitude(np.array([found]), LSST)[0] < -18.0


@pytest.mark.parametrize(("dec", "site"), [(80.0, LSST), (-60.0, CFHT)])
def test_a_field_that_never_rises_is_not_waited_for(dec, site):
    """The search would look through 400 days in vain. The exposure is taken in the first dark time instead."""
    found = observatory.next_dark_time(30.0, dec, 60000.8, site, 0.0)
    assert 60000.8 <= found < 60020.0
    assert observatory.sun_altitude(np.array([found]), site)[0] < -18.0
    assert observatory.moon_altitude(found, site) < -2.0


@pytest.mark.parametrize("mjd", [60126.0, 60441.98, 60780.2, 60795.5, 60803.1, 61100.7])
def test_the_moon_is_that_of_astropy(mjd):
    """Position, illuminated fraction and altitude of the Moon from ephemerides."""
    from astropy.coordinates import AltAz, EarthLocation, get_body
    from astropy.time import Time

    when, where = Time(mjd, format="mjd"), EarthLocation.from_geodetic(LSST.longitude, LSST.latitude, LSST.height)
    moon, sun = (get_body(name, when) for name in ("moon", "sun"))
    elongation = sun.separation(moon)
    phase = np.arctan2(sun.distance * np.sin(elongation), moon.distance - sun.distance * np.cos(elongation))
    ra, dec, _ = (float(x) for x in observatory.moon_position(mjd))
    assert separation(ra, dec, moon.ra.deg, moon.dec.deg) < 0.6
    assert observatory.moon_lit_fraction(mjd) == pytest.approx(0.5 * (1.0 + np.cos(phase.value)), abs=0.01)
    up = get_body("moon", when, where).transform_to(AltAz(obstime=when, location=where)).alt.deg
    assert observatory.moon_altitude(mjd, LSST) == pytest.approx(up, abs=0.8)
