"""Create the Spark session, with the user's configuration and settings that worker processes need.

The module sets neither Spark's master nor its memory, because values in Python would silently override the options of
spark-submit. They belong in spark-defaults.conf. If the master is on another machine, the module adds no path or
address of this machine to the configuration. Only the path of the workers' Python is by default that of this process.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import re
import shutil
import signal
import sys
import tempfile
import threading
import warnings
from collections.abc import Sequence
from functools import cache
from pathlib import Path

from py4j.protocol import Py4JError
from pyspark import SparkConf, SparkContext, accumulators
from pyspark.errors import PySparkException
from pyspark.sql import SparkSession

from lake_schema import instruction_set
from truesky.numerics import activity

# Environment variable with names of modules, separated by commas, which the process imports from which Spark forks its
# workers.
PRELOADED_MODULES = "TRUESKY_WORKER_MODULES"
# Settings that prevent access from other machines. The user's configuration may override them.
_SECURE_SETTINGS = {"spark.ui.enabled": "false"}
# Prefix of Spark's settings for Unix domain sockets.
_SOCKET_PREFIX = "spark.python.unix.domain.socket"
# Largest length of the path of the sockets' folder, to which Spark adds a file name. The path of a socket has at most
# 104 characters on macOS and 108 on Linux. With a longer folder, TCP is used.
_MAX_SOCKET_DIR = 56
# Names of masters on this machine, such as local[4].
_LOCAL = re.compile(r"local(\[[^\]]*\])?")
# Settings for a master on this machine, for which Spark creates a secret. For a cluster, the secret must be configured
# on all machines (docs/cluster.md).
_SECURE_LOCAL_SETTINGS = {
    "spark.driver.bindAddress": "127.0.0.1",
    "spark.driver.host": "127.0.0.1",
    "spark.authenticate": "true",
    # Workers must not import modules from the folder in which the user is: its files may come from others.
    "spark.executorEnv.PYTHONSAFEPATH": "1",
}


def get_session(name: str) -> SparkSession:
    """Return the active Spark session of this process, or create one with the given application name.

    Settings of this module do not replace values in the user's configuration.
    """
    # Ignore PySpark 4's warning of pandas 3. It is irrelevant because no rows pass through pandas.
    warnings.filterwarnings("ignore", "PySpark does not yet fully support pandas", FutureWarning)
    # Silence the server that receives messages from Java: it would print a traceback if Java is stopped in the middle
    # of a message. The command reports the end of Java in one line.
    for listener in (accumulators.AccumulatorTCPServer, accumulators.AccumulatorUnixServer):
        listener.handle_error = _ignore_error  # type: ignore[assignment]
    SparkContext._ensure_initialized()
    conf = SparkConf()
    builder = SparkSession.builder.appName(name)
    settings = dict(_SECURE_SETTINGS)
    # Limit the CPU instructions that numpy and Arrow use in workers, so that results have the same bits. These
    # environment variables must be set before a worker starts: it may import numpy before any module of this package.
    variables = instruction_set.variables()
    local = _LOCAL.fullmatch(conf.get("spark.master", "local")) is not None
    if local:
        names = (activity.SETTING, PRELOADED_MODULES)
        variables |= {name: os.environ[name] for name in names if name in os.environ}
        settings |= {**_SECURE_LOCAL_SETTINGS, "spark.executorEnv.PYTHONPATH": str(Path(__file__).resolve().parents[2])}
        if activity.SETTING in os.environ:
            # The folder of the run's state is removed even if Java is killed.
            settings["spark.local.dir"] = os.environ[activity.SETTING]
        if len(socket_dir()) <= _MAX_SOCKET_DIR:
            settings |= {f"{_SOCKET_PREFIX}.enabled": "true", f"{_SOCKET_PREFIX}.dir": socket_dir()}
            settings["spark.python.daemon.module"] = "truesky.running.spark_workers"
    settings |= {f"spark.executorEnv.{name}": value for name, value in variables.items()}
    # PySpark reads the workers' Python from $PYSPARK_PYTHON only, and would otherwise use any `python3` on PATH.
    # Workers use the Python in the configuration, by default the Python of this process. If they are on other machines
    # and the configuration has no Python, a value of $PYSPARK_PYTHON is kept.
    worker_python = conf.get("spark.pyspark.python") or (None if local else os.environ.get("PYSPARK_PYTHON"))
    os.environ["PYSPARK_PYTHON"] = worker_python or sys.executable
    for key, value in settings.items():
        builder = builder if conf.contains(key) else builder.config(key, value)
    previous_handler = signal.getsignal(signal.SIGINT)
    running = builder.getOrCreate()
    if threading.current_thread() is threading.main_thread():
        # PySpark has set a handler of Ctrl-C that calls Java, which fails at the moment of an interrupt. Restore the
        # previous handler.
        signal.signal(signal.SIGINT, previous_handler)
    return running


def start_in_background(name: str, worker_modules: Sequence[str]) -> None:
    """Start the Spark session of this process and its workers in a thread, so that other work can go on.

    Parameters
    ----------
    name : str
        Name of the application.
    worker_modules : sequence of str
        Names of modules that workers import, so that the first tasks need not wait for the import.

    Notes
    -----
    `get_session` waits for the session. If the session does not start, `get_session` tries again and raises the error.
    """

    def start() -> None:
        with contextlib.suppress(Py4JError, PySparkException, OSError):
            context = get_session(name).sparkContext
            context.setLogLevel("OFF")
            # Run one empty task per core, for which Spark starts its workers.
            context.parallelize(range(context.defaultParallelism), context.defaultParallelism).foreach(_do_nothing)

    os.environ[PRELOADED_MODULES] = ",".join(worker_modules)
    threading.Thread(target=start, daemon=True).start()


def _do_nothing(number: int) -> None:
    """Do nothing in a worker."""


@cache
def socket_dir() -> str:
    """Return a temporary folder for the Unix domain sockets that connect Java and its Python workers.

    The first call creates it, and it is removed when the process ends. These sockets are used because TCP delays
    acknowledgements, which costs 40 ms per task.
    """
    # In a run, the folder lies in that of the run's state, which is removed even if this process is killed.
    folder = tempfile.mkdtemp(prefix="truesky-", dir=os.environ.get(activity.SETTING))
    atexit.register(remove_socket_dir)
    return folder


def remove_socket_dir() -> None:
    """Remove the folder of `socket_dir` and its contents, if it has been created."""
    if socket_dir.cache_info().currsize:
        shutil.rmtree(socket_dir(), ignore_errors=True)


def _ignore_error(listener: object, request: object, client_address: object) -> None:
    """Do nothing. It replaces an error handler of socketserver that prints a traceback."""


def is_alive(spark: SparkSession) -> bool:
    """Return True if the session's Java process still answers and has not stopped its Spark context."""
    try:
        java_context = spark.sparkContext._jsc
        # PySpark sets `_jsc` to None when the session is stopped in Python.
        return java_context is not None and not java_context.sc().isStopped()
    except (Py4JError, OSError, LookupError):
        return False


def max_attempts(spark: SparkSession) -> int:
    """Return the largest number of times that Spark runs a failing task.

    It is F for the master local[N,F], 1 for local[N], and otherwise the setting spark.task.maxFailures (default 4).
    """
    master = str(spark.sparkContext.master)
    local = re.fullmatch(r"local(?:\[[^,\]]+(?:,\s*(\d+))?\])?", master)
    if local:
        return int(local[1] or 1)
    return int(spark.conf.get("spark.task.maxFailures", "4") or 4)
