"""Nominal exposures: their camera, date and pointing."""

import numpy as np
import pytest

from lake_schema.errors import BadInput
from tests.truesky.render.fields import MISSION
from truesky.render.camera import astrometry, detectors
from truesky.render.sky import observatory
from truesky.render.windows import nominal

PLACE = (53.117, -27.808)
SITE = observatory.Site.from_mission("ext.lsstcam", MISSION)


@pytest.mark.parametrize(
    ("band", "camera", "instrument"),
    [
        ("euclid_vis", None, ("VIS", "vis")),
        ("euclid_j", None, ("NISP-P", "nisp")),
        ("lsst_r", None, ("EXT", "lsstcam")),
        ("lsst_r", "lsstcam", ("EXT", "lsstcam")),
    ],
)
def test_a_band_has_an_instrument(band, camera, instrument):
    assert nominal.find_instrument(band, camera, MISSION) == instrument


@pytest.mark.parametrize(
    ("band", "camera", "message"),
    [
        ("euclid_vs", None, r"band: .*euclid_vis"),
        ("lsst_r", "vis", r"band: .*euclid_vis"),
        ("lsst_r", "lsstcm", r"camera: .*lsstcam"),
    ],
)
def test_an_unknown_band_or_camera_is_answered_with_a_known_one(band, camera, message):
    with pytest.raises(BadInput, match=message):
        nominal.find_instrument(band, camera, MISSION)


@pytest.mark.parametrize("camera", ["vis", "lsstcam", "decam"])
def test_no_detector_is_closer_to_the_axis(camera):
    middle = nominal.central_detector(camera, MISSION)
    distances = [np.hypot(d.x, d.y) for d in detectors.detectors(camera, MISSION)]
    assert np.hypot(middle.x, middle.y) == pytest.approx(min(distances), abs=1e-6)


def test_a_ground_exposure_is_at_its_smallest_airmass():
    row = nominal.nominal_exposure(("EXT", "lsstcam"), "lsst_r", PLACE, 1, MISSION)
    # Cerro Pachon is at 30 deg south.
    assert row.airmass == pytest.approx(1.0, abs=0.01)
    assert observatory.sun_altitude(np.array([row.mjd]), SITE)[0] < -15.0


def test_a_date_is_kept_or_refused():
    row = nominal.nominal_exposure(("VIS", "vis"), "euclid_vis", PLACE, 1, MISSION, 60905.0)
    assert row.mjd == 60905.0
    # Four months later Euclid would look too close to the Sun or away from it.
    with pytest.raises(BadInput, match=r"^date"):
        nominal.nominal_exposure(("VIS", "vis"), "euclid_vis", PLACE, 1, MISSION, 61035.0)


@pytest.mark.parametrize(
    ("instrument", "band"), [(("VIS", "vis"), "euclid_vis"), (("EXT", "lsstcam"), "lsst_r"), (("EXT", "hsc"), "hsc_z")]
)
def test_a_moved_exposure_has_the_place_in_the_middle_and_north_up(instrument, band):
    detector = nominal.central_detector(instrument[1], MISSION)
    row = nominal.nominal_exposure(instrument, band, PLACE, 1, MISSION)
    moved = nominal.move_exposure(row, detector, (53.3, -27.6))
    assert (moved.mjd, moved.sky, moved.exposure_time_s) == (row.mjd, row.sky, row.exposure_time_s)
    system = astrometry.wcs(detector, moved.ra, moved.dec, moved.position_angle)
    x, y = ((n - 1) / 2 for n in (detector.nx, detector.ny))
    ra, dec = astrometry.sky_of_pixel(system, [x, x, x + 20.0], [y, y + 20.0, y])
    assert (ra[0], dec[0]) == pytest.approx((53.3, -27.6), abs=1e-6)
    step = 20.0 * detector.pixel_scale / 3600.0
    assert dec[1] - dec[0] == pytest.approx(step, rel=0.02)
    assert (ra[0] - ra[2]) * np.cos(np.radians(dec[0])) == pytest.approx(step, rel=0.02)
