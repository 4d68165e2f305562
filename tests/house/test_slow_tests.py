"""The list of slow tests, and the plugin that compares tests with it."""

import os
from types import SimpleNamespace

import pytest

from tests import slow_tests
from tests.slow_tests import LIMIT, SLOW, Watch

NAME = "test_x.py::test_y"


def test_list_of_slow_tests_is_short_and_has_reasons():
    rows = slow_tests.read()
    assert len(rows) <= slow_tests.LONGEST
    with slow_tests.LIST.open(encoding="utf-8") as stream:
        # No test is listed twice.
        assert len(list(stream)) == len(rows) + 1
    for name, row in rows.items():
        assert float(row["seconds"]) >= SLOW, name
        assert len(row["reason"].split()) >= 3, name


@pytest.fixture
def warnings():
    """Texts of warnings."""
    return []


@pytest.fixture
def watch(tmp_path, warnings):
    """Return a plugin that runs a test with an old cache."""
    cache = tmp_path / "cache"
    (cache / "array").mkdir(parents=True)
    for folder in (cache / "array", cache):
        os.utime(folder, (1000.0, 1000.0))
    found = Watch({"test_x.py::test_listed", "test_x.py::field"}, cache)
    found.item = SimpleNamespace(
        get_closest_marker=lambda name: None, warn=lambda warning: warnings.append(str(warning))
    )
    return found


def test_a_slow_test_fails(watch, warnings):
    with pytest.raises(pytest.fail.Exception, match=f"{NAME} took 20.1 s of CPU time"):
        watch.judge(NAME, LIMIT + 0.1, 2000.0)
    assert warnings == []


def test_a_test_between_the_limits_causes_a_warning(watch, warnings):
    watch.judge(NAME, SLOW, 2000.0)
    assert warnings == []
    watch.judge(NAME, LIMIT, 2000.0)
    (line,) = warnings
    assert line.startswith(f"{NAME} took 20.0 s")


def test_a_child_of_an_earlier_test_is_not_counted(watch, monkeypatch):
    """The CPU time of a child process is added when it ends, during a test that takes 2 s."""
    monkeypatch.setattr(slow_tests.time, "time", lambda: 1002.0)
    watch.clock = lambda: 120.0
    assert watch.seconds_since(1000.0, 100.0) == 2.0
    assert watch.seconds_since(900.0, 100.0) == 20.0


def test_an_empty_list_causes_warnings_for_all_tests(watch, warnings):
    watch.listed = {}
    watch.judge(NAME, 100.0, 2000.0)
    (line,) = warnings
    assert line.startswith(f"{NAME} took 100.0 s")


def test_listed_and_nightly_tests_may_be_slow(watch, warnings):
    for name in ("test_listed", "field"):
        watch.judge(f"test_x.py::{name}", 100.0, 2000.0)
    watch.item.get_closest_marker = lambda name: name == "nightly"
    watch.judge(NAME, 100.0, 2000.0)
    assert warnings == []


def test_a_test_that_fills_the_cache_may_be_slow(watch, warnings):
    watch.judge(NAME, 100.0, 999.0)
    os.utime(watch.cache / "array", (3000.0, 3000.0))
    watch.judge(NAME, 100.0, 2000.0)
    assert warnings == []


def clock_of(*seconds):
    """Return a clock that shows the given times in turn."""
    left = iter(seconds)
    return lambda: next(left)


def test_calls_and_fixtures_are_measured(watch, monkeypatch):
    monkeypatch.setattr(slow_tests.time, "time", clock_of(*range(2000, 10000, 1000)))

    def result_of(wrapper):
        next(wrapper)
        with pytest.raises(StopIteration) as done:
            wrapper.send("result")
        return done.value.value

    item = SimpleNamespace(nodeid=NAME)
    fixture = SimpleNamespace(baseid="test_x.py", argname="field")
    watch.clock = clock_of(1.0, 1.0 + LIMIT, 1.0, 2.0 + LIMIT, 5.0, 500.0)
    os.utime(watch.cache / "array", (1000.0, 1000.0))
    assert result_of(watch.pytest_runtest_call(item)) == "result"
    wrapper = watch.pytest_runtest_call(item)
    next(wrapper)
    with pytest.raises(pytest.fail.Exception, match=r"took 21\.0 s"):
        wrapper.send(None)
    assert result_of(watch.pytest_fixture_setup(fixture)) == "result"


def test_entries_of_missing_tests_are_detected():
    items = [SimpleNamespace(nodeid="tests/test_field.py::test_a[x]", fixturenames=["field"])]
    field, jobs, folder = "tests/test_field.py", "tests/test_jobs.py", "tests"
    there = [f"{field}::test_a[x]", f"{field}::field", f"{jobs}::test_b", f"{folder}::spark"]
    lost = [f"{field}::test_a", f"{field}::other", f"{folder}/x.py::test_a", f"{folder}/x::spark", f"{folder}::sparks"]
    assert slow_tests.missing([*there, *lost], items) == lost
