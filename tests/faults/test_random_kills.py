"""Runs with one to four workers and one or two threads that are killed at random moments: all lakes have equal bytes.

tests/faults/test_spark.py has a short version with a worker that dies; those of tests/faults/test_repeat.py need no
Spark.
"""

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import pytest

from lake_schema.store import layout
from tests import requests
from tests.cluster import ROOT, below, different

pytestmark = [pytest.mark.spark, pytest.mark.nightly]

RUNS = 20
# Longest time of one run, s.
PATIENCE = 3000
WANTED = f"""
accuracy = "draft"
{requests.shallow(21.0, 20.0)}
[[pointing]]
channel = "NISP-P"
camera = "nisp"
band = "euclid_h"
ra = 53.117
dec = -27.808
centre_on = "DET22"
detectors = ["DET22", "DET23"]
mjd = 60905.0

[[pointing]]
channel = "EXT"
camera = "decam"
band = "des_r"
ra = 53.117
dec = -27.808
centre_on = "N1"
detectors = ["S1", "N1"]
mjd = 60905.0
"""


def start(request_file, lake, workers, threads):
    """Start `truesky run` in its own session."""
    words = ["run", request_file, lake, "--", "--master", f"local[{workers},4]"]
    return subprocess.Popen(
        [sys.executable, "-m", "truesky.commands", *map(str, words)],
        cwd=ROOT, env={**os.environ, "OMP_NUM_THREADS": str(threads)}, start_new_session=True,
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


def is_worker(pid):
    """Return True for a Python process that computes tasks for Spark."""
    with suppress(OSError):
        # Workers on one machine have a module of this package, others that of PySpark.
        command = Path(f"/proc/{pid}/cmdline").read_bytes()
        return b"truesky.running.spark_workers" in command or b"pyspark.daemon" in command
    return False


def kill(pids):
    for pid in pids:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def kill_something(run, rng):
    """Kill all processes of a run, its first process, or one worker if there is one; return what was killed."""
    processes = sorted(below(run.pid))
    workers = [pid for pid in processes if is_worker(pid)]
    what = rng.choice(["all", "first"] + ["worker"] * 2 * bool(workers))
    kill([rng.choice(workers)] if what == "worker" else [run.pid, *processes] if what == "all" else [run.pid])
    return what


def finish(request_file, lake, workers, threads, rng, duration):
    """Make a lake; the first two attempts meet a kill at a random moment of `duration` s. Return what was killed."""
    killed = []
    for attempt in range(5):
        with start(request_file, lake, workers, threads) as run:
            if attempt < 2:
                with suppress(subprocess.TimeoutExpired):
                    run.wait(rng.uniform(0.0, duration))
                if run.poll() is None:
                    killed.append(kill_something(run, rng))
            _, errors = run.communicate(timeout=PATIENCE)
        if run.returncode == 0:
            return killed
        assert attempt < 2, errors
        assert "Traceback" not in errors
    raise AssertionError(f"{lake} is not finished after five attempts")


def test_equal_bytes_in_twenty_runs(tmp_path):
    """Compare each lake with that of one worker and one thread, which nothing disturbed."""
    request_file = requests.written(tmp_path, WANTED, area=requests.FIELD.format(0.2), name="kills", seed=13)
    undisturbed = layout.resolve_lake(tmp_path / "undisturbed")
    started = time.monotonic()
    with start(request_file, undisturbed, 1, 1) as run:
        _, errors = run.communicate(timeout=PATIENCE)
    assert run.returncode == 0, errors
    duration = time.monotonic() - started
    killed = []
    for number in range(RUNS):
        rng = random.Random(number)
        lake = layout.resolve_lake(tmp_path / f"lake {number}")
        how = (1, 2, 4)[number % 3], 1 + number % 2
        killed += finish(request_file, lake, *how, rng, duration)
        assert different(lake, undisturbed) == [], (number, how, killed)
        shutil.rmtree(lake)
    assert {"all", "first", "worker"} <= set(killed)
