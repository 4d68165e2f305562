"""What surrounds a detector's physics: CPU of a task beside its render, and of a run that no second core can share."""

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
from truesky.render.exposure import render, rendered
from truesky.request.schema import Request
from truesky.running import shell
from truesky.running.session import session

# Load average below which a machine of two cores is quiet.
QUIET = 0.5


def task_ms(root: Path, wanted: Request) -> float:
    """CPU ms of a task beside its render and the reading of its sources, the largest of the channels'; in a worker."""
    facts = _first_of_each(root, wanted)
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        return 1e3 * max(pool.map(_beside_render, [root] * len(facts), facts))


def compile_all(root: Path, wanted: Request) -> None:
    """Render once what is compiled or computed once a machine, in a process that leaves its memory when it ends."""
    _warm(root, _facts(root, wanted))


def _warm(root: Path, facts: Sequence[Json]) -> None:
    with ProcessPoolExecutor(1, get_context("spawn")) as pool:
        list(pool.map(_one, [root] * len(facts), facts))


def _facts(root: Path, wanted: Request) -> list[Json]:
    step = render_exposures.steps(root, wanted)[0]
    return [{**step.plan.facts, **part.facts} for part in step.plan.parts]


def _first_of_each(root: Path, wanted: Request) -> Sequence[Json]:
    """One task of each detector."""
    return list({facts["detector"]: facts for facts in _facts(root, wanted)}.values())


def _beside_render(root: Path, facts: Json) -> float:
    """CPU s of a task whose render takes none, nor the reading of its sources, which has a figure of its own."""
    kept: list[rendered.Rendered] = []
    draw = render.render
    _with_render(lambda *a, **k: kept.append(draw(*a, **k)) or kept[0], root, facts)  # type: ignore[func-returns-value]
    read_rows, rows = read.Version.in_cells, {}

    def from_memory(version, *wanted):  # type: ignore[no-untyped-def]
        which = version.table, str(wanted)
        if which not in rows:
            rows[which] = read_rows(version, *wanted)
        return rows[which]

    read.Version.in_cells = from_memory  # type: ignore[method-assign]
    try:
        return report.best(lambda: _with_render(lambda *a, **k: kept[0], root, facts), 15, time.process_time)
    finally:
        read.Version.in_cells = read_rows  # type: ignore[method-assign]


def _with_render(function, root: Path, facts: Json) -> None:  # type: ignore[no-untyped-def]
    before, render.render = render.render, function
    try:
        render_exposures.work(root, facts)
    finally:
        render.render = before


def _one(root: Path, facts: Json) -> float:
    started = time.process_time()
    render_exposures.work(root, facts)
    return time.process_time() - started


def shares(root: Path, wanted: Request) -> dict[str, float]:
    """Of a render job's CPU what its driver takes, Python and Java, after Java has started; what two cores make of it.

    Java's part in the tasks counts as the driver's. Where the machine is quiet, by the clock, too.
    """
    _warm(root, _first_of_each(root, wanted))
    spark = session("benchmark of production")
    spark.range(2).count()
    java = spark.sparkContext._gateway.proc.pid
    there = set(layout.runs(root).glob("*.jsonl"))
    began, began_java = time.process_time(), _cpu(java)
    shell.run(render_exposures.JOB, root, wanted)
    serial = time.process_time() - began + _cpu(java) - began_java
    logs = set(layout.runs(root).glob("*.jsonl")) - there
    lines = [json.loads(line) for log in logs for line in log.read_text().splitlines()]
    tasks = sum(line["cpu_s"] for line in lines if "part" in line)
    share = serial / (serial + tasks)
    figures = {
        "serial_share": share,
        "speedup_2_cores": 1.0 / (share + 0.5 * (1.0 - share)),
        "job_cpu_s": serial + tasks,
    }
    return figures | (by_the_clock(root, wanted) if os.getloadavg()[0] < QUIET else {})


def _cpu(pid: int) -> float:
    """CPU s of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def by_the_clock(root: Path, wanted: Request, tasks: int = 16) -> dict[str, float]:
    """So many detectors one after another, over the same two at a time; both in workers that are warm."""
    facts = [_first_of_each(root, wanted)[-1]] * tasks
    seconds, cpu = {}, {}
    for cores in (1, 2):
        with ProcessPoolExecutor(cores, get_context("spawn")) as pool:
            list(pool.map(_one, [root] * cores, facts[:cores]))
            started = time.perf_counter()
            cpu[cores] = sum(pool.map(_one, [root] * tasks, facts))
            seconds[cores] = time.perf_counter() - started
    return {"wall_2_cores": seconds[1] / seconds[2], "two_cores_cpu": cpu[2] / cpu[1]}
