"""Activities of processes, for the display of a run."""

import os
import subprocess
import sys

import pytest

from truesky.numerics import activity, cache


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv(activity.SETTING, str(tmp_path))
    monkeypatch.setattr(activity, "_UPDATE_INTERVAL", 0.0)
    return tmp_path


def read(folder):
    return [(entry.text, entry.done, entry.total) for entry in activity.read_activities(folder)]


def test_an_activity_is_shown_while_it_lasts(folder):
    with activity.report("density box"), activity.report("lensing map", 16) as update:
        update(3)
        assert read(folder) == [("density box", 0, 0), ("lensing map", 3, 16)]
        assert {entry.process for entry in activity.read_activities(folder)} == {os.getpid()}
    assert list(folder.iterdir()) == []


def test_it_ends_with_an_error(folder):
    with pytest.raises(ValueError, match="x"), activity.report("density box"):
        raise ValueError("x")
    assert list(folder.iterdir()) == []


def test_a_sequence_is_tracked(folder):
    assert [(item, read(folder)) for item in activity.track("ab", "map")] == [
        ("a", [("map", 0, 2)]),
        ("b", [("map", 1, 2)]),
    ]
    assert read(folder) == []


def test_updates_are_limited(folder, monkeypatch):
    monkeypatch.setattr(activity, "_UPDATE_INTERVAL", 100.0)
    with activity.report("map", 16) as update:
        update(1)
        assert read(folder) == [("map", 0, 16)]


def test_an_activity_of_a_process_that_was_killed_is_left_out(folder):
    program = (
        "import os, signal\nfrom truesky.numerics import activity\n"
        "with activity.report('x'): os.kill(os.getpid(), signal.SIGKILL)"
    )
    subprocess.run([sys.executable, "-c", program], check=False)
    assert len(list(folder.iterdir())) == 1
    assert read(folder) == []


def test_without_a_run_nothing_is_written(tmp_path, monkeypatch):
    monkeypatch.delenv(activity.SETTING, raising=False)
    monkeypatch.chdir(tmp_path)
    with activity.report("x") as update:
        update(1)
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_gone_is_no_error(folder):
    with activity.report("x"):
        for path in folder.iterdir():
            path.unlink()
        folder.rmdir()
    with activity.report("y") as update:
        update(1)


def test_the_making_of_cached_arrays_is_shown(folder, monkeypatch):
    shown = []

    def make():
        shown.extend(read(folder))
        return {"a": __import__("numpy").zeros(1)}

    with cache.use_temporary_dir():
        for _ in range(2):
            cache.cached_arrays("lensing_256", "0" * 64, make)
    assert shown == [("lensing 256 (computed once, then in the cache)", 0, 0)]
