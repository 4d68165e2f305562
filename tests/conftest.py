"""What all tests share: a cache and an environment of their own, one Spark session, hypothesis profiles."""

import os
import tempfile
from pathlib import Path

# Before numpy, numba, astropy or colossus are imported by anything.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("TRUESKY_CACHE", str(Path(tempfile.gettempdir()) / f"truesky-tests-{os.getuid()}"))

import pytest
from hypothesis import settings

settings.register_profile("default", max_examples=30, deadline=None)
settings.register_profile("ci", max_examples=60, deadline=None, derandomize=True)
settings.register_profile("nightly", max_examples=5000, deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci" if os.environ.get("CI") else "default"))


# What is made once a process and takes long, so that its tests stay in one, and begin first: they are the most.
_SHARED = ("spark", "universe")


def pytest_collection_modifyitems(items):
    """For several processes (pytest-xdist): what shares the Spark session or the drawn sky stays together, or a file.

    Those that start a Java begin before the others, so that no process is left alone with them at the end.
    """
    groups, marked = {}, set()
    for item in items:
        for name in _SHARED:
            if name in item.fixturenames:
                groups.setdefault(item.path, name)
        if item.get_closest_marker("spark"):
            marked.add(item.path)
    for item in items:
        item.add_marker(pytest.mark.xdist_group(groups.get(item.path, item.nodeid.partition("::")[0])))
    order = {name: place for place, name in enumerate(_SHARED)}
    items.sort(key=lambda item: (item.path not in marked, order.get(groups.get(item.path), len(order))))


@pytest.fixture(scope="session")
def spark():
    """One local session for the whole run, on the Java that the environment chose."""
    from jobs.session import session

    running = session("tests")
    yield running
    running.stop()


@pytest.fixture
def lake(tmp_path):
    """An empty lake."""
    root = tmp_path / "lake"
    root.mkdir()
    return root
