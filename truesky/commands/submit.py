"""Start jobs (programs that make tables), with the spark-submit of this Python environment or in this process."""

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
from truesky.numerics import cache, cache_entries

# Script that spark-submit runs for every job. The name of the job's module is its first argument.
_JOB_SCRIPT = Path(__file__).resolve().parents[1] / "running" / "spark_entry.py"
_STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)


def submit(module: str, arguments: Sequence[str], options: Sequence[str] = ()) -> int:
    """Run a job with the spark-submit of this Python environment, and wait for its end.

    Parameters
    ----------
    module : str
        Name of the module that defines the job as `JOB`.
    arguments : sequence of str
        Command-line arguments of the job.
    options : sequence of str, optional
        Options of spark-submit, such as --master.

    Returns
    -------
    int
        Exit status of the job.

    Raises
    ------
    BadInput
        If PySpark or a new enough Java is not installed, or a folder of Spark has a space in its path.
    """
    return _run_program(
        [str(_spark_environment() / "bin" / "spark-submit"), *options, str(_JOB_SCRIPT), module, *arguments]
    )


def run_in_process(module: str, arguments: Sequence[str]) -> int:
    """Run a job in this process and return its exit status.

    `module` is the name of the module that defines the job as `JOB`. A Spark session starts only if a table of the job
    is computed in worker processes. Raises BadInput if PySpark or Java is missing.
    """
    from truesky.running import submitted_job

    use_environment()
    return submitted_job.main(import_module(module).JOB, arguments)


def use_environment() -> None:
    """Set $SPARK_CONF_DIR and $SPARK_HOME, so that a Spark session of this process uses the settings of spark-submit.

    Raises BadInput if PySpark or Java is missing.
    """
    folder, spark = _spark_environment(), find_spec("pyspark")
    if spark is not None and spark.origin is not None:
        os.environ |= {"SPARK_CONF_DIR": str(folder / "spark-conf"), "SPARK_HOME": str(Path(spark.origin).parent)}


def _spark_environment() -> Path:
    """Return the folder with the settings of Spark.

    It is the virtual environment if `make` has written settings there. Otherwise it is a folder of the cache, in which
    the settings are written if necessary. Raises BadInput if PySpark or a new enough Java is not installed, or if a
    path contains a space.
    """
    environment = Path(sys.prefix)
    if (environment / "spark-conf" / "spark-env.sh").is_file() and (environment / "java" / "bin" / "java").is_file():
        return environment
    spark, java = find_spec("pyspark"), prepare_spark.choose_java(install=False)
    if spark is None or spark.origin is None:
        raise BadInput(f"pyspark is not installed for {sys.executable}")
    if java is None:
        raise BadInput(prepare_spark.MISSING_JAVA.removeprefix("truesky: "))
    home = Path(spark.origin).parent
    folder = cache.cache_dir().resolve() / f"spark-{cache.content_key(sys.executable, str(home))[:16]}"
    for path in (folder, home):
        if any(letter.isspace() for letter in str(path)):
            raise BadInput(f"{path}: Spark cannot be started from a folder with a space in its name")
    prepare_spark.prepare(folder, java, home, Path(sys.executable))
    cache_entries.record_use(folder.parent, folder)
    return folder


def _run_program(command: Sequence[str]) -> int:
    """Run a program and return its exit status; terminate it if an exception, such as Ctrl-C, ends the wait."""
    # Record signals that arrive while the program starts, and handle them when there is a process to stop.
    early_signals: list[int] = []
    handlers = {number: signal.signal(number, lambda n, _: early_signals.append(n)) for number in _STOP_SIGNALS}
    with subprocess.Popen(command) as job:
        try:
            for number, handler in handlers.items():
                signal.signal(number, handler)
            if early_signals:
                raise KeyboardInterrupt(early_signals[0])
            return job.wait()
        except BaseException:
            job.terminate()
            raise


@contextmanager
def stop_on_signal(name: str, outcome: str = "a second run continues where this one ended") -> Iterator[None]:
    """Let Ctrl-C and SIGTERM end the `with` block, with the processes that it waits for, and then this process.

    A message with `name`, the name of the command, and the outcome is printed. The exit status is 130 after Ctrl-C and
    143 after SIGTERM.
    """
    previous_handlers = {number: signal.signal(number, _raise_interrupt) for number in _STOP_SIGNALS}
    try:
        yield
    except KeyboardInterrupt as stopped:
        # A process that this one started may have stopped first; its interrupt has no number.
        number = 128 + int(stopped.args[0] if stopped.args else signal.SIGINT)
        raise SystemExit(command.print_error(name, f"stopped; {outcome}", number)) from None
    finally:
        for number, handler in previous_handlers.items():
            signal.signal(number, handler)


def _raise_interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt(number)
