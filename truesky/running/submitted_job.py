"""From a command line to published tables: the only file, with session.py, that knows Spark.

A job is a function (lake, request) -> steps; a step is a plan (what to make of what) and the function that makes one
part of it.  Spark carries names and facts of the parts out, and what their receipts say back; rows go straight from the
kernel to a file.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import io
import json
import locale
import logging
import os
import re
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from types import FrameType
from typing import IO, TYPE_CHECKING, Any

from tqdm import tqdm

from lake_schema import __version__, command, instruction_set, user_files
from lake_schema.errors import BadInput, LakeError, TasksFailed
from lake_schema.store import layout, publish, read, stage
from lake_schema.store.plan import Json, Plan, Task, TaskFunction
from lake_schema.store.provenance import code_version, git_commit, machine
from truesky.request import checks, universe
from truesky.request.from_toml import parse
from truesky.request.schema import Request
from truesky.running.task_metrics import WithMetrics

if TYPE_CHECKING:
    from pyspark.sql import SparkSession


@dataclass(frozen=True, slots=True)
class Step:
    """One table of a job.

    on_driver : the work is too small to be worth a trip to the workers
    unit      : what a part is, for the progress bar
    after     : told the version when it is published
    """

    plan: Plan
    run_task: TaskFunction
    on_driver: bool = False
    unit: str = "part"
    on_published: Callable[[read.Version], None] | None = None


@dataclass(frozen=True, slots=True)
class Job:
    """A job: its name, what it does (the text of --help), and its steps for a lake and a request.

    options : lists of the request, such as bands, that its command line may give instead, each with its text of help
    numbers : the same of whole numbers
    dry_run : what is done in place of the steps where only a forecast is asked for; None = there is none
    """

    name: str
    doc: str
    steps: Callable[[Path, Request], Sequence[Step]]
    list_options: tuple[tuple[str, str], ...] = ()
    integer_options: tuple[tuple[str, str], ...] = ()
    dry_run: Callable[[Path, Request], Sequence[Step]] | None = None


# What comes back of a part.
_RESULT_FIELDS = (
    "part", "rows", "bytes", "seconds", "cpu_s", "peak_gb", "machine", "attempt", "error", "traceback"
)  # fmt: skip


# What the C library calls an encoding of ASCII alone.
_ASCII = ("ANSI_X3.4-1968", "US-ASCII", "646")
# Set where Java started Python.
_GATEWAY = "PYSPARK_GATEWAY_PORT"
_RESUME_HINT = "a second run continues where this one ended"


def main(job: Job, argv: Sequence[str] | None = None) -> int:
    """Run a job from its command line; returns the exit status: 0, 1 a part failed, 2 bad input, 130/143 stopped."""
    options = _options(job, argv)

    def run_job() -> int:
        with _exit_on_signal(job):
            _refuse_mangled(options.lake, str(options.request))
            chosen_job = replace(job, steps=job.dry_run) if job.dry_run is not None and options.dry_run else job
            run(chosen_job, layout.resolve_lake(options.lake), _request(job, options), options.verbose)
        return 0

    return command.run(job.name, run_job)


def run(job: Job, root: Path, request: Request, verbose: bool = False) -> None:
    """Make and publish every table of a job that is not there yet; raises what `publish.make` raises.

    job     : its steps;  root : folder of the lake;  request : checked;  verbose : whether progress is shown
    """
    if difference := instruction_set.check():
        command.print_error(job.name, difference, 0)
    universe.check_lake(root, request)
    started, cpu = time.time(), time.process_time()
    steps = job.steps(root, request)
    if skipped := checks.describe_skipped(request):
        command.print_error(job.name, skipped, 0)
    metrics = {"prepare_s": time.time() - started, "prepare_cpu_s": time.process_time() - cpu}
    for step in steps:
        _run_step(job, step, root, request, verbose, metrics)
        # Once a job.
        metrics = {}


def common_facts(request: Request, *sections: str) -> dict[str, Any]:
    """What every plan of a request holds: the named parts of the request, and the code."""
    return {"request": request.facts(*sections), "code": code_version()}


def _options(job: Job, argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog=job.name,
        description=job.doc,
        epilog=f"truesky {__version__}",
        formatter_class=argparse.RawTextHelpFormatter,
    )
    parser.add_argument("--lake", required=True, help="folder of the lake (made where it is not there)")
    parser.add_argument("--request", required=True, type=Path, help="simulation request, a TOML file")
    for name, text in job.list_options:
        parser.add_argument(f"--{name}", nargs="+", help=text)
    for name, text in job.integer_options:
        parser.add_argument(f"--{name}", type=int, metavar="N", help=text)
    if job.dry_run is not None:
        parser.add_argument("--dry-run", action="store_true", help="print the forecast, write nothing")
    parser.add_argument("-v", "--verbose", action="store_true", help="tracebacks and Spark's own messages")
    return parser.parse_args(argv)


def _refuse_mangled(*paths: str) -> None:
    """Refuse paths that lost letters on their way here, rather than make a lake of another name.

    Where the locale is of ASCII alone Java hands a question mark on for any other letter, and nobody can tell it from
    one that was typed: spark-submit is two processes, the first ends and took the letters with it. Python, started
    without Java, keeps each byte of such a letter as a surrogate.
    """
    if locale.nl_langinfo(locale.CODESET) in _ASCII:
        lost_letter = re.compile("[?]" if _GATEWAY in os.environ else "[\ud800-\udfff]")
        for path in paths:
            if lost_letter.search(path):
                raise BadInput(
                    f"{user_files.format_path(path)}: this locale has no letters but ASCII: export LC_ALL=C.UTF-8"
                )


def _request(job: Job, options: argparse.Namespace) -> Request:
    option_values = {name: getattr(options, name) for name, _ in job.list_options}
    overrides: dict[str, Any] = {
        name: tuple(dict.fromkeys(value)) for name, value in option_values.items() if value is not None
    }
    numbers = {name: getattr(options, name) for name, _ in job.integer_options}
    overrides |= {name: value for name, value in numbers.items() if value is not None}
    return replace(parse(options.request), **overrides)


@contextmanager
def _exit_on_signal(job: Job) -> Iterator[None]:
    """Ctrl-C and SIGTERM end the process at once: whatever it was doing, the lake is whole and the next run goes on."""

    def stop(signum: int, frame: FrameType | None) -> None:
        if (running := sys.modules.get("truesky.running.session")) is not None:
            running.remove_socket_dir()
        os._exit(command.print_error(job.name, f"stopped; {_RESUME_HINT}", 128 + signum))

    previous_handlers = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in previous_handlers.items():
            signal.signal(number, handler)


# ------------------------------------------------------------------------------------------------ one step


def _run_step(job: Job, step: Step, root: Path, request: Request, verbose: bool, metrics: Json) -> None:
    """took : what else the first line of the run's log says"""
    plan, started = step.plan, time.time()
    log = _RunLog(root, job, step, request, metrics)
    results: list[Json] = []
    existed = layout.version_folder(root, plan.table.name, plan.key).exists()

    def mapper(function: Callable[[Task], Json], tasks: Sequence[Task]) -> Iterable[Json]:
        run_with_metrics = WithMetrics(function)
        with _progress_bar(root, plan, step.unit):
            outcome = (
                map(run_with_metrics, tasks)
                if step.on_driver
                else _spark_map(run_with_metrics, tasks, job.name, verbose)
            )
            for result in outcome:
                results.append(result)
                log.write(result)
                yield result

    root.mkdir(parents=True, exist_ok=True)
    try:
        publish.make_version(root, plan, step.run_task, mapper, name=request.name)
    except BaseException as error:
        log.close(time.time() - started, error)
        if verbose:
            failed = [result["traceback"] for result in results if result.get("traceback")]
            print(*(failed if isinstance(error, TasksFailed) else [traceback.format_exc()]), sep="\n", file=sys.stderr)
        raise
    log.close(time.time() - started)
    version = read.version(root, plan.table.name, plan.key)
    _print_summary(version, len(results), time.time() - started, existed)
    machines = version.manifest["machines"]
    if machines and set(machines) != {machine()}:
        note = f"table {plan.table.name}: made on machines of other kinds than this one, so last bits may differ"
        command.print_error(job.name, f"{note}: here {machine()}, made on {'; '.join(machines)}", 0)
    if step.on_published is not None:
        step.on_published(version)


