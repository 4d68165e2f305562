"""Fringes of the sky and trails of satellites over ground cameras."""

from dataclasses import replace

import numpy as np
import pytest

from lake_schema.mission.configuration import resolve
from tests.truesky.render import fields
from tests.truesky.render.fields import MISSION, fluxes, galaxies, small, stars
from truesky.fluxes import passbands
from truesky.randomness import rng
from truesky.render.camera import astrometry, detectors
from truesky.render.effects.light import fringes, satellite_trails
from truesky.render.effects.light.satellite_trails import Blur, Satellites
from truesky.render.effects.scene import Scene
from truesky.render.exposure import rendered_detector
from truesky.request.accuracy import SURVEY

CROSSED = resolve(overrides={"survey.satellites.rate": (0.05, "1 / (deg s)")})


def scene(camera="lsstcam", name="R22_S11", band="lsst_y", mission=MISSION, **more):
    d = detectors.detector(camera, name, MISSION)
    known = {"seeing": 0.7, "zero_point": 26.82} | more
    return Scene(mission, d.section, 30.0, 90.0, 1e4, d, band=passbands.load(band), **known)


# ------------------------------------------------------------------------------------------------ fringes


def added(seed=1, side=1024, amplitude=0.01, period=60.0, electrons=1e4):
    return fringes.apply(np.zeros((side, side)), electrons, amplitude, period, np.random.default_rng(seed))


def test_fringes_are_of_the_sky_alone():
    """They depend only on the light of the sky, not on the sources."""
    stars_ = 1e5 * np.random.default_rng(2).random((1024, 1024))
    once = fringes.apply(stars_, 1e4, 0.01, 60.0, np.random.default_rng(1)) - stars_
    np.testing.assert_allclose(once, added(), atol=1e-9)
    np.testing.assert_allclose(added(electrons=2e4), 2.0 * added(), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("period", [40.0, 100.0])
def test_fringes_are_as_strong_and_as_wide_as_the_parameters_say(period):
    found = np.stack([added(seed, period=period) for seed in range(4)])
    assert np.abs(found).max() == pytest.approx(100.0, rel=0.02)
    # A sine's slope is 2 pi over its period times its rms; some of the contrast is lost where lines fall apart.
    gradient = np.sqrt(np.mean(sum(np.gradient(found, axis=axis) ** 2 for axis in (1, 2))))
    assert 2.0 * np.pi * found.std() / gradient == pytest.approx(period, rel=0.15)
    assert abs(found.mean()) < 0.15 * found.std()


def test_a_detector_has_its_own_fringes_in_every_exposure():
    numbers = [
        rendered_detector.random_identity(
            fringes.EFFECT, fields.exposure(camera="lsstcam", exposure_id=i, mjd=60000.0 + i), name, 1
        )
        for i, name in ((1, "R22_S11"), (2, "R22_S11"), (1, "R22_S12"))
    ]
    same, again, other = (added(rng.stream(*n).integers(1 << 30)) for n in numbers)
    np.testing.assert_array_equal(same, again)
    assert abs(np.corrcoef(same.ravel(), other.ravel())[0, 1]) < 0.2


def test_fringes_are_in_red_bands():
    amplitudes = {band: fringes.parameters(scene(band=band))[1] for band in ("lsst_u", "lsst_g", "lsst_r", "lsst_y")}
    assert amplitudes == {"lsst_u": 0.0, "lsst_g": 0.0, "lsst_r": 0.0, "lsst_y": 0.01}
    assert fringes.EFFECT.is_needed(scene())
    assert not fringes.EFFECT.is_needed(scene(band="lsst_r"))


# ------------------------------------------------------------------------------------------------ satellites


@pytest.mark.parametrize("blur", [Blur(4.0, 0.0, 0.0), Blur(3.7, 5.4, 2.2), Blur(2.0, 12.0, 7.0)])
def test_a_trail_has_all_its_light(blur):
    profile = satellite_trails.profile(blur)
    whole = (2.0 * profile[1:].sum() + profile[0]) / 8.0
    assert whole == pytest.approx(1.0, abs=2e-3)
    # A ring out of focus is darker in the middle than at its sides.
    assert (profile.argmax() > 0) == (blur.outer > blur.seeing)


def line(name, seed=3, camera="lsstcam", mission=CROSSED):
    one = scene(camera, name, mission=mission)
    some, blur, d, radius = satellite_trails.parameters(one)
    # One, so bright that it is found.
    some = Satellites(some.number, 1e5, 0.0)
    return satellite_trails.apply(np.zeros((d.ny, d.nx)), some, blur, d, radius, np.random.default_rng(seed)), d


def places(image, system):
    """Return right ascension and declination of the brightest pixels in widely separated rows."""
    rows = np.arange(50, image.shape[0] - 50, 200)
    columns = image[rows].argmax(axis=1)
    # Not where a trail has left the detector.
    bright = (image[rows, columns] > 0.9 * image.max()) & (columns > 20) & (columns < image.shape[1] - 20)
    return np.stack(astrometry.sky_of_pixel(system, columns[bright], rows[bright]))


def test_a_trail_goes_on_in_the_next_detector():
    """On one great circle of the sky, over neighbours and gaps, however the optics bend it in the pixels."""
    images = {name: line(name) for name in ("R22_S01", "R22_S11", "R22_S21", "R12_S21")}
    assert sum(image.max() > 0.0 for image, _ in images.values()) >= 2
    seen = [places(image, astrometry.wcs(d, 10.0, 0.0, 0.0)) for image, d in images.values() if image.max() > 0.0]
    ra, dec = np.radians(np.hstack(seen))
    there = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)
    assert len(there) > 10
    # Distances from the plane through the observer that fits all points best.
    off = there @ np.linalg.svd(there)[2][-1]
    assert np.degrees(np.abs(off).max()) * 3600.0 < 2.0 * 0.2


