"""The one SparkSession: what the submitter configured, plus what lets a worker import us.

It sets no master and no memory: `builder.master` would silently override what spark-submit was told.  Those live in
spark-defaults.conf.  Where the master is not local, no path of this machine goes into the configuration.
"""

from __future__ import annotations

import signal
import sys
import threading
import warnings
from pathlib import Path

from py4j.protocol import Py4JError
from pyspark import SparkConf, SparkContext
from pyspark.sql import SparkSession


def session(name: str) -> SparkSession:
    """The running session, or a new one under `name`."""
    # PySpark 4 warns of pandas 3 once; no row of ours passes through pandas.
    warnings.filterwarnings("ignore", "PySpark does not yet fully support pandas", FutureWarning)
    SparkContext._ensure_initialized()
    conf = SparkConf()
    builder = SparkSession.builder.appName(name)
    if conf.get("spark.master", "local").startswith("local"):
        builder = builder.config("spark.executorEnv.PYTHONPATH", str(Path(__file__).resolve().parents[1]))
        if not conf.contains("spark.pyspark.python"):
            builder = builder.config("spark.pyspark.python", sys.executable)
    before = signal.getsignal(signal.SIGINT)
    running = builder.getOrCreate()
    if threading.current_thread() is threading.main_thread():
        # PySpark's own handler calls Java from wherever the interrupt finds it, and fails.
        signal.signal(signal.SIGINT, before)
    return running


def is_alive(spark: SparkSession) -> bool:
    """Does the session's Java still answer?"""
    try:
        return not spark.sparkContext._jsc.sc().isStopped()
    except (Py4JError, OSError, LookupError):
        return False
