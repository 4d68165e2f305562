"""Plans: pointings become exposures and tasks that miss nothing."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jobs.render import focal_plane, survey
from jobs.request import Pointing
from lake_schema import sky, validate
from lake_schema.errors import BadInput
from lake_schema.mission.configuration import resolve
from lake_schema.tables.exposures import EXPOSURES
from lake_schema.tables.tasks import TASKS

MISSION = resolve()
VIS = Pointing("VIS", "vis", "euclid_vis", 53.117, -27.808, 0.0, 60950.0, ("3-4",), "3-4")
LSST = Pointing("EXT", "lsstcam", "lsst_r", 53.117, -27.808, 0.0, 60950.25, ("R22_S11",), "R22_S11")


def test_the_demo_s_two_detectors_look_at_the_same_place():
    exposures, tasks = survey.plan((VIS, LSST), MISSION)
    assert validate.violations(exposures, EXPOSURES) == []
    assert validate.violations(tasks, TASKS) == []
    for task in tasks.to_pylist():
        assert float(sky.separation(task["ra"], task["dec"], 53.117, -27.808)) < 1e-9
    assert exposures["exposure_id"].to_pylist() == [1, 2]
    assert exposures["exposure_time_s"].to_pylist() == [560.53, 30.0]
    assert exposures["seeing"].to_pylist() == pytest.approx([0.0, 0.73])
    assert exposures["sky"].to_pylist()[1] == 32.95
    # The larger field has more sources, takes longer, and comes first.
    assert tasks["detector"].to_pylist() == ["R22_S11", "3-4"]
    assert (np.diff(tasks["seconds"].to_numpy()) < 0).all()
    assert tasks["bytes"].to_pylist()[1] == 4096 * 4132 * 6


def test_all_detectors_where_none_is_named():
    everything = Pointing("VIS", "vis", "euclid_vis", 10.0, 20.0, 30.0, 60950.0)
    exposures, tasks = survey.plan((everything,), MISSION)
    assert len(tasks) == 36
    assert exposures["ra"][0].as_py() == 10.0
    assert exposures["position_angle"][0].as_py() == 30.0


@given(st.floats(0, 360, exclude_max=True), st.floats(-90, 90), st.floats(-360, 360))
def test_cells_hold_everything_that_a_detector_sees(ra, dec, angle):
    pointing = Pointing("VIS", "vis", "euclid_vis", ra, dec, angle, 60950.0, ("1-6",))
    exposures, tasks = survey.plan((pointing,), MISSION)
    assert validate.violations(exposures, EXPOSURES) == []
    (exposed,), (task,) = exposures.to_pylist(), tasks.to_pylist()
    detector = focal_plane.detector("vis", "1-6", MISSION)
    system = focal_plane.wcs(detector, *(exposed[k] for k in ("ra", "dec", "position_angle")))
    rng = np.random.default_rng(1)
    # The margin of a minute of arc, on either axis of the frame.
    margin = 400
    x, y = rng.uniform(-margin, detector.nx + margin, 200), rng.uniform(-margin, detector.ny + margin, 200)
    seen = focal_plane.sky_of_pixel(system, x, y)
    assert (sky.separation(task["ra"], task["dec"], *seen) <= task["radius"]).all()
    cells = sky.cell_of(*seen, 8)
    assert set(cells) <= set(task["cells"])


def test_a_deflection_widens_the_circle():
    (plain,), (wide,) = (survey.plan((VIS,), MISSION, d)[1]["radius"].to_pylist() for d in (0.0, 0.1))
    assert wide == pytest.approx(plain + 0.1)


def test_an_exposure_time_of_the_request_s_own():
    exposures, _ = survey.plan((Pointing(*VIS_FIELDS, exposure_time_s=89.52),), MISSION)
    assert exposures["exposure_time_s"][0].as_py() == 89.52


VIS_FIELDS = ("VIS", "vis", "euclid_vis", 53.117, -27.808, 0.0, 60950.0, ("3-4",), "3-4")


@pytest.mark.parametrize(
    ("change", "word"),
    [
        ({"channel": "EXT"}, "vis"),
        ({"camera": "hsc"}, "hsc"),
        ({"detectors": ("9-9",)}, "9-9"),
        ({"centre_on": "9-9"}, "9-9"),
        ({"band": "euclid"}, "euclid"),
    ],
)
def test_bad_pointings_are_refused(change, word):
    names = ("channel", "camera", "band", "ra", "dec", "position_angle", "mjd", "detectors", "centre_on")
    wanted = dict(zip(names, VIS_FIELDS, strict=True)) | change
    with pytest.raises(BadInput, match=word):
        survey.plan((Pointing(**wanted),), MISSION)


def test_no_pointing_no_rows():
    exposures, tasks = survey.plan((), MISSION)
    assert len(exposures) == len(tasks) == 0
