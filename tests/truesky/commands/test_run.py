"""A whole run: the jobs of a request, errors before the first job, and the output at the end."""

import re
from collections import namedtuple
from dataclasses import replace
from pathlib import Path

import pytest

from lake_schema.errors import BadInput
from lake_schema.store import layout
from tests import requests
from truesky.commands import run, space
from truesky.numerics import activity
from truesky.render import plan_exposures
from truesky.request.from_toml import parse
from truesky.running import compile_ahead, progress

DEMO = Path(__file__).resolve().parents[3] / "requests" / "demo.toml"
Disc = namedtuple("Disc", "total used free")


def names(stages):
    return [stage.name for stage in stages]


def test_the_jobs_of_a_request(tmp_path):
    images, catalogues = parse(DEMO), parse(requests.written(tmp_path))
    drawn = ["build_galaxies", "build_stars", "compute_fluxes"]
    assert names(run.stages(catalogues)) == drawn
    assert names(run.stages(images)) == [*drawn, "plan_exposures", "render_exposures"]
    wanted = run.stages(replace(images, detectors=("3-4",), limit=2), lenses=True, with_gaia=True)
    assert names(wanted)[2:5] == ["build_strong_lenses", "compute_fluxes", "build_gaia"]
    told = {stage.name: stage.options for stage in wanted}
    assert told["compute_fluxes"] == ("--bands", *images.bands, "gaia_g", "gaia_bp", "gaia_rp")
    assert told["render_exposures"] == ("--detectors", "3-4", "--limit", "2")
    assert told["plan_exposures"] == ()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--detectors", "3-4", "9-9"], "detectors: 9-9 is not in the plan of request demo, which has 3-4"),
        (["--limit", "0"], "limit = 0"),
        (["--pictures", str(DEMO)], "demo.toml"),
    ],
)
def test_invalid_runs_are_refused_before_the_first_job(tmp_path, capsys, words, said):
    lake = tmp_path / "lake"
    assert run.main([str(DEMO), str(lake), *words], pytest.fail) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("truesky run: ")
    assert said in line
    assert not lake.exists()


def test_a_full_disc_is_refused_before_the_first_job(tmp_path, capsys, monkeypatch):
    asked = []
    monkeypatch.setattr(space.shutil, "disk_usage", lambda path: asked.append(path) or Disc(1e12, 1e12 - 4e8, 4e8))
    lake, words = tmp_path / "not" / "there", ["--pictures", str(tmp_path / "pictures")]
    assert run.main([str(DEMO), str(lake), *words], pytest.fail) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "400 MB are free, the forecast is " in line
    assert asked == [tmp_path]
    # A single detector of LSSTCam fits on the disc.
    assert run.main([str(DEMO), str(lake), "--detectors", "R22_S11"], lambda *job: 5) == 5


def test_tables_of_another_request_with_this_name_are_not_reused(lake, monkeypatch):
    """Tables with the name of the request but from other settings do not reduce the forecast."""
    request, free = parse(DEMO), 2e8
    monkeypatch.setattr(space.shutil, "disk_usage", lambda path: Disc(1e12, 1e12 - free, free))
    folder = layout.stage_folder(lake, "products", "c" * 16)
    folder.mkdir(parents=True)
    with (folder / "x").open("wb") as stream:
        stream.truncate(int(3e8))
    (runs := layout.runs_folder(lake)).mkdir(exist_ok=True)
    (runs / "1.jsonl").write_text(f'{{"request": "demo", "table": "products", "key": "{"c" * 16}"}}\n')
    with pytest.raises(BadInput, match="200 MB are free"):
        space.check(lake, request, plan_exposures.plan(lake, request)[1:])


@pytest.mark.parametrize("compiled", [False, True])
def test_a_run_ends_with_the_first_job_that_fails(tmp_path, capsys, monkeypatch, compiled):
    started, state = [], []
    missing = [] if compiled else ["truesky.catalogue.halos.projected_nfw:total"]
    monkeypatch.setattr(compile_ahead, "missing_functions", lambda groups: missing)
    monkeypatch.setenv(activity.SETTING, str(tmp_path))

    def start(module, arguments):
        started.append((module.rpartition(".")[2], *arguments))
        state.append(progress.read_state(tmp_path))
        return 3 * (len(started) == 2)

    root = layout.resolve_lake(tmp_path / "lake")
    assert run.main([str(DEMO), str(root)], start) == 3
    told = ("--lake", str(root), "--request", str(DEMO))
    assert started == [("build_galaxies", *told), ("build_stars", *told)]
    first, *others = capsys.readouterr().out.splitlines()
    if not compiled:
        assert first == "functions to compile in the background, once on this machine: 1"
        first = others.pop(0)
    assert first.startswith("cost of this request")
    *_, free, empty, one, two = others
    assert re.fullmatch(r"\d+ MB to write, .* are free", free)
    assert [empty, one, two] == ["", "build_galaxies ...", "build_stars ..."]
    # The display gets a forecast time of each job, and knows which job runs.
    assert [entry.job for entry in state] == ["build_galaxies", "build_stars"]
    times = dict(state[0].jobs)
    assert list(times) == names(run.stages(parse(DEMO)))
    assert times["build_galaxies"] > times["build_stars"] > times["plan_exposures"] > 0.0
    assert times["render_exposures"] > 1.0


def test_a_dry_run_prints_the_forecast_and_writes_nothing(tmp_path, capsys):
    assert run.main([str(DEMO), str(tmp_path / "lake"), "--dry-run"], pytest.fail) == 0
    assert capsys.readouterr().out.startswith("cost of this request")
    assert not (tmp_path / "lake").exists()


def test_mistakes_for_later_jobs_are_refused_first(tmp_path, capsys):
    """An area that does not contain the detectors would be found only by the last job."""
    path = tmp_path / "small.toml"
    path.write_text(DEMO.read_text().replace("radius = 0.2", "radius = 0.001"))
    assert run.main([str(path), str(tmp_path / "lake")], pytest.fail) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "area" in line
