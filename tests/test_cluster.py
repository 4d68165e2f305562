"""The demo's jobs on a cluster of processes: a standalone master and two workers on loopback, against local mode.

Everything goes through spark-submit, as it would from a login node; what a job was told, and who did its tasks, is in
Spark's event log.
"""

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec
from pathlib import Path

import pytest

from jobs.commands import run
from lake_schema.store import layout, read

pytestmark = [pytest.mark.spark, pytest.mark.nightly]

ROOT = Path(__file__).parents[1]
JOBS = [stage.file for stage in (*run.CATALOGUES, *run.IMAGES)]
# Which of them have something for workers to do.
SHARED = [script for script in JOBS if "plan" not in script]


def environment():
    """The workers find the package where this test does."""
    spark_home = str(Path(find_spec("pyspark").origin).parent)
    return {**os.environ, "SPARK_HOME": spark_home, "PYTHONPATH": str(ROOT), "SPARK_DAEMON_MEMORY": "256m"}


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


def submit(script, lake, request_file, *options):
    command = shutil.which("spark-submit", path=str(Path(sys.executable).parent))
    done = subprocess.run(
        [command, *options, str(ROOT / script), "--lake", str(lake), "--request", str(request_file)],
        capture_output=True, text=True, cwd="/", env=environment(), timeout=3000,
    )  # fmt: skip
    assert done.returncode == 0, f"{script}: {done.stdout}{done.stderr}"


@pytest.fixture(scope="module")
def local(tmp_path_factory, request_file):
    """The lake that the five jobs make in local mode."""
    root = layout.lake(tmp_path_factory.mktemp("local") / "lake")
    for script in JOBS:
        submit(script, root, request_file)
    return root


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@contextmanager
def daemon(main_class, *arguments):
    home = Path(environment()["SPARK_HOME"])
    command = [home / "bin" / "spark-class", f"org.apache.spark.deploy.{main_class}", *arguments]
    with subprocess.Popen(
        list(map(str, command)), env=environment(), cwd="/", start_new_session=True, stdout=subprocess.DEVNULL
    ) as process:
        try:
            yield process
        finally:
            process.terminate()


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """(address of a master with two workers of one core, folder of what its applications log)."""
    port, folder = free_port(), tmp_path_factory.mktemp("cluster")
    master = f"spark://127.0.0.1:{port}"
    with ExitStack() as stack:
        stack.enter_context(daemon("master.Master", "--host", "127.0.0.1", "--port", port, "--webui-port", 0))
        deadline = time.monotonic() + 60
        while subprocess.run([sys.executable, "-c", f"import socket; socket.create_connection(('127.0.0.1', {port}))"],
                             capture_output=True).returncode:  # fmt: skip
            assert time.monotonic() < deadline, "no master"
            time.sleep(0.5)
        for name in ("one", "two"):
            (folder / name).mkdir()
            options = ("--cores", 1, "--memory", "1g", "--work-dir", folder / name, "--webui-port", 0)
            stack.enter_context(daemon("worker.Worker", "--host", "127.0.0.1", *options, master))
        (folder / "events").mkdir()
        yield master, folder


def events(path):
    return [json.loads(line) for line in path.read_text().splitlines()]


def test_the_demo_on_a_cluster_gives_the_bytes_of_one_machine(local, cluster, request_file, tmp_path):
    master, folder = cluster
    lake = layout.lake(tmp_path / "lake")
    told = {
        "spark.executor.memory": "512m",
        "spark.eventLog.enabled": "true",
        "spark.eventLog.dir": (folder / "events").as_uri(),
        "spark.eventLog.compress": "false",
        "spark.eventLog.rolling.enabled": "false",
    }
    options = [word for key, value in told.items() for word in ("--conf", f"{key}={value}")]
    for script in JOBS:
        submit(script, lake, request_file, "--master", master, *options)
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
    assert same(lake, local) == []


def same(one, other):
    """Tables whose manifests, the sha256 of every file among them, differ; every byte of one is hashed."""
    assert layout.tables(one) == layout.tables(other)
    assert len(layout.tables(one)) > 10
    versions = [{name: read.version(root, name) for name in layout.tables(root)} for root in (one, other)]
    for version in versions[0].values():
        assert read.verify(version, deep=True) == []
    texts = [{name: (v.folder / "manifest.json").read_bytes() for name, v in found.items()} for found in versions]
    return [name for name in texts[0] if texts[0][name] != texts[1][name]]


def test_a_render_that_is_killed_half_way_ends_with_the_same_bytes(local, request_file, tmp_path):
    lake = layout.lake(shutil.copytree(local, tmp_path / "lake", symlinks=True))
    for name in ("products", "rendered_truth"):
        shutil.rmtree(lake / name)
    command = shutil.which("spark-submit", path=str(Path(sys.executable).parent))
    script = ROOT / "jobs" / "render" / "render_exposures.py"
    driver = subprocess.Popen(
        [command, "--master", "local[1]", str(script), "--lake", str(lake), "--request", str(request_file)],
        cwd="/", start_new_session=True, env=environment(), stdout=subprocess.DEVNULL,
    )  # fmt: skip
    while not list(lake.glob("products/.receipts-*/*.json")):
        assert driver.poll() is None
        time.sleep(0.05)
    os.killpg(driver.pid, signal.SIGKILL)
    driver.wait()
    assert layout.current_key(lake, "products") is None
    submit(script.relative_to(ROOT), lake, request_file)
    log = max((lake / "runs").glob("*-products-*.jsonl"), key=lambda path: path.stat().st_mtime_ns)
    assert sum("part" in event for event in events(log)) == 1
    assert same(lake, local) == []
