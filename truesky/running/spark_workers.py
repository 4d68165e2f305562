"""Run the process from which Spark forks its Python workers on this machine.

Spark runs python -m truesky.running.spark_workers pyspark.worker.

The process is PySpark's daemon with another handler of SIGPIPE. Java drops a worker that has been idle for a minute.
The worker then writes to a closed socket. In the Unix domain this is an error at once, which would print a traceback.
With the default handler the worker ends silently, as with any other closed pipe or socket.
"""

from __future__ import annotations

import signal

from pyspark import daemon

if __name__ == "__main__":
    signal.signal(signal.SIGPIPE, signal.SIG_DFL)
    daemon.manager()
