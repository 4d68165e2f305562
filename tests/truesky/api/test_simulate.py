"""Requests checked from Python; they are run in tests/test_field.py."""

import doctest
import tomllib
from pathlib import Path

import numpy as np
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


def test_a_dictionary_may_have_numpys_numbers_and_tuples():
    area = {"cone": {"ra": np.float32(53.5), "dec": np.float64(-27.5), "radius": 0.1}}
    keys = {"name": "field", "seed": np.int64(7), "area": area, "fluxes": {"bands": ("euclid_vis",)}}
    plain = {**keys, "seed": 7, "area": {"cone": {"ra": 53.5, "dec": -27.5, "radius": 0.1}}}
    plain["fluxes"] = {"bands": ["euclid_vis"]}
    assert truesky.check(keys) == truesky.check(plain)
    assert truesky.check({**plain, "fluxes": {"bands": np.array(["euclid_vis"])}}) == truesky.check(plain)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ({"limit": "x"}, "limit = 'x' is not a whole number"),
        ({"limit": 0}, "limit = 0 is outside"),
        ({"detectors": [3]}, r"detectors = \[3\] is not a name or a list of names"),
        ({"detectors": 3}, "detectors = 3 is not a name"),
        ({"lake": None}, "None is not a path"),
    ],
)
def test_wrong_arguments_of_a_run_are_named(tmp_path, monkeypatch, arguments, said):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(truesky.BadInput, match=said):
        truesky.run(**{"request": DEMO, "lake": "lake", **arguments})
    assert list(tmp_path.iterdir()) == []


def test_paths_may_begin_with_the_home_folder(tmp_path, monkeypatch):
    monkeypatch.setenv("HOME", str(tmp_path))
    path = requests.written(tmp_path)
    assert truesky.check(f"~/{path.name}") == truesky.check(path)
    with pytest.raises(truesky.BadInput, match=f"{tmp_path}/none.toml: no such file"):
        truesky.check("~/none.toml")
    with pytest.raises(truesky.BadInput, match=r"^None is not a path$"):
        truesky.check(None)


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
