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
