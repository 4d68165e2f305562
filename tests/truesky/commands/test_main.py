"""The command `truesky`: its jobs and modules, the arguments that it passes on, and its errors."""

import os
import re
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

from lake_schema import __version__
from tests import requests
from truesky.commands import __main__ as truesky
from truesky.commands import submit
from truesky.running import submitted_job

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture
def called(monkeypatch):
    """Arguments that spark-submit would get; every job except the second succeeds."""
    calls = []

    def call(command):
        calls.append(command[1:])
        return 7 * (len(calls) == 2)

    monkeypatch.setattr(submit, "_run_program", call)
    monkeypatch.setattr(submit, "_spark_environment", lambda: Path("/environment"))
    return calls


def test_every_job_has_a_command():
    scripts = [path.read_text(encoding="utf-8") for path in ROOT.glob("jobs/*/*.py")]
    modules = {re.search(r"^from (\S+) import JOB$", script, re.MULTILINE)[1] for script in scripts}
    assert {module for modules in truesky.JOBS.values() for module in modules} == modules
    assert all(callable(import_module(module).main) for module, _ in truesky.MODULES.values())
    assert all(f" {word} " in f"{truesky.__doc__} " for word in (*truesky.JOBS, *truesky.MODULES))


@pytest.mark.parametrize("word", ["--help", "--version"])
def test_a_reader_of_the_help_may_close_the_pipe(word):
    reader, writer = os.pipe()
    os.close(reader)
    # Unbuffered, so that the line that prints meets the closed pipe.
    done = subprocess.run([sys.executable, "-u", "-m", "truesky.commands", word], stdout=writer, stderr=-1, cwd=ROOT)
    os.close(writer)
    assert (done.returncode, done.stderr) == (1, b"")


def test_a_job_is_given_what_the_command_is(called):
    assert truesky.main(["fluxes", "--lake", "a b", "--request", "r", "--", "--master", "local[1]"]) == 0
    file = str(ROOT / "truesky" / "running" / "spark_entry.py")
    assert called == [
        ["--master", "local[1]", file, "truesky.fluxes.compute_fluxes", "--lake", "a b", "--request", "r"]
    ]


def test_jobs_follow_one_another_until_one_fails(called):
    words = ["build", "r.toml", "--lake", "x"]
    assert truesky.main(words) == 7
    assert truesky.main(words) == 0
    assert [command[1].rpartition(".")[2] for command in called] == ["build_galaxies", "build_stars"] * 2
    assert {tuple(command[2:]) for command in called} == {("--request", "r.toml", "--lake", "x")}


def test_a_job_in_this_process_says_and_returns_the_same(tmp_path, capsys, called):
    path = requests.written(tmp_path, "colour = 3")
    words = ["--lake", str(tmp_path / "lake"), "--request", str(path)]
    assert truesky.main(["--local", "plan", *words]) == 2
    said = capsys.readouterr()
    assert submitted_job.main(import_module("truesky.render.plan_exposures").JOB, words) == 2
    assert capsys.readouterr() == said
    assert "colour" in said.err
    assert called == []


def test_help_and_forecasts_need_no_spark(capsys, called, tmp_path):
    with pytest.raises(SystemExit, match="0"):
        truesky.main(["render", "--help"])
    assert "--detectors" in capsys.readouterr().out
    words = ["plan", str(ROOT / "requests" / "demo.toml"), "--lake", str(tmp_path / "lake"), "--dry-run"]
    assert truesky.main(words) == 0
    assert "core-hours" in capsys.readouterr().out
    assert called == []


def test_commands_run_their_modules(capsys, tmp_path):
    assert truesky.main(["check", str(ROOT / "requests" / "demo.toml")]) == 0
    assert capsys.readouterr().out.startswith("demo: good")
    assert truesky.main(["mission", "diff", "CBE,BLT,DES,REQ,SIM", "CBE,BLT,DES,REQ,SIM"]) == 0
    for words, start in ((["verify", str(tmp_path)], "lake_schema: "), (["sql", "--lake", "s3://x/y"], "explore: ")):
        assert truesky.main(words) == 2
        assert capsys.readouterr().err.startswith(start)


def test_unknown_commands_are_refused(capsys):
    assert truesky.main(["rendr"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("truesky: rendr is not a command; use one of build, check,")
    assert truesky.main(["--local", "render", "--", "--master", "local"]) == 2
    assert "--local does not call spark-submit" in capsys.readouterr().err
    for words in ([], ["--help"], ["--version"]):
        assert truesky.main(words) == 0
        assert f"truesky {__version__}" in capsys.readouterr().out


@pytest.mark.parametrize(("word", "extra"), sorted(truesky.EXTRAS.items()))
def test_a_missing_optional_package_is_named_with_its_remedy(word, extra, monkeypatch, capsys):
    def missing(module):
        raise ModuleNotFoundError("No module named 'drizzle'", name="drizzle")

    monkeypatch.setattr(truesky, "import_module", missing)
    assert truesky.main([word, "lake"]) == 2
    assert capsys.readouterr().err == (
        f"truesky: {word} requires the package drizzle, which is not installed: pip install 'truesky[{extra}]'\n"
    )


def test_a_missing_module_of_truesky_is_not_reported_as_an_extra(monkeypatch):
    def missing(module):
        raise ModuleNotFoundError("No module named 'truesky.nothing'", name="truesky.nothing")

    monkeypatch.setattr(truesky, "import_module", missing)
    with pytest.raises(ModuleNotFoundError):
        truesky.main(["page", "lake"])
