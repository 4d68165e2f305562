"""Exposures in a user passband, which only VIS can observe in."""

import numpy as np
import pytest

from lake_schema import units
from lake_schema.errors import BadInput
from lake_schema.store import publish, read
from tests import requests
from truesky.catalogue import build_galaxies, build_stars
from truesky.fluxes import compute_fluxes, inputs, passbands
from truesky.render import plan_exposures, render_exposures
from truesky.render.planning import mission, planned_exposures
from truesky.request import schema
from truesky.request.from_toml import parse

MISSION = mission.mission_of(schema.MissionChoice())
WAVELENGTH = np.arange(5000.0, 9501.0, 10.0)
# A synthetic filter within the band of VIS.
RESPONSE = 0.5 * np.exp(-0.5 * ((WAVELENGTH - 6500.0) / 400.0) ** 2)
OWN = f"""
accuracy = "draft"
{requests.shallow(20.0, 18.0)}
[fluxes.passbands.mine]
file = "mine.dat"
format = "passband_ascii"
medium = "vacuum"
"""
POINTING = """
channel = "VIS"
band = "mine"
ra = 53.117
dec = -27.808
mjd = 60905.0
detectors = ["3-4"]
centre_on = "3-4"
"""
GROUND = POINTING.replace('"VIS"', '"EXT"\ncamera = "lsstcam"').replace("3-4", "R22_S11")
NISP = 'channel = "NISP-P"\nband = "mine"\nra = 53.1\ndec = -27.8\nmjd = 60905.0'
SURVEY = 'channels = ["EXT"]\nsurvey = "lsst"\nbands = ["lsst_r", "mine"]'


def asked(folder, keys=POINTING, block="pointing", response=RESPONSE):
    np.savetxt(folder / "mine.dat", np.stack([WAVELENGTH, response], 1))
    return parse(requests.written(folder, f"{OWN}[[{block}]]\n{keys}\n", requests.FIELD.format(0.3), seed=5))


def test_zero_point_and_sky_of_a_user_band(lake, tmp_path):
    _, exposures, rows = plan_exposures.plan(lake, asked(tmp_path))
    (row,) = exposures.to_pylist()
    assert (row["band"], rows["detector"].to_pylist()) == ("mine", ["3-4"])
    width = np.trapezoid(RESPONSE / WAVELENGTH, WAVELENGTH)
    assert row["zero_point"] == pytest.approx(units.zero_point(9926.0, width), abs=1e-3)
    wide = planned_exposures.zero_point_of("vis", "euclid_vis", MISSION)
    assert row["zero_point"] < wide
    # The sky is redder than the filter, fainter than in the whole VIS band, and brighter than only the scattered light.
    scattered = MISSION.value("vis.scattered_light", "electron / (s pix)") * 10 ** (0.4 * (row["zero_point"] - wide))
    assert scattered < row["sky"] < 0.5 * 0.24


def test_the_plan_depends_on_the_content_of_the_file(lake, tmp_path):
    keys = [
        plan_exposures.steps(lake, asked(tmp_path, response=scale * RESPONSE))[1].plan.key for scale in (1.0, 1.0, 0.9)
    ]
    assert keys[0] == keys[1] != keys[2]


@pytest.mark.parametrize(
    ("block", "keys", "words"),
    [
        (
            "pointing",
            GROUND,
            r"pointing\[0\]\.band: mine is a user passband, for which camera lsstcam has no",
        ),
        ("pointing", NISP, r"pointing\[0\]\.band: mine is a user passband, for which camera nisp has no"),
        ("observation", SURVEY, r"observation\[0\]\.bands: mine is a user passband: no survey observes in it"),
    ],
)
def test_only_vis_observes_in_a_user_band(tmp_path, block, keys, words):
    with pytest.raises(BadInput, match=words):
        asked(tmp_path, keys, block)


def test_a_response_above_1_is_refused(lake, tmp_path):
    with pytest.raises(BadInput, match=r"fluxes\.passbands\.mine: response must be the fraction of photons detected"):
        plan_exposures.plan(lake, asked(tmp_path, response=100.0 * RESPONSE))


@pytest.mark.nightly
def test_from_the_request_to_its_image(lake, tmp_path):
    wanted = asked(tmp_path)
    for steps in (build_galaxies.steps, build_stars.steps, compute_fluxes.steps, plan_exposures.steps):
        for step in steps(lake, wanted):
            publish.make_version(lake, step.plan, step.run_task)
    own = inputs.read(wanted.curves).passbands["mine"]
    facts = read.version(lake, "galaxy_fluxes").manifest["facts"]
    found = inputs.passband_from_facts(lake, facts, "mine")
    np.testing.assert_array_equal(found.response, own.response)
    assert inputs.passband_from_facts(lake, facts, "euclid_vis").name == passbands.load("euclid_vis").name
    for step in render_exposures.steps(lake, wanted):
        publish.make_version(lake, step.plan, step.run_task)
    rows = read.version(lake, "products").rows().to_pylist()
    assert {row["band"] for row in rows} == {"mine"}
    # A filter that differs from that of the fluxes is an error.
    changed = asked(tmp_path, response=0.9 * RESPONSE)
    for step in plan_exposures.steps(lake, changed):
        publish.make_version(lake, step.plan, step.run_task)
    with pytest.raises(BadInput, match=r"galaxy_fluxes was computed with another fluxes\.passbands\.mine"):
        render_exposures.steps(lake, changed)
