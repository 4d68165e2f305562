"""Shared fixtures: a separate cache and environment, one Spark session, hypothesis profiles."""

import gc
import os
import tempfile
from collections import Counter
from pathlib import Path

# Before numpy, numba, astropy or colossus are imported by anything.
os.environ.setdefault("OMP_NUM_THREADS", "1")

os.environ.setdefault("TRUESKY_CACHE", str(Path(tempfile.gettempdir()) / f"truesky-tests-{os.getuid()}"))
# All tests share the cache, with entries of many versions of the code.
os.environ.setdefault("TRUESKY_CACHE_LIMIT", "none")

import pytest
from hypothesis import settings

from tests import slow_tests, tolerances
from truesky.running import memory_reuse

pytest.approx = tolerances.approx

settings.register_profile("default", max_examples=8, deadline=None)
settings.register_profile("ci", max_examples=8, deadline=None, derandomize=True)
settings.register_profile("nightly", max_examples=5000, deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "ci" if os.environ.get("CI") else "default"))


# If tests run in several processes (pytest-xdist, --dist loadfile), all tests of a file run in the same one, and so do
# the files of a group, which share the Spark session or the drawn skies.
_SHARED = {"spark": "Spark", "drawn": "sky", "flat_sky": "sky"}
_GROUPS = {
    "Spark": (
        "tests/faults/test_spark.py", "tests/truesky/running/test_session.py", "tests/test_field.py",
        "tests/truesky/render/test_render_exposures_calibration.py",
        "tests/truesky/render/test_render_exposures_infrared.py",
        "tests/truesky/render/test_render_exposures_spectra.py", "tests/truesky/render/test_sequence.py",
    ),
    "sky": (
        "tests/truesky/catalogue/galaxies/test_emission_lines.py", "tests/truesky/catalogue/galaxies/test_galaxies.py",
        "tests/truesky/catalogue/galaxies/test_high_redshift.py", "tests/truesky/catalogue/galaxies/test_lensing.py",
        "tests/truesky/catalogue/galaxies/test_strong_lenses.py", "tests/truesky/catalogue/halos/test_halos.py",
        "tests/truesky/catalogue/test_lensed_quasars.py", "tests/truesky/validation/model/test_observed.py",
        "tests/truesky/validation/model/test_universe.py",
    ),
}  # fmt: skip
_SCOPES = {file: group for group, files in _GROUPS.items() for file in files}
_SLOW = slow_tests.read()


def _scope(file):
    return _SCOPES.get(file, file)


def pytest_configure(config):
    cache = Path(os.environ["TRUESKY_CACHE"]).expanduser()
    config.pluginmanager.register(slow_tests.Watch(_SLOW, cache), "slow tests")


def pytest_collection_modifyitems(config, items):
    """Groups and files with the slowest tests come first, so that both processes end at about the same time."""
    files = {item: item.nodeid.partition("::")[0] for item in items}
    for item, file in files.items():
        for fixture in _SHARED.keys() & item.fixturenames:
            if _scope(file) != _SHARED[fixture]:
                raise pytest.UsageError(f"{file} uses the fixture {fixture}: add it to its group in tests/conftest.py")
    # A test that is asked for by its name comes without the others of its file.
    if not any("::" in name for name in config.args) and (lost := slow_tests.missing(_SLOW, items)):
        raise pytest.UsageError(f"tests/slow_tests.csv lists what does not exist: {', '.join(lost)}")
    seconds = Counter()
    for name, row in _SLOW.items():
        seconds[_scope(name.partition("::")[0])] += float(row["seconds"])
    java = {_scope(file) for item, file in files.items() if item.get_closest_marker("spark")}

    def place(item):
        scope = _scope(files[item])
        # Files of lake_schema have the shortest tests, so that neither process waits long for the other at the end.
        return -seconds[scope], scope not in java, scope.startswith("tests/lake_schema/"), scope

    items.sort(key=place)


def pytest_collection_finish():
    """Thousands of collected tests live until the end, so the garbage collector need not visit them each time."""
    gc.collect()
    gc.freeze()


def pytest_unconfigure():
    gc.unfreeze()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport():
    """Let skipped tests fail if $TRUESKY_NO_SKIPS is set."""
    report = yield
    if report.skipped and os.environ.get("TRUESKY_NO_SKIPS"):
        report.outcome = "failed"
    return report


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Return the group of a test: its file, or the fixture that files share."""
    if config.getvalue("dist") != "loadfile":
        return None
    from xdist.scheduler import LoadFileScheduling

    class Sharing(LoadFileScheduling):
        def _split_scope(self, nodeid):
            return _scope(super()._split_scope(nodeid))

    return Sharing(config, log)


@pytest.fixture(scope="module", autouse=True)
def no_terminal_width():
    """Remove $COLUMNS, which processes of a parallel run of tests may have, and which sets the width of tables."""
    os.environ.pop("COLUMNS", None)


@pytest.fixture(scope="session", autouse=True)
def _no_waiting_for_the_disc():
    """Disable fsync, because tests simulate failures of calls and processes, not of power."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda descriptor: None)
        yield


@pytest.fixture(scope="module", autouse=True)
def _memory_is_reused():
    """Each file of tests keeps the memory of its large arrays until it ends, which saves a tenth of the CPU time."""
    with memory_reuse.retain_freed_memory():
        yield


@pytest.fixture(scope="session")
def spark():
    """One local Spark session for all tests, with the Java of the environment."""
    from truesky.running.session import get_session

    running = get_session("tests")
    yield running
    running.stop()


@pytest.fixture
def lake(tmp_path):
    """An empty lake."""
    root = tmp_path / "lake"
    root.mkdir()
    return root


@pytest.fixture(scope="session")
def object_storage():
    """An S3 service on loopback; each test names its buckets."""
    from tests import object_storage as storage

    with storage.service() as running:
        yield running


@pytest.fixture
def bucket(object_storage, monkeypatch, request):
    """Return the service, the name of an empty bucket, and environment variables for access."""
    from tests import object_storage as storage

    for name, value in {**storage.CREDENTIALS, "AWS_ENDPOINT_URL": object_storage.url}.items():
        monkeypatch.setenv(name, value)
    name = f"sky-{abs(hash(request.node.nodeid)):x}"
    object_storage.client.create_bucket(Bucket=name)
    object_storage.recorder.asked.clear()
    object_storage.recorder.answer = None
    yield object_storage, name
    object_storage.recorder.answer = None
