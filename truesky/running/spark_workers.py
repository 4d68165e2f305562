"""Run the process from which Spark forks its Python workers on this machine.

Spark runs python -m truesky.running.spark_workers pyspark.worker.

The process is PySpark's daemon with another handler of SIGPIPE. Java drops a worker that has been idle for a minute.
The worker then writes to a closed socket. With a Unix domain socket this fails at once, and Python would print a
traceback. With the default handler of SIGPIPE, the worker ends silently.

The process also imports the modules that the environment variable TRUESKY_WORKER_MODULES names. All workers that are
forked from it then have them.
"""

from __future__ import annotations

import os
import signal
from importlib import import_module

from pyspark import daemon

from truesky.running import supervise
from truesky.running.session import PRELOADED_MODULES


def import_worker_modules() -> None:
    """Import the modules that the environment names for all workers."""
    for name in filter(None, os.environ.get(PRELOADED_MODULES, "").split(",")):
        import_module(name)


if __name__ == "__main__":
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    import_worker_modules()
    os.setpgid(0, 0)
    supervise.register_process_group()
    daemon.manager()
