"""The demo's jobs on a cluster of processes: a standalone master and two workers on loopback, against local mode."""

import os
import re
import shutil
import signal
import subprocess
import time

import pytest

from lake_schema.store import layout
from tests.cluster import ROOT, command, different, environment, events, running, submit, told
from truesky.commands import run

pytestmark = [pytest.mark.spark, pytest.mark.nightly]

JOBS = [
    f"jobs/{stage.module.removeprefix('truesky.').replace('.', '/')}.py" for stage in (*run.CATALOGUES, *run.IMAGES)
]
# Which of them have something for workers to do.
SHARED = [script for script in JOBS if "plan" not in script]


@pytest.fixture(scope="module")
def request_file(tmp_path_factory):
    """The demo's two detectors, of brighter sources."""
    text = (ROOT / "requests" / "demo.toml").read_text()
    for key, value in (("galaxy_limit", 21.0), ("star_limit", 20.0), ("lensing_nside", 64), ("accuracy", '"draft"')):
        text, found = re.subn(rf"^{key} = [^ \n]+", f"{key} = {value}", text, flags=re.MULTILINE)
        assert found == 1
    path = tmp_path_factory.mktemp("request") / "demo.toml"
    path.write_text(text)
    return path


@pytest.fixture(scope="module")
def local(tmp_path_factory, request_file):
    """The lake that the five jobs make in local mode."""
    root = layout.resolve_lake(tmp_path_factory.mktemp("local") / "lake")
    for script in JOBS:
        submit(script, root, request_file)
    return root


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """Return the address of a master with two workers of one core, and the folder of its logs."""
    folder = tmp_path_factory.mktemp("cluster")
    (folder / "events").mkdir()
    with running(folder, ("one", "two")) as (master, _):
        yield master, folder


def test_the_demo_on_a_cluster_gives_the_bytes_of_one_machine(local, cluster, request_file, tmp_path):
    master, folder = cluster
    lake = layout.resolve_lake(tmp_path / "lake")
    for script in JOBS:
        submit(script, lake, request_file, "--master", master, *told(folder / "events"))
    logs = [events(path) for path in sorted((folder / "events").iterdir())]
    assert len(logs) == len(SHARED)
    for log in logs:
        (about,) = (event for event in log if event["Event"] == "SparkListenerEnvironmentUpdate")
        assert dict(about["Spark Properties"])["spark.master"] == master
        # No path of the submitting machine goes to the workers.
        assert "spark.executorEnv.PYTHONPATH" not in dict(about["Spark Properties"])
        ran = [event["Task Info"] for event in log if event["Event"] == "SparkListenerTaskEnd"]
        assert ran
        assert {task["Executor ID"] for task in ran} <= {"0", "1"}
        assert not any(task["Failed"] for task in ran)
    # Each worker started a process for every application, and each rendered one of the two detectors.
    for name in ("one", "two"):
        assert len(list((folder / name).glob("app-*/*/stderr"))) == len(SHARED)
    rendered = [event["Task Info"]["Executor ID"] for event in logs[-1] if event["Event"] == "SparkListenerTaskEnd"]
    assert set(rendered) == {"0", "1"}
    assert different(lake, local) == []


def test_a_render_that_is_killed_half_way_ends_with_the_same_bytes(local, request_file, tmp_path):
    lake = layout.resolve_lake(shutil.copytree(local, tmp_path / "lake", symlinks=True))
    for name in ("products", "rendered_truth"):
        shutil.rmtree(lake / name)
    script = "jobs/render/render_exposures.py"
    driver = subprocess.Popen(
        command(script, lake, request_file, "--master", "local[1]"),
        cwd="/", start_new_session=True, env=environment(), stdout=subprocess.DEVNULL,
    )  # fmt: skip
    while not list(lake.glob("products/.receipts-*/[!.]*.json")):
        assert driver.poll() is None
        time.sleep(0.05)
    os.killpg(driver.pid, signal.SIGKILL)
    driver.wait()
    assert layout.current_key(lake, "products") is None
    submit(script, lake, request_file)
    log = max((lake / "runs").glob("*-products-*.jsonl"), key=lambda path: path.stat().st_mtime_ns)
    assert sum("part" in event for event in events(log)) == 1
    assert different(lake, local) == []
