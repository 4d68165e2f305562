"""A tilted filter displaces rays by Snell's law, and the world coordinates of an exposure include it."""

from dataclasses import replace

import numpy as np
import pytest
from astropy.coordinates import SkyCoord

from lake_schema.mission.configuration import resolve
from tests.truesky.render.fields import exposure
from truesky.render.camera import astrometry, filter_wheel
from truesky.render.camera.detectors import detectors
from truesky.render.channels.aim import Aim

MISSION = resolve()
NISP = detectors("nisp", MISSION)
ARCSEC = np.pi / 648000


def leaves(ray, normal, thickness, n):
    """Return the displacement [2] that a plate causes on a screen behind it, for a ray through the origin."""
    cosine = ray @ normal
    inside = ray / n + normal * (np.sqrt(1 - (1 - cosine**2) / n**2) - cosine / n)
    way = inside * thickness / (inside @ normal)
    return (way - ray * way[2] / ray[2])[:2]


@pytest.mark.parametrize("tilt", [(1.7e-3, 0.0), (0.0, -1.7e-3), (1.2e-3, 0.9e-3)])
@pytest.mark.parametrize("place", [(0.0, 0.0), (1300.0, 0.0), (0.0, -1376.0), (1300.0, 1376.0), (-900.0, 700.0)])
def test_a_ray_is_displaced_as_snell_has_it(tilt, place):
    thickness, n = (
        MISSION.value(f"nisp.filter.{key}", unit) for key, unit in (("thickness", "mm"), ("refractive_index", ""))
    )
    wider = MISSION.value("plm.focal_length", "m") / MISSION.value("nisp.collimator_focal_length", "m")
    across = wider * ARCSEC * np.array(place)
    ray = np.array([*across, np.sqrt(1 - across @ across)])
    normal = np.array([*tilt, np.sqrt(1 - tilt[0] ** 2 - tilt[1] ** 2)])
    upright = np.array([0.0, 0.0, 1.0])
    # A pixel of 0.3 arcsec is 18 um wide.
    traced = 0.3 / 0.018 * (leaves(ray, normal, thickness, n) - leaves(ray, upright, thickness, n))
    seen = filter_wheel.apply_tilt(replace(NISP[5], x=0.0, y=0.0, distortion_terms=()), *tilt)
    shift = -np.array([seen.x, seen.y])
    bend = -np.array(
        [sum(t[axis] * place[0] ** t[0] * place[1] ** t[1] for t in seen.distortion_terms) for axis in (2, 3)]
    )
    size = np.hypot(*shift)
    assert size > 0.05
    np.testing.assert_allclose(shift + bend, traced, atol=5e-4 * size)
    if place == (1300.0, 1376.0):
        assert np.hypot(*(shift - traced)) > 5e-3 * size


def test_the_header_knows_it():
    """The shifts of the detectors of an exposure differ by less than 3 %. They depend on its time, not on its noise."""
    moves = []
    for mjd, realisation in ((60000.0, None), (60000.0, 3), (60000.01, None)):
        row = exposure(camera="nisp", channel="VIS", band="euclid_y", mjd=mjd, realisation=realisation)
        here = []
        for d in NISP:
            still = astrometry.wcs(d, row.ra, row.dec, row.position_angle)
            seen = Aim.from_exposure(row, d).wcs
            x, y = astrometry.pixel_of_sky(seen, *astrometry.sky_of_pixel(still, [1000.0], [1000.0]))
            sign = -1 if d.upside_down else 1
            here.append([sign * (x[0] - 1000.0), sign * (y[0] - 1000.0)])
        moves.append(np.array(here))
    first, same, other = moves
    np.testing.assert_array_equal(first, same)
    assert np.abs(first - other).max() > 0.01
    mean = first.mean(axis=0)
    assert 0.005 < np.hypot(*mean) < 1.5
    assert 1e-4 * np.hypot(*mean) < np.abs(first - mean).max() < 0.03 * np.hypot(*mean)


def test_another_seed_is_another_tilt():
    row = exposure(camera="nisp", channel="NISP-P", band="euclid_y")
    first, again, other = (Aim.from_exposure(row, NISP[3], seed=seed).wcs.wcs.crpix for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 0.01


def test_the_error_is_the_mission_s():
    """Sample of 400 positions; significance 6e-5 of the mean (4 standard errors), 1e-3 of the rms (8 %)."""
    tilts = []
    for number in range(400):
        seen = filter_wheel.apply_random_tilt(NISP[5], str(number), 1)
        tilts.append(
            [(NISP[5].x - seen.x) / NISP[5].filter_wheel.shift, (NISP[5].y - seen.y) / NISP[5].filter_wheel.shift]
        )
    rms = np.sqrt((np.array(tilts) ** 2).sum(axis=1).mean())
    assert np.degrees(rms) * 60 == pytest.approx(6.0, rel=0.08)
    assert np.abs(np.mean(tilts, axis=0)).max() < 4 * rms / np.sqrt(2 * 400)


def test_other_cameras_and_a_still_wheel_change_nothing():
    still = detectors("nisp", resolve(overrides={"nisp.filter_wheel_error": (0.0, "arcmin")}))[3]
    assert filter_wheel.apply_random_tilt(still, "1", 1) is still
    vis = detectors("vis", MISSION)[3]
    assert filter_wheel.apply_random_tilt(vis, "1", 1) is vis
    assert filter_wheel.apply_tilt(vis, 1e-3, 0.0) is vis


def test_a_shift_of_the_image_is_a_shift_of_the_sky():
    d = replace(NISP[5], distortion_terms=())
    moved = replace(filter_wheel.apply_tilt(d, 2e-3, 0.0), distortion_terms=())
    before, after = (astrometry.wcs(each, 10.0, 0.0, 0.0) for each in (d, moved))
    here, there = (
        SkyCoord(*astrometry.sky_of_pixel(system, [500.0], [500.0]), unit="deg") for system in (before, after)
    )
    assert here.separation(there).arcsec[0] == pytest.approx(2e-3 * d.filter_wheel.shift, rel=1e-4)
