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
from lake_schema.errors import BadInput, LakeError, PartsFailed
from lake_schema.store import layout, publish, read, stage
from lake_schema.store.plan import Json, Part, Plan, Work
from lake_schema.store.provenance import code_version, git_commit, machine
from truesky.request import checks, universe
from truesky.request.from_toml import parse
from truesky.request.schema import Request
from truesky.running.measured import Measured

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
    work: Work
    on_driver: bool = False
    unit: str = "part"
    after: Callable[[read.Version], None] | None = None


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
    options: tuple[tuple[str, str], ...] = ()
    numbers: tuple[tuple[str, str], ...] = ()
    dry_run: Callable[[Path, Request], Sequence[Step]] | None = None


# What comes back of a part.
_RESULT = (
    "part", "rows", "bytes", "seconds", "cpu_s", "peak_gb", "machine", "attempt", "error", "traceback"
)  # fmt: skip


# What the C library calls an encoding of ASCII alone.
_ASCII = ("ANSI_X3.4-1968", "US-ASCII", "646")
# Set where Java started Python.
_GATEWAY = "PYSPARK_GATEWAY_PORT"
_AGAIN = "a second run continues where this one ended"


def main(job: Job, argv: Sequence[str] | None = None) -> int:
    """Run a job from its command line; returns the exit status: 0, 1 a part failed, 2 bad input, 130/143 stopped."""
    options = _options(job, argv)

    def made() -> int:
        with _stoppable(job):
            _refuse_mangled(options.lake, str(options.request))
            chosen = replace(job, steps=job.dry_run) if job.dry_run is not None and options.dry_run else job
            run(chosen, layout.lake(options.lake), _request(job, options), options.verbose)
        return 0

    return command.status(job.name, made)


def run(job: Job, root: Path, request: Request, verbose: bool = False) -> None:
    """Make and publish every table of a job that is not there yet; raises what `publish.make` raises.

    job     : its steps;  root : folder of the lake;  request : checked;  verbose : whether progress is shown
    """
    if difference := instruction_set.check():
        command.say(job.name, difference, 0)
    universe.refuse_others(root, request)
    started, cpu = time.time(), time.process_time()
    steps = job.steps(root, request)
    if skipped := checks.skipped(request):
        command.say(job.name, skipped, 0)
    took = {"prepare_s": time.time() - started, "prepare_cpu_s": time.process_time() - cpu}
    for step in steps:
        _run(job, step, root, request, verbose, took)
        # Once a job.
        took = {}


def common_facts(request: Request, *parts: str) -> dict[str, Any]:
    """What every plan of a request holds: the named parts of the request, and the code."""
    return {"request": request.facts(*parts), "code": code_version()}


def _options(job: Job, argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog=job.name,
        description=job.doc,
        epilog=f"truesky {__version__}",
        formatter_class=argparse.RawTextHelpFormatter,
    )
    parser.add_argument("--lake", required=True, help="folder of the lake (made where it is not there)")
    parser.add_argument("--request", required=True, type=Path, help="simulation request, a TOML file")
    for name, text in job.options:
        parser.add_argument(f"--{name}", nargs="+", help=text)
    for name, text in job.numbers:
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
        lost = re.compile("[?]" if _GATEWAY in os.environ else "[\ud800-\udfff]")
        for path in paths:
            if lost.search(path):
                raise BadInput(f"{user_files.shown(path)}: this locale has no letters but ASCII: export LC_ALL=C.UTF-8")


def _request(job: Job, options: argparse.Namespace) -> Request:
    given = {name: getattr(options, name) for name, _ in job.options}
    wanted: dict[str, Any] = {name: tuple(dict.fromkeys(value)) for name, value in given.items() if value is not None}
    numbers = {name: getattr(options, name) for name, _ in job.numbers}
    wanted |= {name: value for name, value in numbers.items() if value is not None}
    return replace(parse(options.request), **wanted)


