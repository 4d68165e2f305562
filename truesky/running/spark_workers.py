"""The process from which Spark forks its Python workers on this machine.

Spark runs python -m truesky.running.spark_workers pyspark.worker.

It is PySpark's own. Java drops a worker that has been idle for a minute; the worker writes to a closed socket, which
in the Unix domain is an error at once, and would print a traceback. Here it ends without a word, as it does where any
other pipe or socket that it writes to is closed.
"""

from __future__ import annotations

import signal

from pyspark import daemon

if __name__ == "__main__":
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    daemon.manager()
