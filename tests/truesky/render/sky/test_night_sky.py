"""The sky over ground cameras: dark levels, airmass, zodiacal light and the Moon."""

from dataclasses import replace

import numpy as np
import pytest

from lake_schema.mission.configuration import resolve
from lake_schema.sky import separation
from lake_schema.sky.ecliptic import equatorial
from tests.truesky import nightly
from truesky.render.camera import detectors
from truesky.render.sky import diffuse_light, night_sky, observatory
from truesky.render.sky.night_sky import Night

MISSION = resolve()
CAMERAS = ("lsstcam", "megacam", "jpcam", "decam", "hsc", "gpc1")
SCALES = {camera: detectors.detectors(camera, MISSION)[0].pixel_scale for camera in CAMERAS}


def night(camera, band):
    zero_point = MISSION.value(f"ext.{camera}.{band}.zero_point", "mag")
    detector = detectors.detectors(camera, MISSION)[0]
    level = diffuse_light.ground_sky(detector, band, MISSION).constant
    return zero_point, Night.from_detector(detector, band, (zero_point, level), MISSION, None)


def brightness(camera, band, ra, dec, mjd):
    """Return the sky brightness, AB mag / arcsec2."""
    zero_point, own = night(camera, band)
    rate = night_sky.sky_rate(own, ra, dec, mjd, MISSION)
    return zero_point - 2.5 * np.log10(rate / SCALES[camera] ** 2)


def dates(site, ra, dec):
    """Return times in a month at which a field is nearly at its highest, and neither Sun nor Moon is up."""
    times = 60900.0 + np.arange(0.0, 30.0, 0.02)
    high = site.altitude(ra, dec, times)
    suns = [equatorial(observatory.sun_longitude(float(t)), 0.0) for t in times]
    night = np.array([float(site.altitude(*sun, t)) for sun, t in zip(suns, times, strict=True)]) < -18.0
    return times[(high > high.max() - 1.0) & night & (observatory.moon_altitude(times, site) < -5.0)].tolist()


@nightly.parametrize(
    ("camera", "band", "dark"),
    [
        ("megacam", "cfis_u", 22.7),
        pytest.param("megacam", "cfis_r", 21.3, marks=pytest.mark.nightly),
        pytest.param("jpcam", "jedis_g", 22.0, marks=pytest.mark.nightly),
        ("lsstcam", "lsst_r", 21.07),
    ],
    (3,),
)
def test_a_dark_zenith_far_from_the_ecliptic_has_its_level(camera, band, dark):
    """The level is also correct for cameras in the north."""
    site = night(camera, band)[1].site
    fields = [(ra, site.latitude) for ra in range(0, 360, 15)]
    found = [brightness(camera, band, ra, dec, t) for ra, dec in fields for t in dates(site, ra, dec)]
    assert max(found) == pytest.approx(dark, abs=0.1)
    assert min(found) > dark - 0.8


def test_measured_levels_are_taken_as_they_are():
    for camera, band, level in (("decam", "des_g", 22.01), ("hsc", "hsc_z", 19.55), ("gpc1", "ps1_i", 19.8)):
        for mjd in (60903.3, 60926.3):
            assert brightness(camera, band, 53.1, -10.0, mjd) == pytest.approx(level, abs=1e-6)


def test_airglow_grows_with_airmass_and_is_dimmed():
    """By Krisciunas & Schaefer 1991, eq. 3 and 2, a layer is 1.85 times as thick at an airmass of 2."""
    _, own = night("lsstcam", "lsst_y")
    site = own.site
    ra, dec = 100.0, -60.0
    times = 60900.0 + np.arange(0.0, 29.0, 0.01)
    high = site.altitude(ra, dec, times)
    down = np.array([float(observatory.moon_altitude(t, site)) < 0.0 for t in times])

    def at(altitude):
        mjd = times[down][np.argmin(np.abs(high[down] - altitude))]
        return night_sky.sky_rate(own, ra, dec, mjd, MISSION)

    path = [(1.0 - 0.96 * np.cos(np.radians(a)) ** 2) ** -0.5 for a in (30.0, 60.0)]
    ratio = path[0] / path[1] * 10 ** (-0.4 * 0.17 * (1.994 - 1.154))
    assert at(30.0) / at(60.0) == pytest.approx(ratio, rel=0.02)


