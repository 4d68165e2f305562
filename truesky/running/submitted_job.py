"""Run a job from its command line to published tables.

A job makes tables of a lake (the folder of all tables of a simulation) for a request (a user's TOML file). It has one
step per table. A step is a plan (a list of tasks with their inputs) and a function that runs one task, which writes one
file of the table. Spark transports only the names and inputs of tasks, and their receipts: records of the files
written, their time and memory. Rows are written directly to files. Only this module, session.py and spark_workers.py
use Spark.
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
from itertools import chain
from pathlib import Path
from types import FrameType
from typing import IO, TYPE_CHECKING, Any, TypeVar

from tqdm import tqdm

from lake_schema import __version__, command, instruction_set, user_files
from lake_schema.errors import BadInput, LakeError, TasksFailed
from lake_schema.store import layout, publish, read, request_links, stage
from lake_schema.store.plan import Json, Plan, Task, TaskFunction
from lake_schema.store.provenance import code_version, git_commit, machine
from truesky.command_line.parser import Parser
from truesky.command_line.simulation import add_job_arguments
from truesky.request import checks, universe
from truesky.request.from_toml import parse
from truesky.request.schema import Request
from truesky.running import progress, task_chains
from truesky.running.task_chains import LinkFunction
from truesky.running.task_metrics import WithMetrics

if TYPE_CHECKING:
    from pyspark.sql import SparkSession

Item = TypeVar("Item")
Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class Step:
    """One table that a job makes.

    Attributes
    ----------
    plan : Plan
        The table, the facts (JSON values) that determine its contents, and one task per file.
    run_task : callable
        Function (lake, facts of plan and task) -> Output that computes the rows and files of one task.
    on_driver : bool
        True to run the tasks in this process and not in Spark workers, since they are small.
    unit : str
        Word for a task in the progress bar.
    on_published : callable, optional
        Function that is called with the version of the table after it has been published.
    link_of : callable, optional
        Function that returns the place of a task in a chain of tasks, which one worker runs one after the other because
        they share data in its memory.
    """

    plan: Plan
    run_task: TaskFunction
    on_driver: bool = False
    unit: str = "part"
    on_published: Callable[[read.Version], None] | None = None
    link_of: LinkFunction | None = None


@dataclass(frozen=True, slots=True)
class Job:
    """One command that makes tables.

    Attributes
    ----------
    name : str
        Name of the command.
    doc : str
        Description in the text of its option --help.
    steps : callable
        Function (lake, request) -> steps, one per table.
    list_options : tuple of (str, str)
        Names and help texts of options that replace fields of the request with a list of texts, such as `bands`.
    integer_options : tuple of (str, str)
        Names and help texts of options that replace fields of the request with an integer, such as `limit`.
    flag_options : tuple of (str, str)
        Names and help texts of options without a value that set fields of the request to True, such as `extrapolate`.
    dry_run : callable, optional
        Function (lake, request, as_json) -> () that replaces `steps` if the option --dry-run is given. It prints a
        forecast, as JSON with the option --json. With None the job has no such options.
    number_options : tuple of (str, str)
        Names and help texts of options that replace fields of the request with a number, such as `density`.
    """

    name: str
    doc: str
    steps: Callable[[Path, Request], Sequence[Step]]
    list_options: tuple[tuple[str, str], ...] = ()
    integer_options: tuple[tuple[str, str], ...] = ()
    dry_run: Callable[[Path, Request, bool], Sequence[Step]] | None = None
    number_options: tuple[tuple[str, str], ...] = ()
    flag_options: tuple[tuple[str, str], ...] = ()


# Fields of a task's receipt (record of its files, time and memory) that a Spark worker sends to the main process.
_RESULT_FIELDS = (
    "part", "rows", "bytes", "seconds", "cpu_s", "peak_gb", "machine", "attempt", "error", "traceback"
)  # fmt: skip


# Names of the ASCII encoding in different C libraries.
_ASCII = ("ANSI_X3.4-1968", "US-ASCII", "646")
# Environment variable that is set if Java (spark-submit) has started this Python.
_GATEWAY = "PYSPARK_GATEWAY_PORT"
_RESUME_HINT = "a second run continues where this one ended"


def main(job: Job, argv: Sequence[str] | None = None) -> int:
    """Run a job with the arguments of its command line (by default sys.argv) and return the exit status.

    The status is 0 for success, 1 if a task or the operating system failed or the lake is damaged, and 2 for bad input.
    After Ctrl-C or SIGTERM the process ends at once with status 130 or 143.
    """
    options = _options(job, argv)

    def run_job() -> int:
        with _exit_on_signal(job):
            _refuse_mangled(options.lake, options.request)
            chosen_job, dry_run = job, job.dry_run
            if dry_run is not None and options.dry_run:
                chosen_job = replace(job, steps=lambda lake, request: dry_run(lake, request, options.json))
            elif dry_run is not None and options.json:
                raise BadInput("--json needs --dry-run: it prints the forecast as JSON")
            run(chosen_job, layout.resolve_lake(options.lake), _request(job, options), options.verbose)
        return 0

    return command.run(job.name, run_job)


def run(job: Job, root: Path, request: Request, verbose: bool = False) -> None:
    """Make and publish the tables of a job. Files of a table that exist already are not made again.

    Parameters
    ----------
    job : Job
        The job.
    root : Path
        Folder of the lake. It is created if it does not exist.
    request : Request
        The checked request.
    verbose : bool, optional
        True to print tracebacks and messages of Spark.

    Notes
    -----
    Errors are raised unchanged. They come from planning, such as BadInput, and from `publish.make_version`, such as
    TasksFailed if a task fails. Tables that were finished before the error remain published.
    """
    if difference := instruction_set.check():
        command.print_error(job.name, difference, 0)
    universe.check_lake(root, request)
    started, cpu = time.time(), time.process_time()
    steps = job.steps(root, request)
    if skipped := checks.describe_skipped(request):
        command.print_error(job.name, skipped, 0)
    metrics = {"prepare_s": time.time() - started, "prepare_cpu_s": time.process_time() - cpu}
    counts = [0 if step.on_driver else len(step.plan.tasks) for step in steps]
    progress.announce_tables(sum(counts))
    for i, step in enumerate(steps):
        name, parts, receipts = step.plan.table.name, len(step.plan.tasks), _receipts_folder(root, step.plan)
        with progress.table_in_work(name, step.unit, receipts, parts, sum(counts[:i])):
            _run_step(job, step, root, request, verbose, metrics)
        request_links.write_area(root, request.name, json.loads(json.dumps(request.facts("area")["area"])))
        # Record the time of planning only in the log of the first table, so that it counts once.
        metrics = {}


def common_facts(request: Request, *sections: str) -> dict[str, Any]:
    """Return facts that determine the contents of a table: the named fields of the request, and the code version.

    Raises KeyError if the request has no such field.
    """
    return {"request": request.facts(*sections), "code": code_version()}


def _options(job: Job, argv: Sequence[str] | None) -> argparse.Namespace:
    text_form = argparse.RawTextHelpFormatter
    parser = Parser(prog=job.name, description=job.doc, epilog=f"truesky {__version__}", formatter_class=text_form)
    other_options = job.integer_options, job.dry_run is not None, job.number_options, job.flag_options
    add_job_arguments(parser, job.list_options, *other_options)
    return parser.parse_args(argv)


def _refuse_mangled(*paths: str) -> None:
    """Raise BadInput for paths in which an ASCII locale has replaced letters, so that no lake gets a wrong name.

    In such a locale, Java replaces every letter outside ASCII by a question mark, so that paths with a question mark
    are refused under spark-submit. Python without Java replaces each byte of such a letter by a surrogate character.
    """
    if locale.nl_langinfo(locale.CODESET) in _ASCII:
        lost_letter = re.compile("[?]" if _GATEWAY in os.environ else "[\ud800-\udfff]")
        for path in paths:
            if lost_letter.search(path):
                raise BadInput(
                    f"{user_files.format_path(path)}: this locale supports only ASCII letters: export LC_ALL=C.UTF-8"
                )


def _request(job: Job, options: argparse.Namespace) -> Request:
    given = {name: value for name, value in vars(options).items() if value is not None}
    lists = [name for name, _ in job.list_options if name in given]
    overrides: dict[str, Any] = {name: tuple(dict.fromkeys(given[name])) for name in lists}
    single_options = (*job.integer_options, *job.number_options)
    overrides |= {name: given[name] for name, _ in single_options if name in given}
    overrides |= {name: True for name, _ in job.flag_options if given[name]}
    return replace(parse(Path(options.request)), **overrides)


@contextmanager
def _exit_on_signal(job: Job) -> Iterator[None]:
    """End the process at once if Ctrl-C or SIGTERM arrives inside the `with` block, with status 130 or 143.

    No clean-up of the lake is necessary: finished files are kept, and the next run makes only the others.
    """

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


# ------------------------------------------------------------------------------------- tables of a job and their logs


def _run_step(job: Job, step: Step, root: Path, request: Request, verbose: bool, metrics: Json) -> None:
    """Run the tasks of a step, which makes one table; then publish the table in the lake, and write a log.

    `metrics` has additional values for the first line of the log, such as the time of planning.
    """
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
                else _spark_map(run_with_metrics, tasks, job.name, verbose, step.link_of)
            )
            for result in outcome:
                results.append(result)
                log.write(result)
                yield result

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
    """Log of the making of one table, a file in LAKE/runs with one JSON object per line.

    It has one line at the start, one per task, and one at the end. If the log file cannot be created, nothing is logged
    and a message is printed at the end. There is no message if nothing was made because the lake is not writable.
    """

    def __init__(self, root: Path, job: Job, step: Step, request: Request, extra_facts: Json) -> None:
        folder = layout.runs_folder(root)
        now = datetime.now(UTC)
        self.common = {"job": job.name, "table": step.plan.table.name}
        self.problem: OSError | None = None
        self.num_lines = 0
        path = folder / f"{now:%Y%m%dT%H%M%S.%f}-{step.plan.table.name}-{os.getpid()}.jsonl"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self.stream: IO[str] = path.open("w")
        except OSError as error:
            self.problem, self.stream = error, io.StringIO()
        facts = {"started": now.isoformat(), "request": request.name, "key": step.plan.key, **extra_facts}
        self.write({**facts, "truesky": __version__, "commit": git_commit(), "parts": len(step.plan.tasks)})

    def write(self, line: Json) -> None:
        fields = {k: v for k, v in line.items() if k not in ("files", "final")}
        print(json.dumps({**self.common, **fields}), file=self.stream, flush=True)
        self.num_lines += 1

    def close(self, seconds: float, error: BaseException | None = None) -> None:
        last_line: dict[str, Any] = {"ended": datetime.now(UTC).isoformat(), "seconds": seconds, "status": "done"}
        has_results = self.num_lines > 1
        if self.problem is not None and (has_results or self.problem.errno not in layout.UNWRITABLE):
            command.print_error(self.common["job"], f"no log of this run: {self.problem}", 0)
        if error is not None:
            last_line |= {"status": "failed", "error": f"{type(error).__name__}: {error}"}
            last_line["traceback"] = "".join(traceback.format_exception(error))
        self.write(last_line)
        self.stream.close()


def _receipts_folder(root: Path, plan: Plan) -> Path:
    return stage.receipts_folder(layout.stage_folder(root, plan.table.name, plan.key))


@contextmanager
def _progress_bar(root: Path, plan: Plan, unit: str) -> Iterator[None]:
    """Show a progress bar of the tasks of a table inside the `with` block.

    The bar counts the receipt files, of which each finished task leaves one. The count therefore includes tasks of an
    interrupted run, and does not depend on Spark. The bar is hidden if stderr is not a terminal, unless the environment
    has $TRUESKY_PROGRESS.
    """
    folder = _receipts_folder(root, plan)

    def count() -> int:
        return progress.count_receipts(folder)

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
                # Wait at least 20 times as long as a count takes: counting 100,000 files loads the file system.
                wait = max(0.25, 20.0 * (time.perf_counter() - started))

        thread = threading.Thread(target=update_bar, daemon=True)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()
            bar.update(count() - bar.n)


# ------------------------------------------------------------------------------------ execution of tasks with Spark


def _spark_map(
    function: Callable[[Task], Json],
    tasks: Sequence[Task],
    name: str,
    verbose: bool,
    link_of: LinkFunction | None = None,
) -> Iterable[Json]:
    """Run a function for each task in Spark workers, and return the results.

    `link_of` returns the place of a task in a chain of tasks that one worker runs one after the other.

    If a worker process ends unexpectedly, Spark gives up all tasks. The list of tasks is then divided into halves,
    which are run separately, until the task that kills its worker is alone. The result of this task contains an error.
    Raises LakeError if Spark does not start or its Java process has ended.
    """
    from py4j.protocol import Py4JError
    from pyspark.errors import PySparkException

    from truesky.running.session import get_session, is_alive

    # Silence Spark's log unless `verbose` is True, because the command reports failures in one line.
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
            return _collect(spark, function, tasks, link_of)
    except (Py4JError, PySparkException, OSError):
        if not is_alive(spark):
            raise LakeError(f"Spark has ended; {_RESUME_HINT}") from None
        if len(tasks) == 1:
            return [{"part": tasks[0].name, "error": "its worker ended unexpectedly"}]
    half = len(tasks) // 2
    return [
        result
        for half_tasks in (tasks[:half], tasks[half:])
        for result in _spark_map(function, half_tasks, name, verbose, link_of)
    ]


def map_in_workers(function: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """Call a function for each item in the workers of this process's Spark session, else in this process.

    Parameters
    ----------
    function : callable
        Function of one item. It must be possible to call it twice, because all calls are repeated in this process if a
        worker fails. Then the error of the function is raised.
    items : sequence
        The items.

    Returns
    -------
    list
        The results, in the order of the items.
    """
    if items and has_session():
        from py4j.protocol import Py4JError
        from pyspark.errors import PySparkException

        from truesky.running.session import get_session

        with contextlib.suppress(Py4JError, PySparkException, OSError), _silence_logging():
            return list(get_session("truesky").sparkContext.parallelize(items, len(items)).map(function).collect())
    return [function(item) for item in items]


def has_session() -> bool:
    """Return True if this process has an active Spark session. PySpark is not imported for this test."""
    if "pyspark" not in sys.modules:
        return False
    from pyspark import SparkContext

    return SparkContext._active_spark_context is not None


@contextmanager
def _silence_logging() -> Iterator[None]:
    """Disable all logging inside the `with` block, because py4j logs a traceback for every interrupted call of Java."""
    previous_level = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        yield
    finally:
        logging.disable(previous_level)


def _collect(
    spark: SparkSession,
    function: Callable[[Task], Json],
    tasks: Sequence[Task],
    link_of: LinkFunction | None = None,
) -> list[Json]:
    from truesky.running.session import max_attempts

    attempts = max_attempts(spark)

    def run(partition: Iterable[list[Task]]) -> Iterator[Json]:
        from pyspark import TaskContext

        for task in chain.from_iterable(partition):
            result = function(task)
            context = TaskContext.get()
            last = context is None or context.attemptNumber() >= attempts - 1
            if "error" in result and not result.get("final") and not last:
                raise RuntimeError(result["error"])
            attempt = 1 if context is None else context.attemptNumber() + 1
            yield {
                name: value
                for name in _RESULT_FIELDS
                if (value := {**result, "attempt": attempt}.get(name)) is not None
            }
        _freeze_garbage()

    # Give each Spark task its list as its data. A list of all tasks in the function would be unpickled by every worker.
    context = spark.sparkContext
    partitions = task_chains.divide(tasks, link_of, context.defaultParallelism)
    results: list[Json] = context.parallelize(partitions, len(partitions)).mapPartitions(run).collect()
    return results


@cache
def _freeze_garbage() -> None:
    """Exclude all present objects of this worker process from garbage collection; repeated calls do nothing.

    Otherwise the garbage collection after each Spark task takes 22 ms.
    """
    gc.collect()
    gc.freeze()