@contextmanager
def _stoppable(job: Job) -> Iterator[None]:
    """Ctrl-C and SIGTERM end the process at once: whatever it was doing, the lake is whole and the next run goes on."""

    def stop(signum: int, frame: FrameType | None) -> None:
        if (running := sys.modules.get("truesky.running.session")) is not None:
            running.remove_sockets()
        os._exit(command.say(job.name, f"stopped; {_AGAIN}", 128 + signum))

    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


# ------------------------------------------------------------------------------------------------ one step


def _run(job: Job, step: Step, root: Path, request: Request, verbose: bool, took: Json) -> None:
    """took : what else the first line of the run's log says"""
    plan, started = step.plan, time.time()
    log = _RunLog(root, job, step, request, took)
    results: list[Json] = []
    before = layout.version(root, plan.table.name, plan.key).exists()

    def mapper(function: Callable[[Part], Json], parts: Sequence[Part]) -> Iterable[Json]:
        measured = Measured(function)
        with _bar(root, plan, step.unit):
            outcome = map(measured, parts) if step.on_driver else _spark_map(measured, parts, job.name, verbose)
            for result in outcome:
                results.append(result)
                log.write(result)
                yield result

    root.mkdir(parents=True, exist_ok=True)
    try:
        publish.make(root, plan, step.work, mapper, name=request.name)
    except BaseException as error:
        log.close(time.time() - started, error)
        if verbose:
            failed = [result["traceback"] for result in results if result.get("traceback")]
            print(*(failed if isinstance(error, PartsFailed) else [traceback.format_exc()]), sep="\n", file=sys.stderr)
        raise
    log.close(time.time() - started)
    version = read.version(root, plan.table.name, plan.key)
    _summary(version, len(results), time.time() - started, before)
    machines = version.manifest["machines"]
    if machines and set(machines) != {machine()}:
        about = f"table {plan.table.name}: made on machines of other kinds than this one, so last bits may differ"
        command.say(job.name, f"{about}: here {machine()}, made on {'; '.join(machines)}", 0)
    if step.after is not None:
        step.after(version)


def _summary(version: read.Version, made: int, seconds: float, before: bool) -> None:
    size = sum(entry["bytes"] for entry in version.manifest["files"])
    note = "already there" if before else f"{version.num_rows / max(seconds, 1e-3):,.0f} rows/s"
    parts = f"{made} of {len(version.parts)} parts made"
    print(f"{version.table:16} {version.num_rows:12,} rows {size / 1e6:10.1f} MB {seconds:8.1f} s   {note}, {parts}")


class _RunLog:
    """LAKE/runs/<id>.jsonl: a line at the start, one a part, one at the end.

    A run goes on where it cannot be written.
    """

    def __init__(self, root: Path, job: Job, step: Step, request: Request, more: Json) -> None:
        folder = layout.runs(root)
        now = datetime.now(UTC)
        self.common = {"job": job.name, "table": step.plan.table.name}
        path = folder / f"{now:%Y%m%dT%H%M%S.%f}-{step.plan.table.name}-{os.getpid()}.jsonl"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self.stream: IO[str] = path.open("w")
        except OSError as error:
            command.say(job.name, f"no log of this run: {error}", 0)
            self.stream = io.StringIO()
        about = {"started": now.isoformat(), "request": request.name, "key": step.plan.key, **more}
        self.write({**about, "truesky": __version__, "commit": git_commit(), "parts": len(step.plan.parts)})

    def write(self, line: Json) -> None:
        kept = {k: v for k, v in line.items() if k not in ("files", "final")}
        print(json.dumps({**self.common, **kept}), file=self.stream, flush=True)

    def close(self, seconds: float, error: BaseException | None = None) -> None:
        about: dict[str, Any] = {"ended": datetime.now(UTC).isoformat(), "seconds": seconds, "status": "done"}
        if error is not None:
            about |= {"status": "failed", "error": f"{type(error).__name__}: {error}"}
            about["traceback"] = "".join(traceback.format_exception(error))
        self.write(about)
        self.stream.close()


