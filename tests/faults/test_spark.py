"""Failures under Spark: tasks that raise, workers that die, drivers that are stopped or killed."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from lake_schema.store import layout
from tests import requests
from tests.cluster import below
from tests.faults import promise, slow_job
from tests.universe import plain_plan, plain_work
from truesky.running import submitted_job
from truesky.running.submitted_job import Job, Step

pytestmark = pytest.mark.spark

SLOW_JOB = Path(slow_job.__file__)


def poisoned(root, facts):
    """Return toy rows, or fail as files `raise-N`, `die-N` and `die-once-N` in the lake require for task N."""
    part = facts["part"]
    if (root / f"raise-{part}").exists():
        raise ValueError("row 17: no such template")
    if (root / f"die-{part}").exists():
        os._exit(137)
    if (root / f"die-once-{part}").exists():
        (root / f"die-once-{part}").unlink()
        os._exit(137)
    return plain_work(root, facts)


JOB = Job("poisoned", "Toy rows.", lambda root, request: [Step(plain_plan(request.seed), poisoned)])


@pytest.fixture(scope="module")
def request_file(tmp_path_factory):
    return requests.written(tmp_path_factory.mktemp("request"), seed=2)


@pytest.fixture
def run(spark, lake, request_file, capfd):
    promise.make(lake, "plain", 1)

    def run_job():
        status = submitted_job.main(JOB, ["--lake", str(lake), "--request", str(request_file)])
        return status, capfd.readouterr().err.strip().splitlines()

    return run_job


@pytest.fixture(scope="module")
def wanted(tmp_path_factory):
    root = tmp_path_factory.mktemp("undisturbed")
    promise.make(root, "plain", 2)
    return promise.sums(root, "plain")


@pytest.mark.parametrize(
    ("harm", "words"),
    [
        ("raise-1", "1.parquet: ValueError: row 17: no such template"),
        # Four workers die, one after the other; tests/truesky/running/test_submitted_job.py has a short version.
        pytest.param("die-1", "1.parquet: its worker ended unexpectedly", marks=pytest.mark.nightly),
    ],
)
def test_a_failed_task_is_named_and_other_tasks_are_kept(run, lake, wanted, harm, words):
    (lake / harm).touch()
    status, lines = run()
    assert (status, len(lines)) == (1, 1)
    assert lines[0] == f"poisoned: table plain: 1 of 3 tasks failed: {words}"
    assert promise.current(lake, "plain") == promise.key("plain", 1)
    log = [json.loads(line) for line in max(layout.runs_folder(lake).glob("*.jsonl")).read_text().splitlines()]
    (failed,) = [line for line in log if "error" in line and "part" in line]
    assert failed["part"] == "1.parquet"
    (lake / harm).unlink()
    assert run() == (0, [])
    assert promise.sums(lake, "plain") == wanted
    log = [json.loads(line) for line in max(layout.runs_folder(lake).glob("*.jsonl")).read_text().splitlines()]
    assert [line["part"] for line in log if "part" in line] == ["1.parquet"]


def test_a_worker_that_dies_once_is_replaced(run, lake, wanted):
    (lake / "die-once-2").touch()
    assert run() == (0, [])
    assert not (lake / "die-once-2").exists()
    assert promise.sums(lake, "plain") == wanted


def started(lake, request_file):
    """Start spark-submit with the slow job in a new process group."""
    (lake / "slow").touch()
    submit = shutil.which("spark-submit", path=str(Path(sys.executable).parent))
    command = [submit, str(SLOW_JOB), "--lake", str(lake), "--request", str(request_file)]
    return subprocess.Popen(command, cwd="/", start_new_session=True, stderr=subprocess.PIPE, text=True)


def receipts(lake):
    """Return the receipts of finished tasks, without the temporary files of stopped workers (with a dot)."""
    return list(lake.glob("plain/.receipts-*/[!.]*.json"))


def past_first_receipt(lake, driver):
    deadline = time.monotonic() + 120
    while not receipts(lake):
        assert driver.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.1)


@pytest.fixture
def driver(lake, request_file):
    """A driver that runs the slow job."""
    promise.make(lake, "plain", 1)
    running = started(lake, request_file)
    yield running
    if running.poll() is None:
        os.killpg(running.pid, signal.SIGKILL)
    running.stderr.close()


# Ctrl-C reaches the whole group of a terminal, `kill` the process that was started, and kill -9 here everyone.
# tests/truesky/running/test_submitted_job.py has a short version without Java.
@pytest.mark.parametrize(
    ("number", "whom", "status"),
    [
        pytest.param(signal.SIGINT, "group", 130, id="SIGINT to the group", marks=pytest.mark.nightly),
        pytest.param(signal.SIGTERM, "driver", 143, id="SIGTERM to the driver", marks=pytest.mark.nightly),
        pytest.param(signal.SIGKILL, "group", -signal.SIGKILL, id="SIGKILL to the group", marks=pytest.mark.nightly),
    ],
)
def test_a_stopped_driver_can_be_resumed(driver, lake, spark, request_file, number, whom, status):
    past_first_receipt(lake, driver)
    left = below(driver.pid)
    assert len(left) >= 3
    stopped = time.monotonic()
    os.killpg(driver.pid, number) if whom == "group" else driver.send_signal(number)
    assert driver.wait(120) == status
    lines = driver.stderr.read().strip().splitlines()
    assert len(lines) == (0 if number == signal.SIGKILL else 1), lines
    assert all("a second run continues where this one ended" in line for line in lines)
    while any(Path(f"/proc/{pid}").exists() for pid in left):
        assert time.monotonic() - stopped < 240, "a worker was left behind"
        time.sleep(0.1)
    assert promise.current(lake, "plain") == promise.key("plain", 1)
    (lake / "slow").unlink()
    before = len(receipts(lake))
    assert submitted_job.main(slow_job.JOB, ["--lake", str(lake), "--request", str(request_file)]) == 0
    assert promise.current(lake, "plain") == plain_plan(2, parts=slow_job.PARTS).key
    last = max(layout.runs_folder(lake).glob("*.jsonl"), key=lambda path: path.stat().st_mtime_ns)
    log = [json.loads(line) for line in last.read_text().splitlines()]
    assert sum("part" in line for line in log) == slow_job.PARTS - before
