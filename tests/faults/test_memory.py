"""Workers that are killed for their memory: the job says so in one line, and the next run gives the same bytes.

tests/truesky/running/test_submitted_job.py has a short version, in which a worker ends by itself.
"""

import os
import shutil
import signal
import subprocess
import threading
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from lake_schema.store import layout
from tests import requests
from tests.cluster import below, command, different, environment, submit
from truesky.commands import run

pytestmark = [pytest.mark.spark, pytest.mark.nightly]

# Memory above which a worker is killed, bytes. A VIS detector needs 1.3 GB or more.
LIMIT = 500_000_000
RENDER = "jobs/render/render_exposures.py"
WANTED = f"""
accuracy = "draft"
{requests.shallow(21.0, 20.0)}
[[pointing]]
channel = "VIS"
camera = "vis"
band = "euclid_vis"
ra = 53.117
dec = -27.808
centre_on = "3-4"
detectors = ["3-4", "3-3"]
mjd = 60905.0
"""


def memory_of_worker(pid):
    """Return the resident memory of a Python process of Spark, bytes; 0 for other processes."""
    with suppress(OSError):
        if b"pyspark" in Path(f"/proc/{pid}/cmdline").read_bytes():
            return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return 0


@contextmanager
def watched(parent):
    """Kill every worker below a process that needs more than `LIMIT`; yield the list of those that were killed."""
    killed, done = [], threading.Event()

    def watch():
        while not done.wait(0.02):
            for pid in below(parent):
                if memory_of_worker(pid) > LIMIT:
                    with suppress(ProcessLookupError):
                        os.kill(pid, signal.SIGKILL)
                        killed.append(pid)

    thread = threading.Thread(target=watch)
    thread.start()
    try:
        yield killed
    finally:
        done.set()
        thread.join()


def test_workers_that_are_killed_for_their_memory(tmp_path):
    request_file = requests.written(tmp_path, WANTED, area=requests.FIELD.format(0.2), name="tight", seed=12)
    undisturbed = layout.resolve_lake(tmp_path / "undisturbed")
    for stage in (*run.CATALOGUES, *run.IMAGES):
        package, name = stage.module.split(".")[1:]
        if f"jobs/{package}/{name}.py" == RENDER:
            lake = layout.resolve_lake(shutil.copytree(undisturbed, tmp_path / "lake", symlinks=True))
        submit(f"jobs/{package}/{name}.py", undisturbed, request_file)
    with subprocess.Popen(
        command(RENDER, lake, request_file), cwd="/", env=environment(), text=True,
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE,
    ) as job, watched(job.pid) as killed:  # fmt: skip
        _, errors = job.communicate(timeout=3000)
    lines = [line for line in errors.splitlines() if line.startswith("render_exposures: ")]
    assert killed
    assert job.returncode == 1
    assert len(lines) == 1, errors
    assert "of 2 tasks failed" in lines[0]
    assert "its worker ended unexpectedly" in lines[0]
    assert "products" not in layout.table_names(lake)
    time.sleep(1.0)
    submit(RENDER, lake, request_file)
    assert different(lake, undisturbed) == []
