"""A test that takes long must be on a list with a reason (`slow_tests.csv`), or it fails.

CPU time is measured, of the process and of its children that ended, so that other programs do not matter. A fixture is
listed, too, as `<file or folder of its conftest>::<name>`.

read     the list
missing  entries of the list that name nothing
Watch    the plugin that measures
"""

import csv
import os
import re
import time
from pathlib import Path

import pytest

LIST = Path(__file__).with_name("slow_tests.csv")
# CPU seconds: above SLOW a test should be on the list. It fails only above LIMIT, since the same test takes up to three
# times as long on a slower machine, or on a core whose other thread is busy.
SLOW, LIMIT = 5.0, 20.0
# Most entries of the list.
LONGEST = 40


def read(path=LIST):
    """Name of a slow test or fixture -> its row of the list: `test`, `seconds`, `reason`."""
    with path.open(newline="", encoding="utf-8") as stream:
        return {row["test"]: row for row in csv.DictReader(stream)}


def missing(names, items):
    """Names of the list that no longer exist, as far as their files are among the collected ones.

    Parameters
    ----------
    names : iterable of str
        Names of tests and fixtures.
    items : list of pytest.Item
        All tests of the files that are collected.
    """
    collected = {item.nodeid: item for item in items}
    files = {test.partition("::")[0] for test in collected}
    absent = []
    for name in names:
        place, _, last = name.partition("::")
        path = LIST.parents[1] / place
        if path.is_dir():
            there = re.search(rf"\b{last}\b", (path / "conftest.py").read_text(encoding="utf-8"))
        elif place not in files or not path.is_file():
            there = path.is_file()
        elif last.startswith("test_"):
            there = name in collected
        else:
            there = any(last in item.fixturenames for test, item in collected.items() if test.startswith(f"{place}::"))
        if not there:
            absent.append(name)
    return absent


def cpu_seconds():
    """CPU time (s) of this process and of its children that ended."""
    used = os.times()
    return used.user + used.system + used.children_user + used.children_system


class Watch:
    """Measure tests and fixtures. A slow one that is not on the list is reported, and fails above LIMIT.

    Parameters
    ----------
    listed : container of str
        Names that may take long.
    cache : pathlib.Path
        The cache of the run.
    clock : callable
        CPU time, s.
    """

    def __init__(self, listed, cache, clock=cpu_seconds):
        self.listed, self.cache, self.clock = listed, cache, clock
        self.item = None

    def judge(self, name, seconds, since):
        """Warn above SLOW, fail above LIMIT. With an empty list there are warnings alone, from which it can be filled.

        Parameters
        ----------
        name : str
            Test or fixture, as it would be listed.
        seconds : float
            CPU time that it took, s.
        since : float
            When it began, s since the epoch.
        """
        nightly = self.item.get_closest_marker("nightly") is not None
        if seconds <= SLOW or nightly or name in self.listed or self.is_filled(since):
            return
        message = f"{name} took {seconds:.1f} s of CPU time: make it faster, or add it to tests/slow_tests.csv"
        if seconds > LIMIT and self.listed:
            pytest.fail(f"{message} (more than {LIMIT:g} s)", pytrace=False)
        self.item.warn(pytest.PytestWarning(message))

    def seconds_since(self, since, before):
        """CPU seconds since a time, s since the epoch, when the clock showed `before`; at most those of one core.

        A child's CPU time is counted when the child is waited for, which can be long after the test that started it.
        """
        return min(self.clock() - before, time.time() - since)

    def is_filled(self, since):
        """Whether arrays or compiled code were added to the cache after a time, s since the epoch.

        If the cache is empty, any test may be the first that needs one of them, and it makes it for all others.
        """
        return any(os.stat(folder).st_mtime >= since for folder, _, _ in os.walk(self.cache))

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_setup(self, item):
        self.item = item

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_call(self, item):
        since, before = time.time(), self.clock()
        result = yield
        self.judge(item.nodeid, self.seconds_since(since, before), since)
        return result

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef):
        # The fixtures that it depends on were set up before.
        since, before = time.time(), self.clock()
        result = yield
        self.judge(f"{fixturedef.baseid}::{fixturedef.argname}", self.seconds_since(since, before), since)
        return result
