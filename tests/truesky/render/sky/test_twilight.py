"""Light of twilight: the published fit at the zenith, and its gradient over the field of view."""

import numpy as np
import pytest

from lake_schema.mission.configuration import resolve
from truesky.fluxes import passbands
from truesky.render.camera import detectors, pointing
from truesky.render.sky import diffuse_light, night_sky, observatory, twilight
from truesky.render.sky.night_sky import Night

MISSION = resolve()
DETECTOR = detectors.detector("lsstcam", "R22_S11", MISSION)


def night(band):
    zero_point = MISSION.value(f"ext.lsstcam.{band}.zero_point", "mag")
    level = diffuse_light.ground_sky(DETECTOR, band, MISSION).constant
    return Night.from_detector(DETECTOR, band, (zero_point, level), MISSION, None)


def date_of_sun(altitude, site, start=60990.9):
    """Return the date of an evening on which the Sun has an altitude."""
    times = start + np.arange(0.0, 0.3, 1e-4)
    above = np.array([observatory.sun_direction(float(t), site)[0] - altitude for t in times])
    return float(times[np.argmin(np.abs(above))])


def test_twilight_is_the_published_fit():
    """Yoachim et al. 2016: 2.0 times a dark zenith in y for a Sun at -12 deg, 24.08 dex per radian."""
    band = passbands.load("lsst_y")
    assert twilight.ratio(band, -12.0, 90.0, 1.0) == pytest.approx(2.0, rel=0.05)
    assert twilight.ratio(band, -14.0, 90.0, 1.0) == pytest.approx(2.0 * 10.0 ** (-24.08 * np.radians(2.0)), rel=0.05)
    # Away from the Sun 0.3 dex per airmass, and twice as much towards it.
    assert twilight.ratio(band, -12.0, 180.0, 2.0) == pytest.approx(2.0 * 10.0**0.3, rel=0.05)
    assert twilight.ratio(band, -12.0, 0.0, 2.0) == pytest.approx(2.0 * 10.0**0.6, rel=0.05)
    # Blue light lasts longest; there is none in the night, and daylight is not simulated.
    ratios = [twilight.ratio(passbands.load(f"lsst_{name}"), -13.0, 90.0, 1.2) for name in "ugr"]
    assert ratios == sorted(ratios, reverse=True)
    assert twilight.ratio(band, -21.0, 0.0, 1.0) == twilight.ratio(band, -5.0, 0.0, 1.0) == 0.0


@pytest.mark.parametrize(("altitude", "brighter"), [(-12.0, True), (-15.0, True), (-20.5, False)])
def test_the_sky_is_brighter_in_twilight(altitude, brighter):
    own = night("lsst_g")
    mjd = date_of_sun(altitude, own.site)
    parts = night_sky.sky_components(own, 0.0, -40.0, mjd, MISSION)
    assert parts.total == pytest.approx(night_sky.sky_rate(own, 0.0, -40.0, mjd, MISSION))
    assert (parts.twilight > 0.02 * parts.dark) == brighter


@pytest.mark.parametrize("angle", [0.0, 50.0, 200.0])
def test_slopes_are_those_of_the_sky(angle):
    """The plane agrees with the model at the edge of the field; it is bright on the side of the Sun."""
    own, place = night("lsst_r"), (350.0, -35.0)
    mjd = date_of_sun(-11.0, own.site)
    slopes = night_sky.twilight_slopes(own, place, angle, mjd, MISSION)
    centre = night_sky.sky_components(own, *place, mjd, MISSION)
    x, y = np.array([1.5, -1.0, 0.7]), np.array([0.0, 1.0, -1.2])
    for at_x, at_y in zip(x, y, strict=True):
        ra, dec = (float(v[0]) for v in pointing.sky_of_plane([3600 * at_x], [3600 * at_y], *place, angle))
        there = night_sky.sky_components(own, ra, dec, mjd, MISSION)
        change = (there.twilight - centre.twilight) / centre.total
        assert slopes[0] * at_x + slopes[1] * at_y == pytest.approx(change, abs=0.006)
    sun_azimuth = observatory.sun_direction(mjd, own.site)[1]
    step = 0.5 / np.hypot(*slopes)
    ra, dec = (
        float(v[0]) for v in pointing.sky_of_plane([3600 * step * slopes[0]], [3600 * step * slopes[1]], *place, angle)
    )
    bright, here = (own.site.azimuth(*at, mjd) for at in ((ra, dec), place))
    nearer = [abs((azimuth - sun_azimuth + 180.0) % 360.0 - 180.0) for azimuth in (bright, here)]
    lower = own.site.altitude(ra, dec, mjd) < own.site.altitude(*place, mjd)
    assert nearer[0] < nearer[1] or lower
    assert night_sky.twilight_slopes(own, place, angle, mjd + 0.2, MISSION) == (0.0, 0.0)
