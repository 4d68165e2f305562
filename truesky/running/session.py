"""The one SparkSession: what the submitter configured, plus what lets a worker import us.

It sets no master and no memory: `builder.master` would silently override what spark-submit was told.  Those live in
spark-defaults.conf.  Where the master is not local, no path and no address of this machine goes into the configuration.
"""

from __future__ import annotations

import atexit
import os
import re
import shutil
import signal
import sys
import tempfile
import threading
import warnings
from functools import cache
from pathlib import Path

from py4j.protocol import Py4JError
from pyspark import SparkConf, SparkContext, accumulators
from pyspark.sql import SparkSession

from lake_schema import instruction_set

# What nobody from outside may reach, wherever the configuration says nothing else.
_SECURE_SETTINGS = {"spark.ui.enabled": "false"}
# Prefix of Spark's settings of Unix domain sockets, and the longest folder name that leaves room for Spark's own name:
# a socket's path has at most 104 characters on macOS and 108 on Linux. A longer one falls back to TCP.
_SOCKET_PREFIX, _MAX_SOCKET_DIR = "spark.python.unix.domain.socket", 56
# Spark makes a secret of its own for a local master; a cluster's is told to all of its machines (docs/cluster.md).
_LOCAL = re.compile(r"local(\[[^\]]*\])?")
_SECURE_LOCAL_SETTINGS = {
    "spark.driver.bindAddress": "127.0.0.1",
    "spark.driver.host": "127.0.0.1",
    "spark.authenticate": "true",
}


def get_session(name: str) -> SparkSession:
    """The running session, or a new one under `name`."""
    # PySpark 4 warns of pandas 3 once; no row of ours passes through pandas.
    warnings.filterwarnings("ignore", "PySpark does not yet fully support pandas", FutureWarning)
    # Where Java is stopped in mid-sentence, its listener in this process would print a traceback; that it ended, and
    # what to do, is said in one line by the shell.
    for listener in (accumulators.AccumulatorTCPServer, accumulators.AccumulatorUnixServer):
        listener.handle_error = _ignore_error  # type: ignore[assignment]
    SparkContext._ensure_initialized()
    conf = SparkConf()
    builder = SparkSession.builder.appName(name)
    settings = dict(_SECURE_SETTINGS)
    # A worker's Python may import numpy before any module of ours.
    settings |= {f"spark.executorEnv.{name}": value for name, value in instruction_set.variables().items()}
    local = _LOCAL.fullmatch(conf.get("spark.master", "local")) is not None
    if local:
        settings |= {**_SECURE_LOCAL_SETTINGS, "spark.executorEnv.PYTHONPATH": str(Path(__file__).resolve().parents[2])}
        if len(socket_dir()) <= _MAX_SOCKET_DIR:
            settings |= {f"{_SOCKET_PREFIX}.enabled": "true", f"{_SOCKET_PREFIX}.dir": socket_dir()}
            settings["spark.python.daemon.module"] = "truesky.running.spark_workers"
    # PySpark looks for its workers' Python in this variable alone, and would take any `python3` that is on PATH. On
    # this machine it is our own, whatever the variable says; on others the one that was named, else of the same path.
    worker_python = conf.get("spark.pyspark.python") or (None if local else os.environ.get("PYSPARK_PYTHON"))
    os.environ["PYSPARK_PYTHON"] = worker_python or sys.executable
    for key, value in settings.items():
        builder = builder if conf.contains(key) else builder.config(key, value)
    previous_handler = signal.getsignal(signal.SIGINT)
    running = builder.getOrCreate()
    if threading.current_thread() is threading.main_thread():
        # PySpark's own handler calls Java from wherever the interrupt finds it, and fails.
        signal.signal(signal.SIGINT, previous_handler)
    return running


@cache
def socket_dir() -> str:
    """A folder of this process that nobody else may enter, for sockets between Java and its Python workers.

    Through TCP, delayed acknowledgements cost each task 40 ms.
    """
    folder = tempfile.mkdtemp(prefix="truesky-")
    atexit.register(remove_socket_dir)
    return folder


def remove_socket_dir() -> None:
    """Remove the folder of sockets, if there is one."""
    if socket_dir.cache_info().currsize:
        shutil.rmtree(socket_dir(), ignore_errors=True)


def _ignore_error(listener: object, request: object, client_address: object) -> None:
    """In place of socketserver's traceback."""


def is_alive(spark: SparkSession) -> bool:
    """Does the session's Java still answer?"""
    try:
        return not spark.sparkContext._jsc.sc().isStopped()
    except (Py4JError, OSError, LookupError):
        return False
