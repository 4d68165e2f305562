"""Measure overheads: CPU time of a task outside its rendering, and the serial CPU time of a run."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

from benchmarks import report
from lake_schema.store import layout, read
from lake_schema.store.plan import Json
from truesky.render import render_exposures
from truesky.render.exposure import render, rendered_detector
from truesky.request.schema import Request
from truesky.running import submitted_job
from truesky.running.session import get_session

# A machine of two cores is idle if the load average is below this value.
QUIET_LOAD = 0.5


def task_ms(root: Path, request: Request) -> float:
    """Return the CPU time (ms) of a task in a worker without rendering and reading sources (largest value)."""
    facts = _first_task_per_detector(root, request)
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return 1e3 * max(pool.map(_time_outside_render, [root] * len(facts), facts))


def compile_all(root: Path, request: Request) -> None:
    """Render all tasks once in another process, so that everything compiled or computed once per machine is cached."""
    _warm_up(root, _task_facts(root, request))


def _warm_up(root: Path, facts: Sequence[Json]) -> None:
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        list(pool.map(_time_task, [root] * len(facts), facts))


def _task_facts(root: Path, request: Request) -> list[Json]:
    step = render_exposures.steps(root, request)[0]
    return [{**step.plan.facts, **part.facts} for part in step.plan.tasks]


def _first_task_per_detector(root: Path, request: Request) -> Sequence[Json]:
    """Facts of one task of each detector."""
    return list({facts["detector"]: facts for facts in _task_facts(root, request)}.values())


def _time_outside_render(root: Path, facts: Json) -> float:
    """CPU time (s) of a task, with rendering and reading of sources replaced by results in memory."""
    renders: list[rendered_detector.RenderedDetector] = []
    original_render = render.render
    _run_with_render(lambda *a, **k: renders.append(original_render(*a, **k)) or renders[0], root, facts)  # type: ignore[func-returns-value]
    read_rows, rows = read.Version.rows_in_cells, {}

    def from_memory(version, *arguments):  # type: ignore[no-untyped-def]
        key = version.table, str(arguments)
        if key not in rows:
            rows[key] = read_rows(version, *arguments)
        return rows[key]

    read.Version.rows_in_cells = from_memory  # type: ignore[method-assign]
    try:
        return report.best_time(
            lambda: _run_with_render(lambda *a, **k: renders[0], root, facts), 15, time.process_time
        )
    finally:
        read.Version.rows_in_cells = read_rows  # type: ignore[method-assign]


def _run_with_render(function, root: Path, facts: Json) -> None:  # type: ignore[no-untyped-def]
    original, render.render = render.render, function
    try:
        render_exposures.render_task(root, facts)
    finally:
        render.render = original


def _time_task(root: Path, facts: Json) -> float:
    started = time.process_time()
    render_exposures.render_task(root, facts)
    return time.process_time() - started


def cpu_shares(root: Path, request: Request) -> dict[str, float]:
    """Return the share of the driver (Python and Java, after its start) in the CPU time of a render job.

    The speed-up by two cores follows from this share. The time of Java within tasks counts as time of the driver. If
    the machine is idle, the speed-up is also measured by wall time.
    """
    _warm_up(root, _first_task_per_detector(root, request))
    spark = get_session("benchmark of production")
    spark.range(2).count()
    java = spark.sparkContext._gateway.proc.pid
    earlier_logs = set(layout.runs_folder(root).glob("*.jsonl"))
    start, java_start = time.process_time(), _cpu(java)
    submitted_job.run(render_exposures.JOB, root, request)
    serial = time.process_time() - start + _cpu(java) - java_start
    logs = set(layout.runs_folder(root).glob("*.jsonl")) - earlier_logs
    lines = [json.loads(line) for log in logs for line in log.read_text().splitlines()]
    tasks = sum(line["cpu_s"] for line in lines if "part" in line)
    share = serial / (serial + tasks)
    figures = {
        "serial_share": share,
        "speedup_2_cores": 1.0 / (share + 0.5 * (1.0 - share)),
        "job_cpu_s": serial + tasks,
    }
    return figures | (wall_clock_speedup(root, request) if os.getloadavg()[0] < QUIET_LOAD else {})


def _cpu(pid: int) -> float:
    """CPU time (s) of a process until now."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def wall_clock_speedup(root: Path, request: Request, tasks: int = 16) -> dict[str, float]:
    """Measure the speed-up by two cores in warm workers.

    Parameters
    ----------
    root : Path
        Folder of the lake.
    request : Request
        The request.
    tasks : int, optional
        Number of detectors to render.

    Returns
    -------
    dict of str to float
        `wall_2_cores` (wall time with one core / with two) and `two_cores_cpu` (CPU time with two cores / with one).
    """
    facts = [_first_task_per_detector(root, request)[-1]] * tasks
    seconds, cpu = {}, {}
    for cores in (1, 2):
        with ProcessPoolExecutor(cores, get_context("spawn")) as pool:
            list(pool.map(_time_task, [root] * cores, facts[:cores]))
            started = time.perf_counter()
            cpu[cores] = sum(pool.map(_time_task, [root] * tasks, facts))
            seconds[cores] = time.perf_counter() - started
    return {"wall_2_cores": seconds[1] / seconds[2], "two_cores_cpu": cpu[2] / cpu[1]}
