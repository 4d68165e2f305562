"""Functions that are compiled before they are needed: the list, and the process."""

import json
import time
from importlib import import_module
from pathlib import Path

import pytest

from tests import requests
from truesky.fluxes.libraries import templates
from truesky.numerics import cache
from truesky.request.from_toml import parse
from truesky.running import compile_ahead

REQUESTS = Path(__file__).resolve().parents[3] / "requests"
GROUPS = json.loads(compile_ahead.LIST.read_text())


def test_every_listed_function_can_be_compiled():
    """It exists, and its types of arguments are types of numba. The list is from runs of the jobs."""
    for functions in GROUPS.values():
        for name, types in functions.items():
            module, function = name.split(":")
            compiled = getattr(import_module(module), function).load()
            for text in types:
                parameters = compiled.py_func.__code__.co_argcount
                assert len(compile_ahead.argument_types(text)) == parameters, name


def test_the_groups_of_a_request(tmp_path):
    def groups(name):
        return compile_ahead.groups_of_request(parse(REQUESTS / f"{name}.toml"))

    assert compile_ahead.groups_of_request(parse(requests.written(tmp_path))) == ["catalogues"]
    assert groups("demo") == ["catalogues", "ccd"]
    assert groups("slitless") == groups("pilot_one_observation") == ["catalogues", "ccd", "infrared"]
    assert set(GROUPS) == set(groups("slitless"))


@pytest.fixture
def code(tmp_path, monkeypatch):
    """An empty folder for machine code."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "code"))
    return cache.machine_code_dir()


def test_functions_without_machine_code_are_missing(code):
    assert compile_ahead.missing_functions(["ccd", "infrared"]) == [*GROUPS["ccd"], *GROUPS["infrared"]]
    (folder := code / "render.drawing.kernels").mkdir(parents=True)
    (folder / "frame.accumulate-64.py311.nbi").touch()
    missing = compile_ahead.missing_functions(["ccd"])
    assert set(GROUPS["ccd"]) - set(missing) == {"truesky.render.drawing.kernels.frame:accumulate"}


def test_spectra_of_stars_are_computed_after_the_functions_of_the_catalogues(code, tmp_path, monkeypatch):
    monkeypatch.setenv("TRUESKY_CACHE", str(tmp_path / "cache"))
    name = "truesky.fluxes.libraries.templates:stellar_library"
    assert compile_ahead.missing_functions(["catalogues", "ccd"]) == [*GROUPS["catalogues"], name, *GROUPS["ccd"]]
    called = []
    monkeypatch.setattr(templates, "stellar_library", lambda: called.append(name))
    compile_ahead.compile_functions([name])
    assert called == [name]


def test_a_process_compiles_functions(code):
    name = "truesky.catalogue.halos.projected_nfw:total"
    with compile_ahead.compile_in_background([name]):
        deadline = time.monotonic() + 120
        while not list(code.glob("catalogue.halos/projected_nfw.total-*.nbi")):
            assert time.monotonic() < deadline
            time.sleep(0.05)
    assert name not in compile_ahead.missing_functions(["catalogues"])


def test_the_process_ends_with_the_block(code):
    start = time.monotonic()
    with compile_ahead.compile_in_background(list(GROUPS["ccd"])):
        pass
    assert time.monotonic() - start < 20.0
