"""Observatories: every camera has one, and looks through as much air as it should."""

import pytest

from jobs.render.camera import observatories, tpv
from jobs.render.camera.observatories import airmass
from lake_schema.mission.parameter import CAMERAS


@pytest.mark.parametrize("camera", ["vis", "nisp", *CAMERAS])
def test_every_camera_has_one(camera):
    found = observatories.of(camera)
    assert found.telescope
    assert found.convention in tpv.CONVENTIONS
    assert (found.latitude is None) == (camera in ("vis", "nisp"))
    assert found.time_scale == ("TAI" if camera == "lsstcam" else "UTC")


def test_air():
    there = observatories.of("lsstcam")
    assert airmass(there, there.latitude) == 1.0
    assert airmass(there, there.latitude + 60.0) == pytest.approx(2.0)
    assert airmass(there, there.latitude - 60.0) == pytest.approx(2.0)
    # Polaris does not rise there.
    assert airmass(there, 89.0) is None
    assert airmass(observatories.of("vis"), 0.0) is None


def test_another_camera_has_its_name():
    assert observatories.of("own") == observatories.Observatory("", "own", "sip")
