"""Exposures without a simulator are planned and skipped; a request with only such exposures is refused."""

import re
from dataclasses import replace
from pathlib import Path

import pytest

from lake_schema.errors import BadInput
from lake_schema.mission.configuration import resolve
from lake_schema.tables.exposures import EUCLID_BANDS, RENDERED_TYPES
from tests import requests
from truesky.catalogue import build_galaxies, build_stars
from truesky.commands import check, plan
from truesky.render.channels import registry
from truesky.render.planning.planned_exposures import bands_of
from truesky.request import checks
from truesky.request.exposures import observations
from truesky.request.from_toml import parse
from truesky.running import submitted_job

REQUESTS = Path(__file__).resolve().parents[3] / "requests"
# Euclid's three channels, and calibrations of NISP.
SURVEY = REQUESTS / "sc8_pilot.toml"


def test_rendered_types_have_effects():
    assert {name: set(kinds) for name, kinds in RENDERED_TYPES.items()} == {
        name: set(channel.effects) for name, channel in registry.CHANNELS.items()
    }


# The half a million detectors of the main run take a minute, and those of the other surveys seconds.
SURVEYS = ("pilot_one_observation", "sc8_deep", "sc8_main", "sc8_pilot")
SHIPPED = [
    pytest.param(path, marks=[pytest.mark.nightly] if path.stem in SURVEYS else [], id=path.stem)
    for path in sorted(REQUESTS.glob("*.toml"))
]


@pytest.mark.parametrize("channel", observations.CHANNELS)
def test_rendered_types_are_allowed_in_requests(channel):
    asked = {*observations._SKY_TYPES, *observations._CALIBRATIONS[channel]}
    assert set(RENDERED_TYPES.get(channel, ())) <= asked <= set(observations.IMAGE_TYPES)


def test_bands_of_requests_and_planner_agree():
    cameras = {"VIS": "vis", "NISP-P": "nisp", "NISP-S": "nisp"}
    assert {name: bands_of(name, camera, resolve()) for name, camera in cameras.items()} == EUCLID_BANDS


@pytest.mark.parametrize("path", SHIPPED)
def test_the_check_takes_every_request(path, capsys):
    assert check.main([str(path)]) == 0
    said = capsys.readouterr()
    assert said.err == ""
    good, *_, last = said.out.splitlines()
    assert good.startswith(f"{path.stem}: good: ")
    assert last.startswith("times are for ")


def only(channels, kind):
    """Return a request for one block."""
    request = parse(SURVEY)
    return replace(request, observations=(replace(request.observations[0], channels=channels, image_type=kind),))


@pytest.mark.parametrize(
    ("channels", "kind", "first"),
    [(("EXT",), "self_calibration", "EXT"), (("VIS",), "standard_star", "VIS")],
)
def test_a_request_without_any_rendered_type_is_refused(channels, kind, first, tmp_path):
    wanted = f"^observation\\[0\\].channels: no simulator renders {first} {kind} yet: it can only be planned$"
    for refuse in (
        checks.check_rendered,
        plan.check,
        lambda request: plan.dry_run(tmp_path, request),
        lambda request: build_galaxies.JOB.steps(tmp_path, request),
        lambda request: build_stars.JOB.steps(tmp_path, request),
    ):
        with pytest.raises(BadInput, match=wanted):
            refuse(only(channels, kind))
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("channels", "kind", "said"),
    [(("EXT",), "science", ""), (("VIS", "EXT"), "self_calibration", "EXT"), (("VIS",), "bias", ""), ((), "", "")],
)
def test_a_partly_rendered_request_is_refused_and_skipped_types_are_named(channels, kind, said):
    request = only(channels, kind)
    if said:
        with pytest.raises(BadInput, match=f"no simulator renders {said} {kind}"):
            checks.check_rendered(request)
    else:
        checks.check_rendered(request)
    assert checks.describe_skipped(request).startswith(said)
    assert bool(checks.describe_skipped(request)) == bool(said)


def stars_by_decam(folder):
    """Return a block from a table of pointings that can only be planned."""
    (folder / "p.csv").write_text("ra,dec,mjd,band,image_type\n53.1,-27.8,60905.0,des_r,standard_star\n")
    return '[[observation]]\nchannels = ["EXT"]\nsurvey = "des"\npointings = "p.csv"\n'


def test_the_command_refuses_in_one_line_and_plans_on_demand(tmp_path, capsys):
    # Also if other exposures of the request can be rendered.
    path = requests.written(tmp_path, '[[observation]]\nchannels = ["VIS"]\nfields = 1\n' + stars_by_decam(tmp_path))
    assert check.main([str(path)]) == 2
    said = capsys.readouterr().err
    text = r"truesky check: .*observation\[1\]\.pointings: no simulator renders EXT standard_star yet: .*\n"
    assert re.fullmatch(text, said)
    assert check.main([str(path), "--plan"]) == 0
    assert "EXT standard_star: planned and forecast, skipped by rendering" in capsys.readouterr().out


def test_every_job_lists_types_that_are_only_planned(tmp_path, capsys):
    path = requests.written(tmp_path, '[[observation]]\nchannels = ["VIS"]\n' + stars_by_decam(tmp_path))
    job = submitted_job.Job("sleep", "", lambda lake, request: [])
    assert submitted_job.main(job, ["--lake", str(tmp_path / "lake"), "--request", str(path)]) == 0
    assert capsys.readouterr().err == (
        "sleep: EXT standard_star: planned and forecast, skipped by rendering (no simulator yet)\n"
    )


def test_keys_without_effect_beside_given_sources_are_listed():
    universe = {"galaxy_limit": 25.0, "star_limit": 20.0, "lensing": "none"}
    assert list(checks.unused_values({"universe": universe})) == []
    assert list(checks.unused_values({"universe": universe, "sources": {"only": "table"}})) == [
        f"universe.{key} has no effect: the tables in [sources] contain all sources"
        for key in ("galaxy_limit", "star_limit")
    ]