def _print_summary(version: read.Version, tasks_run: int, seconds: float, existed: bool) -> None:
    size = sum(entry["bytes"] for entry in version.manifest["files"])
    note = "already there" if existed else f"{version.num_rows / max(seconds, 1e-3):,.0f} rows/s"
    parts = f"{tasks_run} of {len(version.partitions)} parts made"
    print(f"{version.table:16} {version.num_rows:12,} rows {size / 1e6:10.1f} MB {seconds:8.1f} s   {note}, {parts}")


class _RunLog:
    """LAKE/runs/<id>.jsonl: a line at the start, one a part, one at the end.

    A run goes on where it cannot be written.
    """

    def __init__(self, root: Path, job: Job, step: Step, request: Request, extra_facts: Json) -> None:
        folder = layout.runs_folder(root)
        now = datetime.now(UTC)
        self.common = {"job": job.name, "table": step.plan.table.name}
        path = folder / f"{now:%Y%m%dT%H%M%S.%f}-{step.plan.table.name}-{os.getpid()}.jsonl"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self.stream: IO[str] = path.open("w")
        except OSError as error:
            command.print_error(job.name, f"no log of this run: {error}", 0)
            self.stream = io.StringIO()
        facts = {"started": now.isoformat(), "request": request.name, "key": step.plan.key, **extra_facts}
        self.write({**facts, "truesky": __version__, "commit": git_commit(), "parts": len(step.plan.tasks)})

    def write(self, line: Json) -> None:
        fields = {k: v for k, v in line.items() if k not in ("files", "final")}
        print(json.dumps({**self.common, **fields}), file=self.stream, flush=True)

    def close(self, seconds: float, error: BaseException | None = None) -> None:
        last_line: dict[str, Any] = {"ended": datetime.now(UTC).isoformat(), "seconds": seconds, "status": "done"}
        if error is not None:
            last_line |= {"status": "failed", "error": f"{type(error).__name__}: {error}"}
            last_line["traceback"] = "".join(traceback.format_exception(error))
        self.write(last_line)
        self.stream.close()


