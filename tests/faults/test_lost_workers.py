"""Render on a cluster with a killed and a slow worker: each detector once, with the same bytes as in local mode."""

import json
import os
import shutil
import signal
import subprocess
import threading
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from lake_schema.store import layout, read
from tests import requests
from tests.cluster import below, command, different, environment, events, running, submit, told
from truesky.commands import run

pytestmark = [pytest.mark.spark, pytest.mark.nightly]

RENDER = "jobs/render/render_exposures.py"
# Four of NISP's detectors in three bands, twice; what bright stars leave in them is in the band after.
DETECTORS = ("DET22", "DET23", "DET32", "DET33")
WANTED = f"""
accuracy = "draft"
{requests.shallow(21.0, 20.0)}
[[observation]]
channels = ["NISP-P"]
ra = 53.117
dec = -27.808
dither = "none"
detectors = {json.dumps(DETECTORS)}
realisations = 2

[products]
truth = []
"""
TASKS = 2 * 3 * len(DETECTORS)
# Nothing begins before all four are there; a copy of a task begins elsewhere where it takes half as long again as half
# of the tasks did.
SETTINGS = {
    "spark.scheduler.minRegisteredResourcesRatio": "1.0",
    "spark.scheduler.maxRegisteredResourcesWaitingTime": "600s",
    "spark.speculation": "true",
    "spark.speculation.interval": "200ms",
    "spark.speculation.multiplier": "1.5",
    "spark.speculation.quantile": "0.5",
}
# Of 2 s a slow machine works 0.2.
RUNS, STOPS = 0.2, 1.8


@pytest.fixture(scope="module")
def request_file(tmp_path_factory):
    folder = tmp_path_factory.mktemp("request")
    return requests.written(folder, WANTED, area=requests.FIELD.format(0.42), name="lost", seed=11)


@pytest.fixture(scope="module")
def local(tmp_path_factory, request_file):
    """The lake that the jobs make in local mode."""
    root = layout.resolve_lake(tmp_path_factory.mktemp("local") / "lake")
    for stage in (*run.CATALOGUES, *run.IMAGES):
        package, name = stage.module.split(".")[1:]
        submit(f"jobs/{package}/{name}.py", root, request_file)
    return root


@contextmanager
def slowed(worker):
    """Stop and continue the processes of a worker repeatedly, to simulate a slow machine."""
    done = threading.Event()

    def stutter():
        while not done.is_set():
            own = {worker.pid, *below(worker.pid)}
            tell(own, signal.SIGSTOP)
            done.wait(STOPS)
            tell(own, signal.SIGCONT)
            done.wait(RUNS)

    thread = threading.Thread(target=stutter)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


def tell(pids, number):
    for pid in pids:
        with suppress(ProcessLookupError):
            os.kill(pid, number)


def is_at_work(worker):
    """Return True if the executor has started Python for a task."""
    for pid in below(worker.pid):
        with suppress(OSError):
            if "pyspark.daemon" in Path(f"/proc/{pid}/cmdline").read_text():
                return True
    return False


def wait_for(driver, condition):
    while not condition():
        assert driver.poll() is None, driver.communicate()
        time.sleep(0.1)


def test_render_with_a_killed_and_a_slow_worker(local, request_file, tmp_path):
    lake = layout.resolve_lake(shutil.copytree(local, tmp_path / "lake", symlinks=True))
    for name in ("products", "rendered_truth"):
        shutil.rmtree(lake / name)
        (lake / "names" / "lost" / name).unlink()
    (tmp_path / "events").mkdir()
    with running(tmp_path, ("one", "two", "killed", "slow")) as (master, workers):
        driver = subprocess.Popen(
            command(RENDER, lake, request_file, "--master", master, *told(tmp_path / "events", **SETTINGS)),
            cwd="/", env=environment(), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )  # fmt: skip
        wait_for(driver, lambda: is_at_work(workers["slow"]))
        with slowed(workers["slow"]):
            wait_for(driver, lambda: len(list(lake.glob("products/.receipts-*/[!.]*.json"))) >= 4)
            assert is_at_work(workers["killed"])
            # The machine and all that runs on it.
            dying = {workers["killed"].pid, *below(workers["killed"].pid)}
            assert len(dying) >= 3
            tell(dying, signal.SIGKILL)
            said, _ = driver.communicate(timeout=3000)
        assert driver.returncode == 0, said
        (log,) = (events(path) for path in (tmp_path / "events").iterdir())
        # Wait for the slow worker: its late results have no effect.
        time.sleep(5.0)
    check_events(log)
    check_once(lake)
    assert different(lake, local) == []


def check_events(log):
    """Tasks of the killed and the slow worker ran again; the first copy that ends counts."""
    of = {kind: [one for one in log if one["Event"] == f"SparkListener{kind}"] for kind in
          ("ExecutorAdded", "ExecutorRemoved", "TaskStart", "TaskEnd", "StageSubmitted")}  # fmt: skip
    assert len(of["ExecutorAdded"]) == 4
    assert of["ExecutorRemoved"]
    reasons = {one["Task End Reason"]["Reason"] for one in of["TaskEnd"]}
    assert "ExecutorLostFailure" in reasons
    assert any(one["Task Info"]["Speculative"] for one in of["TaskStart"])
    first = min(one["Stage ID"] for one in of["TaskEnd"])
    ended = [one["Task Info"]["Index"] for one in of["TaskEnd"]
             if one["Stage ID"] == first and one["Task End Reason"]["Reason"] == "Success"]  # fmt: skip
    # A task of Spark renders the exposures of a detector that follow each other.
    (stage,) = (one["Stage Info"] for one in of["StageSubmitted"] if one["Stage Info"]["Stage ID"] == first)
    assert len(DETECTORS) <= stage["Number of Tasks"] <= TASKS
    assert set(ended) == set(range(stage["Number of Tasks"]))


def check_once(lake):
    version = read.version(lake, "products")
    rows = version.rows(["exposure_id", "detector", "content"]).to_pylist()
    places = [(row["exposure_id"], row["detector"]) for row in rows if row["content"] == "science"]
    assert sorted(places) == sorted({*places})
    assert len(places) == TASKS == len(version.partitions)
    # Nor is anything left of copies that lost.
    left = {path.name for path in layout.table_folder(lake, "products").iterdir() if not path.name.startswith(".lock")}
    assert left == {"current", version.folder.name}
    assert not list(lake.rglob("*.tmp.*"))
    log = max(layout.runs_folder(lake).glob("*-products-*.jsonl"), key=lambda path: path.stat().st_mtime_ns)
    made = [line["part"] for line in events(log) if "part" in line]
    assert sorted(made) == sorted(version.partitions)