@contextmanager
def _bar(root: Path, plan: Plan, unit: str) -> Iterator[None]:
    """A progress bar that counts receipts, so that it is right after a resume and under any scheduler."""
    folder = stage.receipts(layout.stage(root, plan.table.name, plan.key))

    def count() -> int:
        return sum(1 for path in folder.glob("*.json") if not path.name.startswith("."))

    quiet = not sys.stderr.isatty() and "TRUESKY_PROGRESS" not in os.environ
    with tqdm(
        total=len(plan.parts), initial=count(), desc=plan.table.name, unit=unit, disable=quiet, leave=False
    ) as bar:
        done = threading.Event()

        def follow() -> None:
            wait = 0.25
            while not done.wait(wait):
                started = time.perf_counter()
                bar.update(count() - bar.n)
                bar.refresh()
                # Where there are 100,000 receipts a look takes long, and others work on the file system.
                wait = max(0.25, 20.0 * (time.perf_counter() - started))

        thread = threading.Thread(target=follow, daemon=True)
        thread.start()
        try:
            yield
        finally:
            done.set()
            thread.join()
            bar.update(count() - bar.n)


# ------------------------------------------------------------------------------------------------ Spark


def _spark_map(function: Callable[[Part], Json], parts: Sequence[Part], name: str, verbose: bool) -> Iterable[Json]:
    """Map over parts, one Spark task each; a part that kills its worker is found by running what is left in halves."""
    from py4j.protocol import Py4JError
    from pyspark.errors import PySparkException

    from truesky.running.session import is_alive, session

    # Whatever fails is reported by us, in one line.
    quietly = contextlib.nullcontext if verbose else _hushed
    try:
        with quietly():
            spark = session(name)
            if not verbose:
                spark.sparkContext.setLogLevel("OFF")
    except (Py4JError, PySparkException, OSError) as error:
        raise LakeError(f"Spark did not start: {' '.join(str(error).split())[:300]}") from None
    try:
        with quietly():
            return _collect(spark, function, parts)
    except (Py4JError, PySparkException, OSError):
        if not is_alive(spark):
            raise LakeError(f"Spark has ended; {_AGAIN}") from None
        if len(parts) == 1:
            return [{"part": parts[0].name, "error": "its worker died"}]
    half = len(parts) // 2
    return [r for some in (parts[:half], parts[half:]) for r in _spark_map(function, some, name, verbose)]


def has_session() -> bool:
    """Return True if this process has an active Spark session already."""
    if "pyspark" not in sys.modules:
        return False
    from pyspark.sql import SparkSession

    return SparkSession.getActiveSession() is not None


@contextmanager
def _hushed() -> Iterator[None]:
    """No log lines of libraries: the bridge to Java writes a traceback for every call that is interrupted."""
    before = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        yield
    finally:
        logging.disable(before)


def _collect(spark: SparkSession, function: Callable[[Part], Json], parts: Sequence[Part]) -> list[Json]:
    tries = _tries(spark)

    def run(some: Iterable[Part]) -> Iterator[Json]:
        from pyspark import TaskContext

        for part in some:
            result = function(part)
            context = TaskContext.get()
            last = context is None or context.attemptNumber() >= tries - 1
            if "error" in result and not result.get("final") and not last:
                raise RuntimeError(result["error"])
            attempt = 1 if context is None else context.attemptNumber() + 1
            yield {name: value for name in _RESULT if (value := {**result, "attempt": attempt}.get(name)) is not None}
        _settle()

    # A task is told its own part alone: what all of them are told is unpickled by each.
    found: list[Json] = spark.sparkContext.parallelize(parts, len(parts)).mapPartitions(run).collect()
    return found


@cache
def _settle() -> None:
    """Once a worker, after its first task: Spark collects garbage after each, which takes 22 ms with all modules."""
    gc.collect()
    gc.freeze()


def _tries(spark: SparkSession) -> int:
    """How often Spark runs a failing task: F of local[N,F], 1 of local[N], spark.task.maxFailures of a cluster."""
    master = str(spark.sparkContext.master)
    local = re.fullmatch(r"local(?:\[[^,\]]+(?:,\s*(\d+))?\])?", master)
    if local:
        return int(local[1] or 1)
    return int(spark.conf.get("spark.task.maxFailures", "4") or 4)
