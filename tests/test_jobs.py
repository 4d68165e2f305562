"""Test submitted jobs: help, invalid requests, and equal bytes under any master."""

import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from lake_schema.store import layout, read
from tests import requests
from truesky.catalogue import (
    build_active_nuclei,
    build_gaia,
    build_galaxies,
    build_lensed_images,
    build_stars,
    build_strong_lenses,
    build_transients,
)
from truesky.commands import demo
from truesky.commands import run as whole
from truesky.emulator import build_observed, build_randoms
from truesky.fluxes import compute_fluxes
from truesky.light_curve_tables import build_light_curves
from truesky.render import plan_exposures, render_exposures
from truesky.request.from_toml import from_table
from truesky.running import submitted_job
from truesky.survey_maps import build_depth

ROOT = Path(__file__).parents[1]
FIRST = (build_galaxies.JOB, build_stars.JOB)
LATER = (
    compute_fluxes.JOB, build_active_nuclei.JOB, build_transients.JOB, build_strong_lenses.JOB, build_lensed_images.JOB,
    build_gaia.JOB, plan_exposures.JOB,
    build_depth.JOB, build_light_curves.JOB, render_exposures.JOB, build_randoms.JOB, build_observed.JOB,
)  # fmt: skip
JOBS = FIRST + LATER
# Four order-5 cells meet here, so that there is something to share out.
SMALL = requests.text(
    f'accuracy = "draft"\nfluxes.bands = ["euclid_vis"]\n{requests.shallow(21.0, 20.0)}',
    "cone = { ra = 53.4375, dec = -27.279613, radius = 0.01 }",
    seed=7,
)
BAD = [
    (requests.text("colour = 3"), "colour"),
    (requests.text(area="cone = {ra = 0, dec = 95, radius = 1}"), "area.cone.dec"),
    (requests.text(area="cone = {ra = 0, dec = 0, radius = -1}"), "area.cone.radius"),
    (requests.text(area="box = {ra = [0, 1], dec = [1, 0]}"), "area.box.dec"),
    (requests.text(area="cone = {ra = nan, dec = 0, radius = 1}"), "area.cone.ra"),
    (requests.text().replace("seed = 1", ""), "seed"),
]
POINTING = """
[[pointing]]
channel = "{channel}"
camera = "{camera}"
band = "{band}"
ra = 0
dec = 0
mjd = 60000
detectors = ["{detector}"]
"""
BAD_POINTINGS = [
    (("VIS", "vis", "lsst_r", "3-4"), "pointing[0].band"),
    (("VIS", "lsstcam", "euclid_vis", "3-4"), "pointing[0].camera"),
    (("EXT", "lsstcam", "euclid_vis", "R22_S11"), "pointing[0].band"),
    (("VIS", "vis", "euclid_vis", "7-7"), "7-7"),
]


def submit(*arguments):
    command = shutil.which("spark-submit", path=f"{Path(sys.executable).parent}") or "spark-submit"
    return subprocess.run([command, *map(str, arguments)], capture_output=True, text=True, cwd="/", timeout=300)


def test_all_jobs_are_tested_and_documented():
    """All jobs are in this list and in the table of docs/jobs.md."""
    found = set((ROOT / "jobs").rglob("*.py"))
    modules = {path.stem for path in (ROOT / "truesky").rglob("*.py") if "\nJOB = Job(" in path.read_text()}
    assert {path.stem for path in found} == modules
    assert all(len(path.read_text().splitlines()) < 15 for path in found)
    assert {path.stem for path in found} == {job.name for job in JOBS}
    table = (ROOT / "docs" / "jobs.md").read_text()
    assert [path for path in found if f"| `{path.relative_to(ROOT).as_posix()}` |" not in table] == []


