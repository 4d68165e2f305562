"""How a job is started: by this environment's spark-submit, or in a session of this Python.

submit     spark-submit of one of our files
in_here    the same job in this process
stopping   what a signal does to a command that starts jobs
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import FrameType

from lake_schema import command
from lake_schema.errors import BadInput
from truesky.commands import prepare_spark
from truesky.numerics import cache

# The file that spark-submit runs, whichever the job.
_SUBMITTED = Path(__file__).resolve().parents[1] / "running" / "submitted.py"
_STOPPING = (signal.SIGINT, signal.SIGTERM)


def submit(module: str, arguments: Sequence[str], options: Sequence[str] = ()) -> int:
    """Run a job by this environment's spark-submit.

    Parameters
    ----------
    module : str
        Name of the module that has the job as `JOB`.
    arguments : sequence of str
        Command line of the job.
    options : sequence of str
        Options of spark-submit, such as --master.

    Returns
    -------
    int
        Exit status of the job.
    """
    return _call([str(_environment() / "bin" / "spark-submit"), *options, str(_SUBMITTED), module, *arguments])


def in_here(module: str, arguments: Sequence[str]) -> int:
    """Run the same job without spark-submit: a session begins when a step has work for Spark workers."""
    from truesky.running import shell

    use_environment()
    return shell.main(import_module(module).JOB, arguments)


def use_environment() -> None:
    """Let a Spark session of this process use the settings that spark-submit would use."""
    folder, spark = _environment(), find_spec("pyspark")
    if spark is not None and spark.origin is not None:
        os.environ |= {"SPARK_CONF_DIR": str(folder / "spark-conf"), "SPARK_HOME": str(Path(spark.origin).parent)}


def _environment() -> Path:
    """The folder that holds Spark's settings: .venv as `make` prepared it, else one of the cache, prepared now."""
    made = Path(sys.prefix)
    if (made / "spark-conf" / "spark-env.sh").is_file() and (made / "java" / "bin" / "java").is_file():
        return made
    spark, java = find_spec("pyspark"), prepare_spark.choose(install=False)
    if spark is None or spark.origin is None:
        raise BadInput(f"pyspark is not installed for {sys.executable}")
    if java is None:
        raise BadInput(prepare_spark.WANTED.removeprefix("truesky: "))
    home = Path(spark.origin).parent
    folder = cache.cache_dir().resolve() / f"spark-{cache.content_key(sys.executable, str(home))[:16]}"
    for path in (folder, home):
        if any(letter.isspace() for letter in str(path)):
            raise BadInput(f"{path}: Spark cannot be started from a folder with a space in its name")
    prepare_spark.prepare(folder, java, home, Path(sys.executable))
    return folder


def _call(command: Sequence[str]) -> int:
    """Exit status of a program; it is stopped where we are."""
    # A signal that arrives while the job is started is answered when there is a job to stop.
    early: list[int] = []
    handlers = {number: signal.signal(number, lambda n, _: early.append(n)) for number in _STOPPING}
    with subprocess.Popen(command) as job:
        try:
            for number, handler in handlers.items():
                signal.signal(number, handler)
            if early:
                raise KeyboardInterrupt(early[0])
            return job.wait()
        except BaseException:
            job.terminate()
            raise


@contextmanager
def stopping(name: str) -> Iterator[None]:
    """Ctrl-C and SIGTERM stop the job that runs, and end the command `name` with 130 or 143 and one line."""
    before = {number: signal.signal(number, _stop) for number in _STOPPING}
    try:
        yield
    except KeyboardInterrupt as stopped:
        number = 128 + int(stopped.args[0])
        raise SystemExit(command.say(name, "stopped; a second run continues where this one ended", number)) from None
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _stop(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt(number)
