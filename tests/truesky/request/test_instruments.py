"""The names that a request may have are those of the renderer's cameras, bands and detectors."""

import pytest

from lake_schema.errors import BadInput
from lake_schema.mission.configuration import resolve
from truesky.render.camera import detectors
from truesky.render.planning.planned_exposures import bands_of
from truesky.request import instruments
from truesky.request.exposures import observations
from truesky.request.from_toml import from_table

MISSION = resolve()
CAMERAS = [(channel, name) for channel in observations.CHANNELS for name in instruments.camera_names(channel, MISSION)]
AREA = {"cone": {"ra": 53.1, "dec": -27.8, "radius": 1.0}}


@pytest.mark.parametrize(("channel", "camera"), CAMERAS)
def test_names_are_those_of_the_renderer(channel, camera):
    assert instruments.band_names(channel, camera, MISSION) == bands_of(channel, camera, MISSION)
    names = [detector.name for detector in detectors.detectors(camera, MISSION)]
    instruments.check_detectors((camera,), names, MISSION, "x")
    with pytest.raises(BadInput, match=r"x: camera .* has no detector 'CCD_77'"):
        instruments.check_detectors((camera,), ["CCD_77"], MISSION, "x")


@pytest.mark.parametrize(("channel", "camera"), CAMERAS)
def test_a_pointing_has_a_band_by_default(channel, camera):
    pointing = {"channel": channel, "camera": camera, "ra": 53.1, "dec": -27.8}
    (parsed,) = from_table({"name": "x", "seed": 1, "area": AREA, "pointing": [pointing]}).pointings
    assert parsed.band in instruments.band_names(channel, camera, MISSION)
    assert parsed.mjd is None


@pytest.mark.parametrize(
    ("channel", "camera", "band"),
    [
        ("VIS", "vis", "euclid_vis"), ("NISP-P", "nisp", "euclid_h"), ("NISP-S", "nisp", "nisp_red"),
        ("EXT", "lsstcam", "lsst_r"), ("EXT", "decam", "des_r"),
    ],
)  # fmt: skip
def test_default_bands(channel, camera, band):
    assert instruments.default_band(channel, camera, MISSION) == band


def test_a_ground_pointing_requires_a_camera():
    pointing = {"channel": "EXT", "ra": 53.1, "dec": -27.8}
    with pytest.raises(BadInput, match=r"pointing\[0\]\.camera is missing: channel EXT requires one of decam, "):
        from_table({"name": "x", "seed": 1, "area": AREA, "pointing": [pointing]})


def test_a_detector_may_belong_to_any_of_several_cameras():
    instruments.check_detectors(("vis", "nisp"), ["3-4", "DET11"], MISSION, "x")
    with pytest.raises(BadInput, match=r"x: cameras vis and nisp have no detector 'DET15': did you mean DET"):
        instruments.check_detectors(("vis", "nisp"), ["3-4", "DET15"], MISSION, "x")
    assert instruments.detectors_of_camera("nisp", ["3-4", "DET11"], MISSION) == ("DET11",)
    assert instruments.detectors_of_camera("vis", ["DET11"], MISSION) == ()