def test_moonlight_is_krisciunas_and_schaefer_s():
    """The reference is their scattering of moonlight in V, and the brightness of the sky that they give."""
    _, own = night("lsstcam", "lsst_g")
    own = replace(own, extinction=0.172)
    site = own.site
    times = 60918.0 + np.arange(0.0, 14.0, 0.01)
    for mjd in times[::37]:
        moon_ra, moon_dec, phase = (float(x) for x in observatory.moon_position(mjd))
        up = float(observatory.moon_altitude(mjd, site))
        ra, dec = (moon_ra + 60.0) % 360.0, moon_dec
        airmass = observatory.airmass_and_zenith(ra, dec, mjd, site)[0]
        found = night_sky.moonlight(own, ra, dec, mjd, airmass)
        if up <= 0.0:
            assert found == 0.0
            continue
        away = float(separation(ra, dec, moon_ra, moon_dec))
        illuminance = 10 ** (-0.4 * (3.84 + 0.026 * phase + 4e-9 * phase**4))
        scattering = 229086.8 * (1.06 + np.cos(np.radians(away)) ** 2) + 10 ** (6.15 - away / 40)
        moon, field = (
            (1 - 0.96 * np.cos(np.radians(h)) ** 2) ** -0.5 for h in (up, np.degrees(np.arcsin(1 / airmass)))
        )
        theirs = scattering * illuminance * 10 ** (-0.0688 * moon) * (1 - 10 ** (-0.0688 * field))
        assert found == pytest.approx(theirs, rel=1e-3)
    # A full Moon at 60 deg brightens the sky by about 3 mag from 21.6 in V, and less in redder bands.
    full = 60925.76 + np.arange(-1.0, 1.0, 0.02)
    mjd = float(full[np.argmax([observatory.moon_altitude(t, site) for t in full])])
    ra, dec, _ = (float(x) for x in observatory.moon_position(mjd))
    changes = []
    for band in ("lsst_g", "lsst_r", "lsst_i", "lsst_y"):
        zero_point, one = night("lsstcam", band)
        dark = zero_point - 2.5 * np.log10(one.level / SCALES["lsstcam"] ** 2)
        changes.append(dark - brightness("lsstcam", band, (ra + 60.0) % 360.0, dec, mjd))
    assert changes == sorted(changes, reverse=True)
    assert 2.5 < changes[0] < 4.5
    assert changes[-1] < 0.5 * changes[0]


def test_zodiacal_light_is_brightest_in_the_ecliptic():
    site = night("lsstcam", "lsst_g")[1].site
    found = []
    for latitude in (0.0, -50.0):
        ra, dec = (float(x) for x in equatorial(0.0, latitude))
        rates = [
            night_sky.sky_rate(night("lsstcam", "lsst_g")[1], ra, dec, t, MISSION)
            for t in 60940.0 + np.arange(0.0, 1.0, 0.01)
            if observatory.moon_altitude(t, site) < 0
            and observatory.sun_direction(float(t), site)[0] < -20.0
            and abs(observatory.airmass_and_zenith(ra, dec, t, site)[0] - 1.2) < 0.1
        ]
        found.append(np.mean(rates))
    assert 1.1 < found[0] / found[1] < 1.8


def test_the_air_dims_what_the_zero_point_is_of():
    _, own = night("lsstcam", "lsst_u")
    assert night_sky.extra_extinction(own, 1.0) == 0.0
    assert night_sky.extra_extinction(own, 1.5) == pytest.approx(0.2455)
    assert night_sky.extra_extinction(night("decam", "des_r")[1], 1.2) == pytest.approx(0.0, abs=1e-12)