def test_a_trail_is_as_bright_as_the_satellite():
    """Of magnitude 7 at half a degree a second."""
    one = scene(mission=CROSSED)
    some, blur, _, _ = satellite_trails.parameters(one)
    image = satellite_trails.apply(np.zeros((200, 4000)), Satellites(1e-9, *some[1:]), blur, None, 10.0,
                                   np.random.default_rng(1))  # fmt: skip
    assert image.sum() == 0.0
    wanted = 10 ** (0.4 * (26.82 - 7.0)) * 0.2000587 / 1800.0
    assert some.electrons == pytest.approx(wanted, rel=1e-6)
    flat = np.zeros((400, 400))
    table = some.electrons * satellite_trails.profile(blur)
    satellite_trails._add_trail(flat, np.array([-10.0, 500.0]), np.array([150.0, 250.0]), table)
    slope = 100.0 / 510.0
    # Light per column of a line with this slope.
    assert flat[:, 200].sum() == pytest.approx(wanted * np.sqrt(1.0 + slope**2), rel=2e-3)


def test_there_are_no_satellites_by_default():
    one = scene()
    assert satellite_trails.EFFECT.contribution(one) == 0.0
    assert not satellite_trails.EFFECT.is_needed(one)
    assert satellite_trails.EFFECT.is_needed(replace(one, mission=CROSSED))


def test_the_truth_has_satellites():
    d = small("lsstcam", "R22_S11", 256)
    band, body, points = "lsst_r", galaxies([], []), stars([], [])
    plain = resolve(overrides={"ext.lsstcam.psf.profile": (1.0, "")})
    crossed = plain.with_overrides({"survey.satellites.rate": (2.0, "1 / (deg s)")})
    exposed = {"channel": "EXT", "camera": "lsstcam", "band": band, "seeing": 0.8, "sky": 10.0, "zero_point": 28.36}
    tables = body, fluxes(body, band, []), points, fluxes(points, band, [])
    one = fields.rendered(exposed, d, tables, crossed, SURVEY, truth=("satellites", "sky"))
    assert one.maps["satellites"].max() > 100.0
    # No part of the sky, nor of the sources.
    assert one.maps["sky"].max() < 1.1 * 1000.0
    assert one.maps["noise_free"].max() == 0.0
    none = fields.rendered(exposed, d, tables, plain, SURVEY, truth=("satellites",))
    assert (none.maps["satellites"] == 0.0).all()
