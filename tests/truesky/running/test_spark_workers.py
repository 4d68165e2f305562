"""Workers that Spark no longer wants, without Java: this test speaks for it."""

import contextlib
import os
import socket
import struct
import subprocess
import sys
import tempfile
from pathlib import Path

import psutil
import pytest

from truesky.running import session, spark_workers

ROOT = Path(__file__).resolve().parents[3]


@pytest.fixture
def short():
    """A folder whose sockets' names fit."""
    with tempfile.TemporaryDirectory() as name:
        yield Path(name)


@pytest.mark.parametrize("reuse", [True, False])
def test_a_worker_that_is_dropped_says_nothing(short, reuse):
    """It answers when its socket is closed already, as that of a worker that has been idle for a minute."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "PYTHON_UNIX_DOMAIN_ENABLED": "true"}
    environment |= {"PYTHON_WORKER_FACTORY_SOCK_DIR": str(short), "PYTHON_DAEMON_KILL_WORKER_ON_FLUSH_FAILURE": "1"}
    environment |= {"SPARK_REUSE_WORKER": "1"} if reuse else {}
    command = [sys.executable, "-m", "truesky.running.spark_workers", "pyspark.worker"]
    with subprocess.Popen(
        command, cwd=ROOT, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE
    ) as daemon:
        (length,) = struct.unpack("!i", daemon.stdout.read(4))
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as java:
            java.connect(daemon.stdout.read(length).decode())
            (worker,) = struct.unpack("!i", java.recv(4, socket.MSG_WAITALL))
            assert Path(f"/proc/{worker}").exists()
        with contextlib.suppress(psutil.NoSuchProcess):
            psutil.Process(worker).wait(60)
        _, said = daemon.communicate(timeout=60)
    assert said == b""


def test_modules_for_all_workers_are_imported_once(tmp_path, monkeypatch):
    (tmp_path / "module_for_workers.py").write_text("")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv(session.PRELOADED_MODULES, "module_for_workers,json")
    spark_workers.import_worker_modules()
    assert "module_for_workers" in sys.modules
    monkeypatch.delenv(session.PRELOADED_MODULES)
    spark_workers.import_worker_modules()
