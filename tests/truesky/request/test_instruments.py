"""The names that a request may have are those of the renderer's cameras, bands and detectors."""

import pytest

from lake_schema.errors import BadInput
from lake_schema.mission.configuration import resolve
from lake_schema.tables.exposures import GRISM_NAMES
from truesky.render.camera import detectors, traces
from truesky.render.planning.planned_exposures import GRISMS, bands_of
from truesky.request import instruments, sky_notation
from truesky.request.exposures import observations, pointing_tables
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


def spectrum(**keys):
    pointing = {"channel": "NISP-S", "ra": 53.1, "dec": -27.8, **keys}
    (parsed,) = from_table({"name": "x", "seed": 1, "area": AREA, "pointing": [pointing]}).pointings
    return parsed.band, parsed.grism_angle


def test_names_of_grisms_are_those_of_the_renderer():
    assert {(band, grism) for band, grisms in GRISMS.items() for grism in grisms} == {
        (band, grism) for grism, (band, _) in GRISM_NAMES.items()
    }
    for grism, (_, direction) in GRISM_NAMES.items():
        assert direction == traces.direction(grism, "nisp", MISSION)


def test_a_grism_may_stand_for_its_band(tmp_path):
    # Names and directions of the grisms: Gillard et al. 2025, NISP grisms. Serrano et al. 2024: -4 and 184 deg.
    assert spectrum(band="RGS000") == ("nisp_red", 0.0)
    assert spectrum(band="RGS180") == ("nisp_red", 180.0)
    assert spectrum(band="BGS000") == ("nisp_blue", 0.0)
    assert spectrum(band="RGS000", grism_angle=-4.0) == ("nisp_red", -4.0)
    assert spectrum(band="RGS180", grism_angle=184.0) == ("nisp_red", 184.0)
    assert spectrum(band="nisp_red") == ("nisp_red", None)
    (tmp_path / "table.csv").write_text("ra,dec,band,grism_angle\n53,-27,RGS180,\n53,-27,RGS180,184\n53,-27,BGS000,\n")
    rows = pointing_tables.read(tmp_path / "table.csv", ["NISP-S"], "science")
    assert [(row.band, row.grism_angle) for row in rows] == [
        ("nisp_red", 180.0), ("nisp_red", 184.0), ("nisp_blue", 0.0),
    ]  # fmt: skip
    block = {"channels": ["NISP-S"], "fields": 1, "blue": True, "bands": ["RGS000", "RGS180", "BGS000"]}
    (parsed,) = from_table({"name": "x", "seed": 1, "area": AREA, "observation": [block]}).observations
    assert parsed.bands == ("nisp_red", "nisp_blue")


def test_the_meaning_of_a_grism_is_told():
    table = {"pointing": [{"band": "RGS180"}, {"band": "nisp_red"}], "observation": [{"bands": ["BGS000"]}]}
    assert list(sky_notation.understood_values(table)) == [
        "pointing[0].band = RGS180 is nisp_red with grism_angle = 180, unless grism_angle is given",
        "observation[0].bands[0] = BGS000 is nisp_blue; the survey sets the angles of the spectra",
    ]


def test_wrong_grisms_are_refused(tmp_path):
    with pytest.raises(BadInput, match=r"^pointing\[0\].grism_angle = 184 deg tilts RGS000 by 176 deg, more than 45$"):
        spectrum(band="RGS000", grism_angle=184.0)
    with pytest.raises(BadInput, match=r"^pointing\[0\].band: Euclid does not observe with grism RGS270: use RGS000, "):
        spectrum(band="RGS270")
    with pytest.raises(
        BadInput, match=r"^pointing\[0\].band: camera vis has no band 'nisp_red': nisp_red is a band of"
    ):
        spectrum(channel="VIS", band="RGS000")
    (tmp_path / "table.csv").write_text("ra,dec,band,grism_angle\n53,-27,BGS000,180\n")
    with pytest.raises(
        BadInput, match=r"table.csv line 2: grism_angle = 180 deg tilts BGS000 by 180 deg, more than 45"
    ):
        pointing_tables.read(tmp_path / "table.csv", ["NISP-S"], "science")
