"""Requests checked from Python; they are run in tests/test_field.py."""

import doctest
import tomllib
from pathlib import Path

import pytest

import truesky
from tests import requests
from truesky.api import simulate
from truesky.request.accuracy import PRESETS

DEMO = Path(__file__).resolve().parents[3] / "requests" / "demo.toml"


def test_a_file_and_its_keys_are_the_same_request():
    assert truesky.check(DEMO) == truesky.check(str(DEMO)) == truesky.check(tomllib.loads(DEMO.read_text()))


@pytest.mark.parametrize("ask", [truesky.check, lambda request: truesky.run(request, "lake")])
def test_a_wrong_request_is_refused_and_nothing_written(tmp_path, monkeypatch, ask):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(truesky.BadInput, match="colour"):
        ask(tomllib.loads(requests.text("colour = 3")))
    path = requests.written(tmp_path, "colour = 3")
    with pytest.raises(truesky.BadInput, match=r"r\.toml.*colour"):
        ask(path)
    assert [file.name for file in tmp_path.iterdir()] == ["r.toml"]


def test_each_named_accuracy_reaches_what_it_allows():
    found = truesky.accuracies()
    assert list(found.index) == list(PRESETS)
    for name, row in found.iterrows():
        for error in ("flux", "shape", "position", "background"):
            assert row[error] == getattr(PRESETS[name], error)
            assert 0.0 < row[f"{error}_reached"] <= row[error]
    assert found["seconds"].is_monotonic_increasing


def test_examples_of_the_documentation():
    assert doctest.testmod(simulate).failed == 0
    assert doctest.testmod(simulate).attempted > 0
