"""The validation command with given figures: exit status and files."""

import json
import math
import os
from pathlib import Path

import pytest

from truesky.validation import __main__, checks
from truesky.validation.model import universe

RECORDED = Path(universe.__file__).with_name("results.json")
GOOD = {"sigma_8": 0.83, "chi_2.3": 3844.0, "galaxies": 17.0}


@pytest.fixture
def found(monkeypatch):
    """Figures that replace the result of the long computation."""
    figures = dict(GOOD)
    monkeypatch.setattr(universe, "run", lambda size, folder: figures)
    return figures


def test_all_as_expected(found, tmp_path, capsys):
    file = tmp_path / "figures.json"
    assert __main__.main(["--results", str(file)]) == 0
    written = json.loads(file.read_text())
    assert {name: written[name] for name in GOOD} == GOOD
    assert (written["checks"], written["failed"]) == (2, "")
    assert os.listdir(tmp_path) == [file.name]
    assert "2 of 2 as expected" in capsys.readouterr().out


def test_json_has_every_figure_with_its_verdict(found, capsys):
    assert __main__.main(["--json"]) == 0
    rows = {row["figure"]: row for row in json.loads(capsys.readouterr().out)}
    assert {name: row["value"] for name, row in rows.items()} == GOOD
    assert (rows["sigma_8"]["verdict"], rows["galaxies"]["verdict"]) == ("pass", None)


def test_failed_check_sets_exit_status(found, tmp_path, capsys):
    found["sigma_8"] = 0.7
    file = tmp_path / "figures.json"
    assert __main__.main(["--results", str(file)]) == 1
    assert json.loads(file.read_text())["failed"] == "sigma_8"
    assert "  not: sigma_8\n" in capsys.readouterr().out


def test_nan_figure_fails(found, tmp_path):
    found["sigma_8"] = math.nan
    file = tmp_path / "figures.json"
    assert __main__.main(["--results", str(file)]) == 1
    assert json.loads(file.read_text())["sigma_8"] is None


def test_known_failure_is_reported_with_its_reason(found, tmp_path, monkeypatch, capsys):
    (tmp_path / "list.csv").write_text(
        "name,expected,kind,tolerance,source,known_to_fail\ngalaxies,20,absolute,1,a survey,it was cloudy\n"
    )
    monkeypatch.setattr(checks, "_LISTS", (tmp_path / "list.csv",))
    assert __main__.main([]) == 0
    said = capsys.readouterr().out
    assert "fail      galaxies" in said
    assert "not: galaxies, known to fail: it was cloudy" in said
    found["galaxies"] = 20.5
    assert __main__.main([]) == 0
    assert "listed as known to fail: galaxies" in capsys.readouterr().out


def test_numbers_quoted_from_memory_are_not_binding(found, tmp_path, monkeypatch, capsys):
    head = "name,expected,kind,tolerance,source,known_to_fail,confidence\n"
    for confidence, status in (("M", 0), ("P", 1)):
        (tmp_path / "list.csv").write_text(f"{head}galaxies,40,factor,2,a survey,,{confidence}\n")
        monkeypatch.setattr(checks, "_LISTS", (tmp_path / "list.csv",))
        assert __main__.main([]) == status
    found["galaxies"] = 21.0
    capsys.readouterr()
    assert __main__.main([]) == 0
    assert "pass      galaxies" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("option", "name", "said"),
    [
        ("--results", "none/figures.json", "its folder does not exist"),
        ("--results", ".", "is not a file"),
        ("--figures", "file", "is not a folder"),
        ("--figures", "file/below", "is not a folder"),
        ("--results", "locked/figures.json", "is not writable"),
        ("--figures", "locked/figures", "is not writable"),
    ],
)
def test_paths_are_checked_before_anything_is_computed(monkeypatch, tmp_path, capsys, option, name, said):
    monkeypatch.setattr(universe, "run", lambda *_: pytest.fail("computed"))
    (tmp_path / "file").touch()
    (tmp_path / "locked").mkdir()
    # Only users other than root cannot write here.
    monkeypatch.setattr(os, "access", lambda folder, mode: "locked" not in str(folder))
    assert __main__.main([option, str(tmp_path / name)]) == 2
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert name in lines[0] or name == "."
    assert said in lines[0]


def test_the_recorded_figures_are_as_expected():
    """The last full run measured every expectation, and only known failures fail."""
    figures = json.loads(RECORDED.read_text())
    results = checks.evaluate({name: value for name, value in figures.items() if isinstance(value, float)})
    assert len(results) == figures["checks"]
    assert [check.name for check in results if check.is_unexpected_failure] == []
    assert [check.name for check in results if check.passes and check.known_failure] == []
    assert figures["failed"].split(", ") == [check.name for check in results if not check.passes]
