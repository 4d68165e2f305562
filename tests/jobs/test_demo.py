"""The demo's own part: what it refuses, and what it does when it is stopped.  The jobs themselves run elsewhere."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from jobs import demo
from lake_schema import __version__

ROOT = Path(__file__).resolve().parents[2]

# A job that says who it is, and waits.
_JOB = """#!/bin/sh
echo "$$"
exec sleep 600
"""
_STOPPED = """
import sys
from pathlib import Path
from jobs import demo
demo.shutil.which = lambda *args, **kwargs: sys.argv[1]
sys.exit(demo.main(["--out", sys.argv[2]]))
"""
# A signal arrives when the job runs and Popen has not returned.
_EARLY = """
import os, signal, subprocess, sys
from jobs import demo
start = subprocess.Popen._execute_child
def started(job, *rest):
    start(job, *rest)
    print(job.pid, flush=True)
    os.kill(os.getpid(), signal.SIGTERM)
subprocess.Popen._execute_child = started
signal.signal(signal.SIGTERM, demo._stop)
try:
    demo._call(["sleep", "600"])
except KeyboardInterrupt as stopped:
    sys.exit(int(stopped.args[0]))
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_demo_that_is_stopped_stops_its_job(tmp_path, number):
    job = tmp_path / "spark-submit"
    job.write_text(_JOB)
    job.chmod(0o755)
    command = [sys.executable, "-c", _STOPPED, str(job), str(tmp_path / "out")]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("SPARK_")}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, cwd=ROOT, env=environment, **pipes) as running:
        assert running.stdout.readline() == "build_galaxies ...\n"
        pid = running.stdout.readline().strip()
        running.send_signal(number)
        assert running.wait(120) == 128 + number
        assert running.stderr.read() == "demo: stopped; a second run continues where this one ended\n"
    deadline = time.monotonic() + 120
    while Path(f"/proc/{pid}").exists():
        assert time.monotonic() < deadline, "the job was left behind"
        time.sleep(0.05)


def test_a_job_is_stopped_by_a_signal_that_arrives_while_it_starts():
    done = subprocess.run(
        [sys.executable, "-c", _EARLY], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
    )
    pid = int(done.stdout)
    left = Path(f"/proc/{pid}").exists()
    if left:
        os.kill(pid, signal.SIGKILL)
    assert (done.returncode, left) == (signal.SIGTERM, False)


def test_a_folder_that_is_none_is_refused_before_the_first_job(tmp_path, capsys, monkeypatch):
    monkeypatch.delattr(demo, "_run_all")
    (tmp_path / "file").touch()
    for out in (tmp_path / "file", Path("s3://bucket/x")):
        assert demo.main(["--out", str(out)]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 2


def test_help_tells_the_version(capsys):
    with pytest.raises(SystemExit, match="0"):
        demo.main(["--help"])
    assert f"truesky {__version__}" in capsys.readouterr().out
