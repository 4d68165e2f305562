"""Run the process from which Spark forks its Python workers on this machine.

Spark runs python -m truesky.running.spark_workers pyspark.worker.

The process is PySpark's daemon with another handler of SIGPIPE. Java drops a worker that has been idle for a minute.
The worker then writes to a closed socket. With a Unix domain socket this fails at once, and Python would print a
traceback. With the default handler of SIGPIPE, the worker ends silently.
"""

from __future__ import annotations

import signal

from pyspark import daemon

if __name__ == "__main__":
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    daemon.manager()
