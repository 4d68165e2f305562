"""The main run of the eighth science challenge on 100 to 10,000 cores: its makespan, and what of ours breaks first.

The tasks are those of requests/sc8_main.toml with their forecast seconds. What surrounds them is measured here: how
fast Spark hands tasks out, what a part takes of the driver's memory, and how long it takes to publish tiny parts. From
these a discrete-event simulation lays the tasks on cores of which some are slow and some die.
"""

from __future__ import annotations

import gc
import heapq
import json
import math
import resource
import sys
import tempfile
import time
import tracemalloc
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks import report
from lake_schema.arrays import Float, Int
from lake_schema.store import layout, manifest, publish, reuse, stage
from lake_schema.store.plan import Json, Part, Plan
from lake_schema.tables.products import PRODUCTS
from truesky.render import plan_exposures
from truesky.render.planning import tasks as planned
from truesky.render.products.keys import part_name
from truesky.request.from_toml import parse
from truesky.running.session import session
from truesky.running.shell import _collect

ROOT = Path(__file__).resolve().parents[1]
CORES = (100, 300, 1000, 3000, 10_000)
# Cores of a machine; of which share of machines each is how much slower, of few machines one; hours from death to death
# of one, and until it is back.  One in fifty at half speed and a death in a thousand hours are worse than sites tell.
MACHINE, SLOW, SLOWER, LIVES_H, BACK_H = 32, 0.02, 2.0, 1000.0, 0.2
# Scatter of a detector's seconds about their forecast (natural logarithm), and s of a task beside its render.
SCATTER, OVERHEAD_S = 0.25, 0.03
# Files of a part as it is written: rows, image, head, truth, and its receipt; each is made, renamed and synced.
FILES_A_PART = 5
_NOTES = {
    "tasks": "detectors of the main run, as planned",
    "core_hours": "forecast, on the machine that costs were measured on",
    "longest_s": "the longest task: no makespan is shorter",
    "spark_tasks_per_s": "empty parts through the jobs' own map, local mode: each a task of Spark with a Python worker",
    "java_tasks_per_s": "empty tasks of Java alone: the pace at which the driver hands out",
    "java_kb_a_part": "the driver's Java, of a part, after the job",
    "python_kb_a_part": "the driver's Python: the task's row and the part, while a job is prepared",
    "publish_ms_a_part": "wall: receipts read, files listed, manifest written, receipts removed",
    "publish_cpu_ms_a_part": "CPU of it",
    "manifest_kb_a_part": "of the published version",
    "manifest_load_ms_a_part": "CPU, once a process",
    "manifest_held_kb_a_part": "memory of a process that has read it",
    "manifest_peak_kb_a_part": "and while it reads",
}


# ------------------------------------------------------------------------------------------------ simulated


@dataclass(frozen=True, slots=True)
class Site:
    """So many cores on machines, what a second of the driver hands out, and whether machines are slow or die."""

    cores: int
    handed_out_per_s: float
    slow: float = SLOW
    lives_h: float = LIVES_H


@dataclass(frozen=True, slots=True)
class Outcome:
    """makespan : s;  busy : core-s of tasks that ended, of those that were lost;  again : tasks that ran twice"""

    makespan: float
    busy: float
    lost: float
    again: int

    def efficiency(self, cores: int, seconds: float) -> float:
        """Core-s of the tasks on machines that are not slow, over those that passed."""
        return seconds / (cores * self.makespan)


