"""Run a cluster of processes on loopback: a standalone Spark master, workers, and submitted jobs.

Everything goes through spark-submit, as it would from a login node. The event log of Spark contains the settings of a
job and the workers that ran its tasks.
"""

import json
import os
import shutil
import socket
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager
from importlib.util import find_spec
from pathlib import Path

from lake_schema.store import layout, read

ROOT = Path(__file__).parents[1]


def environment():
    """Return an environment in which workers find the package."""
    spark_home = str(Path(find_spec("pyspark").origin).parent)
    return {**os.environ, "SPARK_HOME": spark_home, "PYTHONPATH": str(ROOT), "SPARK_DAEMON_MEMORY": "256m"}


def command(script, lake, request_file, *options):
    """Return the command line of spark-submit for a job."""
    submit = shutil.which("spark-submit", path=str(Path(sys.executable).parent))
    return [submit, *options, str(ROOT / script), "--lake", str(lake), "--request", str(request_file)]


def submit(script, lake, request_file, *options):
    done = subprocess.run(
        command(script, lake, request_file, *options),
        capture_output=True, text=True, cwd="/", env=environment(), timeout=3000,
    )  # fmt: skip
    assert done.returncode == 0, f"{script}: {done.stdout}{done.stderr}"


@contextmanager
def daemon(main_class, *arguments):
    home = Path(environment()["SPARK_HOME"])
    words = [home / "bin" / "spark-class", f"org.apache.spark.deploy.{main_class}", *arguments]
    with subprocess.Popen(
        list(map(str, words)), env=environment(), cwd="/", start_new_session=True, stdout=subprocess.DEVNULL
    ) as process:
        try:
            yield process
        finally:
            process.terminate()


@contextmanager
def running(folder, names):
    """Run a master and one worker per name, each with one core and 1 GB; yield the master's address and the workers.

    Each worker has a folder with its name below `folder`. Each has a separate host address, because Spark does not
    start a second copy of a task on the host of the first copy.
    """
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    master = f"spark://127.0.0.1:{port}"
    with ExitStack() as stack:
        stack.enter_context(daemon("master.Master", "--host", "127.0.0.1", "--port", port, "--webui-port", 0))
        deadline = time.monotonic() + 60
        while not _answers(port):
            assert time.monotonic() < deadline, "no master"
            time.sleep(0.5)
        workers = {}
        for number, name in enumerate(names, start=2):
            (folder / name).mkdir()
            options = ("--cores", 1, "--memory", "1g", "--work-dir", folder / name, "--webui-port", 0)
            host = ("--host", f"127.0.0.{number}")
            workers[name] = stack.enter_context(daemon("worker.Worker", *host, *options, master))
        yield master, workers


def _answers(port):
    try:
        socket.create_connection(("127.0.0.1", port)).close()
    except OSError:
        return False
    return True


def told(folder, **more):
    """Return options of spark-submit: little memory, an event log in `folder`, and further settings."""
    settings = {
        "spark.executor.memory": "512m",
        "spark.eventLog.enabled": "true",
        "spark.eventLog.dir": folder.as_uri(),
        "spark.eventLog.compress": "false",
        "spark.eventLog.rolling.enabled": "false",
        **more,
    }
    return [word for key, value in settings.items() for word in ("--conf", f"{key}={value}")]


def events(path):
    """Return the lines of an event log, or of the log of a run."""
    return [json.loads(line) for line in path.read_text().splitlines()]


def below(pid):
    """Return the ids of all processes below `pid`."""
    found = subprocess.run(["ps", "-eo", "pid=,ppid="], capture_output=True, text=True, check=True).stdout.split()
    tree, parents = {pid}, dict(zip(map(int, found[::2]), map(int, found[1::2]), strict=True))
    for _ in range(5):
        tree |= {child for child, parent in parents.items() if parent in tree}
    return tree - {pid}


def different(one, other):
    """Return the tables whose manifests differ, including the sha256 of every file; all bytes of one are hashed."""
    assert layout.table_names(one) == layout.table_names(other)
    assert len(layout.table_names(one)) > 10
    versions = [{name: read.version(root, name) for name in layout.table_names(root)} for root in (one, other)]
    for version in versions[0].values():
        assert read.find_faults(version, deep=True) == []
    texts = [{name: (v.folder / "manifest.json").read_bytes() for name, v in found.items()} for found in versions]
    return [name for name in texts[0] if texts[0][name] != texts[1][name]]
