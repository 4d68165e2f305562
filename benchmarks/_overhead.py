"""Measure overheads of rendering jobs: CPU time of a task outside its rendering, and CPU time that is not parallel.

A task renders one detector image in a worker process of Spark.
"""

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

# A machine of two cores counts as idle if its load average is below this value.
QUIET_LOAD = 0.5


def task_ms(root: Path, request: Request) -> float:
    """Return the CPU time (ms) of a rendering task without reading the sources and without rendering the image.

    It is measured for one task of each detector of the request in another process; the largest value is returned.
    """
    facts = _first_task_per_detector(root, request)
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return 1e3 * max(pool.map(_time_outside_render, [root] * len(facts), facts))


def compile_all(root: Path, request: Request) -> None:
    """Render all images of a request once in another process.

    Compiled functions and other data that are made only once per machine are then in the cache, and later measurements
    do not include the time to make them.
    """
    _warm_up(root, _task_facts(root, request))


def _warm_up(root: Path, facts: Sequence[Json]) -> None:
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        list(pool.map(_time_task, [root] * len(facts), facts))


def _task_facts(root: Path, request: Request) -> list[Json]:
    step = render_exposures.steps(root, request)[0]
    return [{**step.plan.facts, **part.facts} for part in step.plan.tasks]


def _first_task_per_detector(root: Path, request: Request) -> Sequence[Json]:
    """Return the description of one rendering task for each detector of the request."""
    return list({facts["detector"]: facts for facts in _task_facts(root, request)}.values())


def _time_outside_render(root: Path, facts: Json) -> float:
    """Return the CPU time (s) of a rendering task without reading the sources and without rendering the image.

    The sources and the rendered image of an earlier call are kept in memory and used again. The shortest of 15 times is
    returned.
    """
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
    """Return the share of Spark's driver in the CPU time of a rendering job, and the speed-up that follows from it.

    The driver is a Python and a Java process; their start does not count. CPU time that tasks use in this Java process
    counts as the driver's. The result contains `serial_share` (the driver's share), `speedup_2_cores` (the speed-up by
    two cores if only the rest is parallel) and `job_cpu_s` (the CPU time of the job in s). If the machine is idle, the
    results of `wall_clock_speedup` are added.
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
    """Return the CPU time (s) that a process has used until now, from /proc."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def wall_clock_speedup(root: Path, request: Request, tasks: int = 16) -> dict[str, float]:
    """Measure the wall time of rendering on one and on two cores, in processes that have rendered before.

    Parameters
    ----------
    root : Path
        Folder of a lake with the catalogues and the plan of the request.
    request : Request
        The request.
    tasks : int, optional
        Number of times that the same detector image is rendered.

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
