"""Start jobs: with the spark-submit of this environment, or in a Spark session of this process."""

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

# spark-submit runs this file for every job.
_JOB_SCRIPT = Path(__file__).resolve().parents[1] / "running" / "spark_entry.py"
_STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)


def submit(module: str, arguments: Sequence[str], options: Sequence[str] = ()) -> int:
    """Run a job with the spark-submit of this environment.

    Parameters
    ----------
    module : str
        Name of the module that has the job as `JOB`.
    arguments : sequence of str
        Command line of the job.
    options : sequence of str, optional
        Options of spark-submit, such as --master.

    Returns
    -------
    int
        Exit status of the job.
    """
    return _run_program(
        [str(_spark_environment() / "bin" / "spark-submit"), *options, str(_JOB_SCRIPT), module, *arguments]
    )


def run_in_process(module: str, arguments: Sequence[str]) -> int:
    """Run a job in this process and return its exit status. A session starts only if a step needs Spark workers."""
    from truesky.running import submitted_job

    use_environment()
    return submitted_job.main(import_module(module).JOB, arguments)


def use_environment() -> None:
    """Set environment variables so that a Spark session of this process uses the settings of spark-submit."""
    folder, spark = _spark_environment(), find_spec("pyspark")
    if spark is not None and spark.origin is not None:
        os.environ |= {"SPARK_CONF_DIR": str(folder / "spark-conf"), "SPARK_HOME": str(Path(spark.origin).parent)}


def _spark_environment() -> Path:
    """Return the folder with the Spark settings: .venv if `make` prepared it, else a folder of the cache."""
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
    return folder


def _run_program(command: Sequence[str]) -> int:
    """Run a program and return its exit status; stop it if this process is interrupted."""
    # A signal that arrives while the program starts is handled once there is a process to stop.
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
def stop_on_signal(name: str) -> Iterator[None]:
    """Let Ctrl-C and SIGTERM stop the running job and end the command `name` with status 130 or 143 and a message."""
    previous_handlers = {number: signal.signal(number, _raise_interrupt) for number in _STOP_SIGNALS}
    try:
        yield
    except KeyboardInterrupt as stopped:
        number = 128 + int(stopped.args[0])
        raise SystemExit(
            command.print_error(name, "stopped; a second run continues where this one ended", number)
        ) from None
    finally:
        for number, handler in previous_handlers.items():
            signal.signal(number, handler)


def _raise_interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt(number)
