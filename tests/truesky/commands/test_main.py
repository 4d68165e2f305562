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
from truesky.command_line import commands
from truesky.commands import __main__ as truesky
from truesky.commands import submit
from truesky.running import submitted_job, supervise

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
    declared = commands.COMMANDS.values()
    assert {module for one in declared if one.is_job for module in one.modules} == modules
    for module in {module for one in declared if not one.is_job for module in one.modules}:
        assert callable(import_module(module).run_command)


@pytest.mark.parametrize("word", ["--help", "--version"])
def test_a_reader_of_the_help_may_close_the_pipe(word):
    reader, writer = os.pipe()
    os.close(reader)
    # Unbuffered, so that the line that prints meets the closed pipe.
    done = subprocess.run([sys.executable, "-u", "-m", "truesky.commands", word], stdout=writer, stderr=-1, cwd=ROOT)
    os.close(writer)
    assert (done.returncode, done.stderr) == (1, b"")


def test_a_job_is_given_what_the_command_is(called):
    options, spark = ["-v", "--bands", "x", "y"], ["--", "--master", "local[1]"]
    for words in (["r", "a b"], ["--lake", "a b", "--request", "r"], ["r", "--lake=a b"]):
        called.clear()
        assert truesky.main(["fluxes", *words, *options, *spark]) == 0
        file = str(ROOT / "truesky" / "running" / "spark_entry.py")
        given = ["--lake", "a b", "--request", "r", "--bands", "x", "y", "--verbose"]
        assert called == [["--master", "local[1]", file, "truesky.fluxes.compute_fluxes", *given]]
        called.append([])


def test_jobs_follow_one_another_until_one_fails(called):
    words = ["build", "r.toml", "x"]
    assert truesky.main(words) == 7
    assert truesky.main(words) == 0
    assert [command[1].rpartition(".")[2] for command in called] == ["build_galaxies", "build_stars"] * 2
    assert {tuple(command[2:]) for command in called} == {("--lake", "x", "--request", "r.toml")}


def test_a_job_in_this_process_says_and_returns_the_same(tmp_path, capsys, called):
    path = requests.written(tmp_path, "colour = 3")
    assert truesky.main(["--local", "plan", str(path), str(tmp_path / "lake")]) == 2
    said = capsys.readouterr()
    words = ["--lake", str(tmp_path / "lake"), "--request", str(path)]
    assert submitted_job.main(import_module("truesky.render.plan_exposures").JOB, words) == 2
    assert capsys.readouterr() == said
    assert "colour" in said.err
    assert called == []


def test_help_and_forecasts_need_no_spark(capsys, called, tmp_path):
    with pytest.raises(SystemExit, match="0"):
        truesky.main(["render", "--help"])
    assert "--detectors" in capsys.readouterr().out
    words = ["plan", str(ROOT / "requests" / "demo.toml"), str(tmp_path / "lake"), "--dry-run"]
    assert truesky.main(words) == 0
    assert "cost of this request" in capsys.readouterr().out
    assert called == []


def test_commands_run_their_modules(capsys, tmp_path):
    assert truesky.main(["check", str(ROOT / "requests" / "demo.toml")]) == 0
    assert capsys.readouterr().out.startswith("demo: good")
    assert truesky.main(["mission", "diff", "CBE,BLT,DES,REQ,SIM", "CBE,BLT,DES,REQ,SIM"]) == 0
    for words in (["verify", str(tmp_path)], ["sql", "s3://x/y"]):
        assert truesky.main(words) == 2
        assert capsys.readouterr().err.startswith(f"truesky {words[0]}: ")


@pytest.mark.parametrize("local", [[], ["--local"]])
def test_a_run_is_supervised_unless_options_of_spark_are_given(monkeypatch, called, local):
    supervised = []
    monkeypatch.setattr(supervise, "supervise", lambda *arguments: supervised.append(arguments) or 4)
    words = ["my request.toml", "--lake", "x"]
    assert truesky.main([*local, "run", *words]) == 4
    assert supervised == [
        ("truesky run", ["-m", "truesky.commands.local_run", *words], "truesky run 'my request.toml' --lake x")
    ]
    assert truesky.main(["run", str(ROOT / "requests" / "none.toml"), "--lake", "x", "--", "--master", "local"]) == 2
    assert len(supervised) == 1
    assert called == []


def test_unknown_commands_are_refused(capsys):
    assert truesky.main(["rendr"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line == 'truesky: rendr is not a command; did you mean "render"?'
    assert truesky.main(["xyz"]) == 2
    assert "xyz is not a command; use one of build, cache, check, completion," in capsys.readouterr().err
    assert truesky.main(["--local", "render", "r.toml", "lake", "--", "--master", "local"]) == 2
    assert "--local does not call spark-submit" in capsys.readouterr().err
    for words in ([], ["--help"], ["--version"]):
        assert truesky.main(words) == 0
        assert f"truesky {__version__}" in capsys.readouterr().out


_EXTRAS = sorted((name, declared.extra) for name, declared in commands.COMMANDS.items() if declared.extra)
_OPTIONS = {"push": ["s3://x/y"]} | {key: ["--out", "x"] for key in ("export", "masters", "reduce", "stack", "train")}


@pytest.mark.parametrize(("word", "extra"), _EXTRAS)
def test_a_missing_optional_package_is_named_with_its_remedy(word, extra, monkeypatch, capsys):
    def missing(module):
        raise ModuleNotFoundError("No module named 'drizzle'", name="drizzle")

    monkeypatch.setattr(truesky, "import_module", missing)
    words = ["depth", "lake"] if word == "export" else ["lake"]
    assert truesky.main([word, *words, *_OPTIONS.get(word, [])]) == 2
    assert capsys.readouterr().err == (
        f"truesky: {word} requires the package drizzle, which is not installed: pip install 'truesky[{extra}]'\n"
    )


def test_a_missing_module_of_truesky_is_not_reported_as_an_extra(monkeypatch):
    def missing(module):
        raise ModuleNotFoundError("No module named 'truesky.nothing'", name="truesky.nothing")

    monkeypatch.setattr(truesky, "import_module", missing)
    with pytest.raises(ModuleNotFoundError):
        truesky.main(["page", "lake"])
