"""A run in one process with one Spark session: it starts early, and ends with all its processes on Ctrl-C."""

import os
import subprocess
import sys
import time
from pathlib import Path

import pexpect
import psutil
import pytest

from lake_schema.store import read
from tests import requests
from tests.cluster import below
from truesky.commands import local_run, submit
from truesky.running import session, supervise

ROOT = Path(__file__).resolve().parents[3]


def test_the_session_starts_before_the_request_is_read(tmp_path, monkeypatch, capsys):
    calls = []
    monkeypatch.setattr(supervise, "end_with_parent", lambda: calls.append("end_with_parent"))
    monkeypatch.setattr(submit, "use_environment", lambda: calls.append("use_environment"))
    monkeypatch.setattr(session, "start_in_background", lambda name, modules: calls.append((name, len(modules))))
    assert local_run.main([str(tmp_path / "none.toml"), "--lake", str(tmp_path / "lake")]) == 2
    assert calls == ["end_with_parent", "use_environment", ("truesky", 4)]
    assert "none.toml" in capsys.readouterr().err
    assert not (tmp_path / "lake").exists()


@pytest.fixture
def command(tmp_path):
    sections = f"[fluxes]\nbands = ['euclid_vis']\n{requests.shallow(22.0, 20.0)}"
    file = requests.written(tmp_path, sections, requests.FIELD.format(0.05), name="small")
    return ["-m", "truesky.commands", "run", str(file), "--lake", str(tmp_path / "lake")]


@pytest.mark.nightly
@pytest.mark.spark
def test_ctrl_c_ends_workers_and_java_and_the_next_run_continues(tmp_path, command):
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "TERM": "xterm"}
    terminal = pexpect.spawn(
        sys.executable, command, env=environment, dimensions=(40, 150), encoding="utf-8", timeout=600
    )
    # The longest time without output is that before the first update of the display.
    terminal.expect(r"elapsed", timeout=10)
    terminal.expect_exact("galaxies: 0 of")
    processes = [psutil.Process(pid) for pid in below(terminal.pid)]
    assert sum("truesky.running.spark_workers" in " ".join(process.cmdline()) for process in processes) >= 2
    start = time.monotonic()
    terminal.sendintr()
    terminal.expect_exact("to continue, run: truesky run")
    terminal.expect(pexpect.EOF)
    terminal.wait()
    assert terminal.exitstatus == 130
    assert time.monotonic() - start < 2.0
    _, alive = psutil.wait_procs(processes, 2.0)
    assert not [process for process in alive if process.status() != psutil.STATUS_ZOMBIE]
    done = subprocess.run([sys.executable, *command], env=environment, capture_output=True, text=True, timeout=1200)
    assert done.returncode == 0, done.stderr
    assert read.version(tmp_path / "lake", "galaxy_fluxes", request="small").num_rows > 0
    # Nothing of Spark is printed.
    assert all(line.startswith("progress: ") for line in done.stderr.splitlines())