def simulated(seconds: Float, site: Site, rng: np.random.Generator) -> Outcome:
    """Tasks in their order, each on the core that is free first; what a machine's death interrupts is begun again.

    seconds : [n] of one core, in the order that they are handed out
    """
    machines = -(-site.cores // MACHINE)
    slow = np.isin(np.arange(machines), rng.permutation(machines)[: math.ceil(site.slow * machines)])
    dies = rng.exponential(site.lives_h * 3600.0, machines)
    if np.isfinite(site.lives_h):
        # However short a run is, one machine dies in its midst.
        dies[rng.integers(machines)] = 0.5 * seconds.sum() / site.cores
    free = [(0.0, core) for core in range(site.cores)]
    waiting = iter(range(len(seconds)))
    back: list[tuple[float, int]] = []
    driver = makespan = busy = lost = 0.0
    again, step = 0, 1.0 / site.handed_out_per_s
    while True:
        now, core = free[0]
        if back and back[0][0] <= max(now, driver):
            task = heapq.heappop(back)[1]
        elif (task := next(waiting, -1)) < 0:
            if not back:
                break
            when, task = heapq.heappop(back)
            now = max(now, when)
        driver = max(driver, now) + step
        machine = core // MACHINE
        takes = seconds[task] * (SLOWER if slow[machine] else 1.0)
        while dies[machine] < driver:
            # It died while nothing ran on it.
            dies[machine] += rng.exponential(site.lives_h * 3600.0)
        if dies[machine] < driver + takes:
            again += 1
            lost += dies[machine] - driver
            heapq.heappush(back, (dies[machine], task))
            heapq.heapreplace(free, (dies[machine] + BACK_H * 3600.0, core))
            continue
        busy += takes
        makespan = max(makespan, driver + takes)
        heapq.heapreplace(free, (driver + takes, core))
    return Outcome(makespan, busy, lost, again)


def orders(seconds: Float, exposures: Int) -> dict[str, Int]:
    """Orders in which tasks may be handed out, by name: ours, as they are observed, the shortest first."""
    return {
        "longest": np.argsort(-seconds, kind="stable"),
        "observed": np.argsort(exposures, kind="stable"),
        "shortest": np.argsort(seconds, kind="stable"),
    }


def makespans(seconds: Float, exposures: Int, rate: float, cores: Sequence[int]) -> dict[str, float]:
    """Of each number of cores and order: hours, efficiency; of ours also on machines that neither die nor are slow."""
    took = seconds * np.random.default_rng(1).lognormal(-0.5 * SCATTER**2, SCATTER, len(seconds)) + OVERHEAD_S
    figures = {}
    for many in cores:
        for name, order in orders(seconds, exposures).items():
            found = simulated(took[order], Site(many, rate), np.random.default_rng(2))
            figures[f"hours_{many}_{name}"] = found.makespan / 3600.0
            figures[f"efficiency_{many}_{name}"] = found.efficiency(many, float(seconds.sum()))
            if name == "longest":
                figures[f"again_{many}"] = found.again
        sound = simulated(
            took[orders(seconds, exposures)["longest"]], Site(many, rate, 0.0, math.inf), np.random.default_rng(2)
        )
        figures[f"hours_{many}_sound"] = sound.makespan / 3600.0
        figures[f"tasks_per_s_{many}"] = len(seconds) / sound.makespan
        figures[f"creates_per_s_{many}"] = FILES_A_PART * len(seconds) / sound.makespan
    return figures


# ------------------------------------------------------------------------------------------------ measured


def tasks(quick: bool) -> tuple[Float, Int, dict[str, float]]:
    """Seconds and exposures of the main run's tasks; figures of the plan, and of what it takes in the driver."""
    wanted = parse(ROOT / "requests" / "sc8_main.toml")
    if quick:
        few = tuple(
            replace(one, fields=4 * bool(one.fields), exposures=4 * bool(one.exposures)) for one in wanted.observations
        )
        wanted = replace(wanted, observations=few)
    planner = plan_exposures.Planner.of(None, wanted)
    some = [rows.select(["exposure_id", "detector", "seconds"]) for _, rows in planner.tables()]
    seconds, exposures = (
        np.concatenate([rows[name].to_numpy() for rows in some]) for name in ("seconds", "exposure_id")
    )
    figures = {
        "tasks": len(seconds),
        "core_hours": float(seconds.sum()) / 3600.0,
        "longest_s": float(seconds.max()),
        "plan_parts": len(planner.layout.pieces),
    }
    _, rows = next(planner.tables())
    rows = planned.in_order(rows.slice(0, 20_000))
    gc.collect()
    tracemalloc.start()
    kept = rows.to_pylist()
    parts = tuple(_part(task) for task in kept)
    figures["python_kb_a_part"] = tracemalloc.get_traced_memory()[0] / len(parts) / 1e3
    tracemalloc.stop()
    return seconds, exposures, figures


def _part(task: Json) -> Part:
    return Part(
        part_name(task), {"exposure_id": task["exposure_id"], "detector": task["detector"], reuse.PRODUCT: "0" * 64}
    )


def dispatch(parts: int) -> dict[str, float]:
    """How many empty tasks a second pass, and what they leave in the driver's Java; in local mode."""
    spark = session("benchmark of the scheduler")
    java = spark.sparkContext._jvm
    some = [
        Part(f"{i:06d}-1.parquet", {"exposure_id": i, "detector": "1", reuse.PRODUCT: "0" * 64}) for i in range(parts)
    ]

    def nothing(part: Part) -> Json:
        return {"part": part.name, "rows": 1, "bytes": 1, "seconds": 0.0, "cpu_s": 0.0, "peak_gb": 0.0, "machine": "x"}

    def held() -> float:
        java.System.gc()
        runtime = java.Runtime.getRuntime()
        return float(runtime.totalMemory() - runtime.freeMemory())

    _collect(spark, nothing, some[:64])
    spark.range(0, 64, 1, numPartitions=64).count()
    before, started = held(), time.perf_counter()
    assert len(_collect(spark, nothing, some)) == parts
    ours = time.perf_counter() - started
    after, started = held(), time.perf_counter()
    spark.sparkContext._jsc.sc().range(0, parts, 1, parts).count()
    return {
        "spark_tasks_per_s": parts / ours,
        "java_tasks_per_s": parts / (time.perf_counter() - started),
        "java_kb_a_part": max(after - before, 0.0) / parts / 1e3,
    }


def publishing(folder: Path, parts: int) -> dict[str, float]:
    """What it takes to publish so many parts whose files and receipts are there: tiny files, everything else real."""
    root = layout.lake(folder / f"lake-{parts}")
    own = tuple(_part({"exposure_id": i // 36, "detector": f"{i % 36}"}) for i in range(parts))
    plan = Plan(PRODUCTS, {"request": {"name": "tiny"}}, own)
    made = layout.stage(root, PRODUCTS.name, plan.key)
    for part in own:
        _fake(made, part)
    started, cpu = time.perf_counter(), time.process_time()
    target = publish.make(root, plan, lambda lake, facts: publish.Output(PRODUCTS.empty()), name="tiny")
    figures = {
        "publish_ms_a_part": 1e3 * (time.perf_counter() - started) / parts,
        "publish_cpu_ms_a_part": 1e3 * (time.process_time() - cpu) / parts,
        "manifest_kb_a_part": (target / manifest.MANIFEST).stat().st_size / parts / 1e3,
        "published_parts": parts,
    }
    started = time.process_time()
    assert len(manifest.load(target, PRODUCTS.name)["parts"]) == parts
    figures["manifest_load_ms_a_part"] = 1e3 * (time.process_time() - started) / parts
    figures["publish_peak_gb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9
    gc.collect()
    tracemalloc.start()
    again = manifest._read(target / manifest.MANIFEST)
    held, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    figures["manifest_held_kb_a_part"], figures["manifest_peak_kb_a_part"] = held / parts / 1e3, peak / parts / 1e3
    assert len(again["parts"]) == parts
    return figures


def _fake(made: Path, part: Part) -> None:
    files = []
    number, detector = part.facts["exposure_id"], part.facts["detector"]
    image = f"images/{number:06d}/{detector}_science"
    for relative in (f"dataset/{part.name}", f"{image}.fits", f"{image}.head", f"truth/{part.name}"):
        path = made / relative
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"x")
        files.append({"path": relative, "bytes": 1, "sha256": _SHA256_OF_X})
    receipt = {"part": part.name, "rows": 1, "files": files, "machine": "x", "span": [[image], [image]]}
    path = stage.receipts(made) / f"{part.name}.json"
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(receipt))


_SHA256_OF_X = "2d711642b726b04401627ca9fbac32f5c8530fb1903cc4db02258717921a4881"


def picture(figures: Json, file: Path) -> None:
    """Hours and efficiency against cores, of the orders; file : PNG or JPEG."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, (hours, share) = pyplot.subplots(1, 2, figsize=(10.0, 4.0), layout="constrained")
    ideal = [figures["core_hours"] / many for many in CORES]
    hours.loglog(CORES, ideal, color="0.6", linestyle=":", label="core-hours / cores")
    for name, said in (
        ("longest", "longest first (ours)"),
        ("observed", "as observed"),
        ("shortest", "shortest first"),
    ):
        hours.loglog(CORES, [figures[f"hours_{many}_{name}"] for many in CORES], marker="o", label=said)
        share.semilogx(CORES, [100.0 * figures[f"efficiency_{many}_{name}"] for many in CORES], marker="o", label=said)
    hours.loglog(
        CORES,
        [figures[f"hours_{many}_sound"] for many in CORES],
        color="k",
        linestyle="--",
        label="no machine slow or dead",
    )
    hours.set(xlabel="cores", ylabel="hours", title="makespan of the main run")
    share.set(xlabel="cores", ylabel="%", ylim=(0.0, 105.0), title="share of the cores' time that is work")
    hours.legend(fontsize=8)
    for axes in (hours, share):
        axes.grid(alpha=0.3)
    figure.savefig(file, dpi=110)
    pyplot.close(figure)


def main(argv: Sequence[str] | None = None) -> int:
    """Measures, simulates and prints everything."""
    options = report.options("scheduler", __doc__ or "", argv, picture=True)
    seconds, exposures, figures = tasks(options.quick)
    figures |= dispatch(200 if options.quick else 4000)
    with tempfile.TemporaryDirectory() as name:
        figures |= publishing(Path(name), 200 if options.quick else 10_000)
    cores = CORES[:2] if options.quick else CORES
    figures |= makespans(seconds, exposures, figures["java_tasks_per_s"], cores)
    report.finish("scheduler", 1, figures, _NOTES, options.json)
    if options.picture is not None and not options.quick:
        picture(figures, options.picture)
    return 0


if __name__ == "__main__":
    sys.exit(main())
