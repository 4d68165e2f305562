"""Observatories: every camera has one."""

import pytest

from lake_schema.mission.parameter import CAMERAS
from truesky.render.camera import observatories, tpv


@pytest.mark.parametrize("camera", ["vis", "nisp", *CAMERAS])
def test_every_camera_has_one(camera):
    found = observatories.for_camera(camera)
    assert found.telescope
    assert found.convention in tpv.CONVENTIONS
    assert found.time_scale == ("TAI" if camera == "lsstcam" else "UTC")


def test_another_camera_has_its_name():
    assert observatories.for_camera("own") == observatories.Observatory("", "own", "sip")