@contextmanager
def _progress_bar(root: Path, plan: Plan, unit: str) -> Iterator[None]:
    """A progress bar that counts receipts, so that it is right after a resume and under any scheduler."""
    folder = stage.receipts_folder(layout.stage_folder(root, plan.table.name, plan.key))

    def count() -> int:
        return sum(1 for path in folder.glob("*.json") if not path.name.startswith("."))

    quiet = not sys.stderr.isatty() and "TRUESKY_PROGRESS" not in os.environ
    with tqdm(
        total=len(plan.tasks), initial=count(), desc=plan.table.name, unit=unit, disable=quiet, leave=False
    ) as bar:
        done = threading.Event()

        def update_bar() -> None:
            wait = 0.25
            while not done.wait(wait):
                started = time.perf_counter()
                bar.update(count() - bar.n)
                bar.refresh()
                # Where there are 100,000 receipts a look takes long, and others work on the file system.
                wait = max(0.25, 20.0 * (time.perf_counter() - started))

        thread = threading.Thread(target=update_bar, daemon=True)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()
            bar.update(count() - bar.n)


# ------------------------------------------------------------------------------------------------ Spark


def _spark_map(function: Callable[[Task], Json], tasks: Sequence[Task], name: str, verbose: bool) -> Iterable[Json]:
    """Map over parts, one Spark task each; a part that kills its worker is found by running what is left in halves."""
    from py4j.protocol import Py4JError
    from pyspark.errors import PySparkException

    from truesky.running.session import get_session, is_alive

    # Whatever fails is reported by us, in one line.
    quietly = contextlib.nullcontext if verbose else _silence_logging
    try:
        with quietly():
            spark = get_session(name)
            if not verbose:
                spark.sparkContext.setLogLevel("OFF")
    except (Py4JError, PySparkException, OSError) as error:
        raise LakeError(f"Spark did not start: {' '.join(str(error).split())[:300]}") from None
    try:
        with quietly():
            return _collect(spark, function, tasks)
    except (Py4JError, PySparkException, OSError):
        if not is_alive(spark):
            raise LakeError(f"Spark has ended; {_RESUME_HINT}") from None
        if len(tasks) == 1:
            return [{"part": tasks[0].name, "error": "its worker died"}]
    half = len(tasks) // 2
    return [r for half_tasks in (tasks[:half], tasks[half:]) for r in _spark_map(function, half_tasks, name, verbose)]


def has_session() -> bool:
    """Return True if this process has an active Spark session already."""
    if "pyspark" not in sys.modules:
        return False
    from pyspark.sql import SparkSession

    return SparkSession.getActiveSession() is not None


@contextmanager
def _silence_logging() -> Iterator[None]:
    """No log lines of libraries: the bridge to Java writes a traceback for every call that is interrupted."""
    previous_level = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        yield
    finally:
        logging.disable(previous_level)


def _collect(spark: SparkSession, function: Callable[[Task], Json], tasks: Sequence[Task]) -> list[Json]:
    max_attempts = _max_attempts(spark)

    def run(partition: Iterable[Task]) -> Iterator[Json]:
        from pyspark import TaskContext

        for task in partition:
            result = function(task)
            context = TaskContext.get()
            last = context is None or context.attemptNumber() >= max_attempts - 1
            if "error" in result and not result.get("final") and not last:
                raise RuntimeError(result["error"])
            attempt = 1 if context is None else context.attemptNumber() + 1
            yield {
                name: value
                for name in _RESULT_FIELDS
                if (value := {**result, "attempt": attempt}.get(name)) is not None
            }
        _freeze_garbage()

    # A task is told its own part alone: what all of them are told is unpickled by each.
    results: list[Json] = spark.sparkContext.parallelize(tasks, len(tasks)).mapPartitions(run).collect()
    return results


@cache
def _freeze_garbage() -> None:
    """Once a worker, after its first task: Spark collects garbage after each, which takes 22 ms with all modules."""
    gc.collect()
    gc.freeze()


def _max_attempts(spark: SparkSession) -> int:
    """How often Spark runs a failing task: F of local[N,F], 1 of local[N], spark.task.maxFailures of a cluster."""
    master = str(spark.sparkContext.master)
    local = re.fullmatch(r"local(?:\[[^,\]]+(?:,\s*(\d+))?\])?", master)
    if local:
        return int(local[1] or 1)
    return int(spark.conf.get("spark.task.maxFailures", "4") or 4)
