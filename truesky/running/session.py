"""Create the Spark session: the submitter's configuration plus settings that workers need to import this package.

The module sets neither master nor memory, because `builder.master` would silently override the options of spark-submit.
These settings belong in spark-defaults.conf. If the master is not local, the module adds no path or address of this
machine to the configuration.
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

# Defaults that prevent access from outside. The configuration may override them.
_SECURE_SETTINGS = {"spark.ui.enabled": "false"}
# Prefix of Spark's settings of Unix domain sockets, and the longest folder name that leaves room for Spark's own name:
# a socket's path has at most 104 characters on macOS and 108 on Linux. A longer one falls back to TCP.
_SOCKET_PREFIX, _MAX_SOCKET_DIR = "spark.python.unix.domain.socket", 56
# Spark creates a secret for a local master. The secret of a cluster must be configured on all machines
# (docs/cluster.md).
_LOCAL = re.compile(r"local(\[[^\]]*\])?")
_SECURE_LOCAL_SETTINGS = {
    "spark.driver.bindAddress": "127.0.0.1",
    "spark.driver.host": "127.0.0.1",
    "spark.authenticate": "true",
}


def get_session(name: str) -> SparkSession:
    """Return the running session, or create one with this name."""
    # PySpark 4 warns of pandas 3 once. The warning is irrelevant because no rows pass through pandas.
    warnings.filterwarnings("ignore", "PySpark does not yet fully support pandas", FutureWarning)
    # If Java is stopped in the middle of a message, its listener in this process would print a traceback. The command
    # reports the end of Java in one line.
    for listener in (accumulators.AccumulatorTCPServer, accumulators.AccumulatorUnixServer):
        listener.handle_error = _ignore_error  # type: ignore[assignment]
    SparkContext._ensure_initialized()
    conf = SparkConf()
    builder = SparkSession.builder.appName(name)
    settings = dict(_SECURE_SETTINGS)
    # Set variables in the environment because a worker may import numpy before any module of this package.
    settings |= {f"spark.executorEnv.{name}": value for name, value in instruction_set.variables().items()}
    local = _LOCAL.fullmatch(conf.get("spark.master", "local")) is not None
    if local:
        settings |= {**_SECURE_LOCAL_SETTINGS, "spark.executorEnv.PYTHONPATH": str(Path(__file__).resolve().parents[2])}
        if len(socket_dir()) <= _MAX_SOCKET_DIR:
            settings |= {f"{_SOCKET_PREFIX}.enabled": "true", f"{_SOCKET_PREFIX}.dir": socket_dir()}
            settings["spark.python.daemon.module"] = "truesky.running.spark_workers"
    # PySpark reads the workers' Python from this variable only, and would otherwise use any `python3` on PATH. Local
    # workers use the Python of this process. Other machines use the configured Python, by default the same path.
    worker_python = conf.get("spark.pyspark.python") or (None if local else os.environ.get("PYSPARK_PYTHON"))
    os.environ["PYSPARK_PYTHON"] = worker_python or sys.executable
    for key, value in settings.items():
        builder = builder if conf.contains(key) else builder.config(key, value)
    previous_handler = signal.getsignal(signal.SIGINT)
    running = builder.getOrCreate()
    if threading.current_thread() is threading.main_thread():
        # The handler of PySpark calls Java at the moment of the interrupt, which fails. Restore the previous handler.
        signal.signal(signal.SIGINT, previous_handler)
    return running


@cache
def socket_dir() -> str:
    """Return a private folder of this process for sockets between Java and its Python workers.

    Unix domain sockets are used because delayed acknowledgements of TCP cost 40 ms per task.
    """
    folder = tempfile.mkdtemp(prefix="truesky-")
    atexit.register(remove_socket_dir)
    return folder


def remove_socket_dir() -> None:
    """Remove the folder of sockets if it exists."""
    if socket_dir.cache_info().currsize:
        shutil.rmtree(socket_dir(), ignore_errors=True)


def _ignore_error(listener: object, request: object, client_address: object) -> None:
    """Replace the error handler of socketserver, which prints a traceback."""


def is_alive(spark: SparkSession) -> bool:
    """Return True if the session's Java process still answers."""
    try:
        return not spark.sparkContext._jsc.sc().isStopped()
    except (Py4JError, OSError, LookupError):
        return False
