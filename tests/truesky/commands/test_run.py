"""A whole run: the jobs of a request, errors before the first job, and the output at the end."""

import re
from collections import namedtuple
from dataclasses import replace
from pathlib import Path

import pytest

from lake_schema.errors import BadInput
from lake_schema.store import layout
from tests import requests
from truesky.commands import plan, run, space
from truesky.numerics import cache
from truesky.render import plan_exposures
from truesky.request.from_toml import parse

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
    assert run.main([str(DEMO), "--lake", str(lake), *words], pytest.fail) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("truesky: ")
    assert said in line
    assert not lake.exists()


def test_a_full_disc_is_refused_before_the_first_job(tmp_path, capsys, monkeypatch):
    asked = []
    monkeypatch.setattr(space.shutil, "disk_usage", lambda path: asked.append(path) or Disc(1e12, 1e12 - 4e8, 4e8))
    lake, words = tmp_path / "not" / "there", ["--pictures", str(tmp_path / "pictures")]
    assert run.main([str(DEMO), "--lake", str(lake), *words], pytest.fail) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "0.40 GB are free, the forecast is 0." in line
    assert asked == [tmp_path]
    # A single detector of LSSTCam fits on the disc.
    assert run.main([str(DEMO), "--lake", str(lake), "--detectors", "R22_S11"], lambda *job: 5) == 5


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
    with pytest.raises(BadInput, match=r"0\.20 GB are free"):
        space.check(lake, request, plan_exposures.plan(lake, request)[1:])


@pytest.mark.parametrize("compiled", [False, True])
def test_a_run_ends_with_the_first_job_that_fails(tmp_path, capsys, monkeypatch, compiled):
    started, planned = [], plan.check
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "code"))

    def compiling(*known):
        """Store compiled code of the renderer before planning, as if an earlier part of planning had compiled it.

        Code that planning compiles must not suppress the warning about compilation.
        """
        (folder := cache.machine_code_dir() / "render.drawing.kernels").mkdir(parents=True, exist_ok=True)
        (folder / "some.nbi").touch()
        return planned(*known)

    if compiled:
        compiling(parse(DEMO), layout.resolve_lake(tmp_path / "lake"))
    monkeypatch.setattr(plan, "check", compiling)

    def start(module, arguments):
        started.append((module.rpartition(".")[2], *arguments))
        return 3 * (len(started) == 2)

    root = layout.resolve_lake(tmp_path / "lake")
    assert run.main([str(DEMO), "--lake", str(root)], start) == 3
    told = ("--lake", str(root), "--request", str(DEMO))
    assert started == [("build_galaxies", *told), ("build_stars", *told)]
    first, *others = capsys.readouterr().out.splitlines()
    # The first line is the forecast.
    assert re.fullmatch(
        r"forecast: 2 detectors, 0\.\d\d core-hours of this machine \(.*\), 0\.\d\d h on 2 cores; 0\.\d\d GB to write, "
        r"[\d.]+ GB are free",
        first,
    )
    # The second line warns that the first run takes longer, because code is compiled.
    if not compiled:
        assert "not been compiled" in others.pop(0)
    assert others == ["", "build_galaxies ...", "build_stars ..."]


def test_mistakes_for_later_jobs_are_refused_first(tmp_path, capsys):
    """An area that does not contain the detectors would be found only by the last job."""
    path = tmp_path / "small.toml"
    path.write_text(DEMO.read_text().replace("radius = 0.2", "radius = 0.001"))
    assert run.main([str(path), "--lake", str(tmp_path / "lake")], pytest.fail) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "area" in line