@pytest.mark.parametrize(("text", "key"), BAD)
@pytest.mark.parametrize("job", JOBS, ids=lambda job: job.name)
def test_a_bad_request_ends_with_one_line_and_nothing_written(job, text, key, tmp_path, capsys):
    path = tmp_path / "bad.toml"
    path.write_text(text)
    lake = tmp_path / "lake"
    assert submitted_job.main(job, ["--lake", str(lake), "--request", str(path)]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert len(err.strip().splitlines()) == 1
    assert err.startswith(f"{job.name}: ")
    assert key in err
    assert not lake.exists()


@pytest.mark.parametrize("command", ["run", pytest.param("demo", marks=pytest.mark.nightly)])
@pytest.mark.parametrize(("words", "key"), BAD_POINTINGS)
def test_a_bad_pointing_is_refused_before_the_first_job_runs(words, key, command, tmp_path, capsys):
    names = ("channel", "camera", "band", "detector")
    path = requests.written(tmp_path, POINTING.format(**dict(zip(names, words, strict=True))))
    # The demo gives the request to `run` in a child process, which starts Java.
    if command == "demo":
        assert demo.main(["--request", str(path), "--out", str(tmp_path / "out")]) == 2
    else:
        assert whole.main([str(path), "--lake", str(tmp_path / "out" / "lake")], pytest.fail) == 2
    err = capsys.readouterr().err
    assert key in err
    assert len(err.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("job", LATER, ids=lambda job: job.name)
def test_missing_input_tables_are_named(job, tmp_path, capsys):
    path = tmp_path / "r.toml"
    path.write_text(SMALL)
    assert submitted_job.main(job, ["--lake", str(tmp_path / "lake"), "--request", str(path)]) == 2
    missing = {
        "compute_fluxes": "has no tables: run truesky run REQUEST",
        "build_active_nuclei": "universe.variables is false",
        "build_strong_lenses": "has no tables: run truesky run REQUEST",
        "build_lensed_images": "has no tables: run truesky run REQUEST",
        "build_transients": "has no transients: set universe.transients",
        "build_depth": "has no tables: run truesky run REQUEST",
        "build_light_curves": "it has no exposures for light curves",
        "build_gaia": "has no tables: run truesky run REQUEST",
        "plan_exposures": "it must have a pointing or an observation",
        "render_exposures": "has no tables: run truesky run REQUEST",
        "build_randoms": "has no table depth: run truesky depth REQUEST",
        "build_observed": "--model is required",
    }
    assert missing[job.name] in capsys.readouterr().err


@pytest.mark.spark
@pytest.mark.nightly
def test_the_same_request_gives_the_same_bytes_under_any_master(tmp_path):
    path = tmp_path / "r.toml"
    path.write_text(SMALL)
    # The three catalogue jobs in one session.
    script = tmp_path / "catalogues.py"
    script.write_text(f"""
import sys
sys.path[0] = {str(ROOT)!r}
from truesky.running import submitted_job
from truesky.catalogue import build_galaxies, build_stars
from truesky.fluxes import compute_fluxes
from truesky.light_curve_tables import build_light_curves
sys.exit(max(submitted_job.main(m.JOB, sys.argv[1:]) for m in (build_galaxies, build_stars, compute_fluxes)))
""")
    manifests = []
    for master in ("local[1]", "local[2,4]"):
        lake = tmp_path / master
        done = submit("--master", master, script, "--lake", lake, "--request", path)
        assert done.returncode == 0, done.stderr
        root = layout.resolve_lake(lake)
        versions = {name: read.version(root, name) for name in ("galaxies", "stars", "galaxy_fluxes", "star_fluxes")}
        assert len(versions["galaxies"].partitions) == 4
        assert versions["galaxies"].num_rows > 100
        assert all(read.find_faults(version, deep=True) == [] for version in versions.values())
        manifests.append({name: (v.folder / "manifest.json").read_bytes() for name, v in versions.items()})
    assert manifests[0] == manifests[1]


# Daily tests of spark-submit with other scripts are in tests/house/test_environment.py.
@pytest.mark.spark
@pytest.mark.nightly
def test_spark_submit_returns_message_and_status(tmp_path):
    path = tmp_path / "bad.toml"
    path.write_text(BAD[1][0])
    script = ROOT / "jobs" / "catalogue" / "build_galaxies.py"
    done = submit(script, "--lake", tmp_path / "lake", "--request", path)
    assert done.returncode == 2
    (line,) = done.stderr.strip().splitlines()
    assert line.startswith(f"build_galaxies: request {path} line 3: area.cone.dec = 95 is outside [-90.0, 90.0]")
    assert not (tmp_path / "lake").exists()


def test_a_generation_cell_is_the_same_in_every_request(tmp_path):
    """The bytes of the rows of a cell do not depend on the rest of the request."""
    wanted = from_table(tomllib.loads(SMALL))
    for module in (build_galaxies, build_stars):
        for step in module.steps(tmp_path, wanted):
            if step.on_driver:
                # Taken from the tables of the others.
                continue
            facts = step.plan.facts
            alone = step.run_task(tmp_path, {**facts, "generation_cells": [574971]}).rows
            among = step.run_task(tmp_path, {**facts, "generation_cells": [574970, 574971]}).rows
            ids = set(alone["id"].to_pylist())
            assert len(ids) > 10
            assert among.filter([i in ids for i in among["id"].to_pylist()]).equals(alone)
