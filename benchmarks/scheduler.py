"""Simulate how long a large rendering job takes on 100 to 10,000 cores, and what limits it.

The job is the main run of Euclid's eighth science challenge. Its tasks (one per detector image) and their forecast
times follow from requests/sc8_main.toml. The benchmark first measures the rate at which Spark starts tasks, the memory
of Spark's driver per task, and the time to publish the results of tasks. A discrete-event simulation then distributes
the tasks to cores, some of which are slow or fail.
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
from lake_schema.store.plan import Json, Plan, Task
from lake_schema.tables.products import PRODUCTS
from truesky.render import plan_exposures
from truesky.render.planning import tasks as planned
from truesky.render.products.keys import part_name
from truesky.request.from_toml import parse
from truesky.running.session import get_session
from truesky.running.submitted_job import _collect

ROOT = Path(__file__).resolve().parents[1]
CORES = (100, 300, 1000, 3000, 10_000)
# Number of cores of each machine of the simulated computing site. The values of slow machines and failures below are
# more pessimistic than real sites report.
CORES_PER_MACHINE = 32
# Fraction of machines that are slow; at least one machine is slow.
SLOW_FRACTION = 0.02
# Factor by which tasks take longer on a slow machine.
SLOWDOWN = 2.0
# Mean time between failures of a machine, hours.
MEAN_LIFE_H = 1000.0
# Time after a failure until the machine works again, hours.
REPAIR_H = 0.2
# Standard deviation of ln(actual time of a task / forecast time).
SCATTER = 0.25
# Time that a task takes in addition to its forecast, s.
OVERHEAD_S = 0.03
# Number of files that a task creates, renames and syncs: table rows, image, header, true sources, and the receipt (the
# JSON file that lists the others).
FILES_PER_TASK = 5
_NOTES = {
    "tasks": "planned detectors of the main run",
    "core_hours": "forecast, on the machine where the costs were measured",
    "longest_s": "forecast of the longest task, a lower limit of the makespan",
    "spark_tasks_per_s": "empty tasks per second in local mode, with a Python worker",
    "java_tasks_per_s": "empty tasks per second without Python: the rate at which the driver dispatches",
    "java_kb_a_part": "memory of the driver's Java per task, after the job",
    "python_kb_a_part": "memory of the driver's Python per task, while a job is prepared",
    "publish_ms_a_part": "wall time per partition to read receipts, list files, write the manifest, remove receipts",
    "publish_cpu_ms_a_part": "the same, CPU",
    "manifest_kb_a_part": "size of the manifest per partition",
    "manifest_load_ms_a_part": "CPU time per partition to load the manifest, once per process",
    "manifest_held_kb_a_part": "memory per partition of the loaded manifest",
    "manifest_peak_kb_a_part": "peak memory per partition while it is loaded",
}


@dataclass(frozen=True, slots=True)
class Site:
    """Properties of a simulated computing site.

    Attributes
    ----------
    cores : int
        Number of cores.
    handed_out_per_s : float
        Largest number of tasks that Spark's driver can start per second.
    slow_fraction : float
        Fraction of machines that are slow.
    mean_life_h : float
        Mean time between failures of a machine in hours; infinity for no failures.
    """

    cores: int
    handed_out_per_s: float
    slow_fraction: float = SLOW_FRACTION
    mean_life_h: float = MEAN_LIFE_H


@dataclass(frozen=True, slots=True)
class Outcome:
    """Result of a simulated run.

    Attributes
    ----------
    makespan : float
        Time from the first start to the last end of a task, in seconds.
    busy : float
        Core-seconds spent on completed tasks.
    lost : float
        Core-seconds spent on tasks until a failure interrupted them.
    repeated : int
        Number of times that a task was interrupted.
    """

    makespan: float
    busy: float
    lost: float
    repeated: int

    def efficiency(self, cores: int, seconds: float) -> float:
        """Return the fraction of the available core-seconds that the tasks would need on machines of normal speed.

        `seconds` is the sum of the times of all tasks. The available core-seconds are `cores` times the makespan.
        """
        return seconds / (cores * self.makespan)


def simulate(seconds: Float, site: Site, rng: np.random.Generator) -> Outcome:
    """Simulate a run on a computing site with slow machines and failures.

    Each task runs on the core that is free first. If a machine fails, its tasks start again on other cores. One failure
    always happens in the middle of the run, unless `site.mean_life_h` is infinite.

    Parameters
    ----------
    seconds : float array, shape (n,)
        Times of the tasks on one core in seconds, in the order in which they are dispatched.
    site : Site
        Properties of the computing site.
    rng : Generator
        Generator of random numbers, which selects slow machines and times of failures.

    Returns
    -------
    Outcome
        Makespan, and core-seconds that were used and lost.
    """
    machines = -(-site.cores // CORES_PER_MACHINE)
    slow = np.isin(np.arange(machines), rng.permutation(machines)[: math.ceil(site.slow_fraction * machines)])
    death_time = rng.exponential(site.mean_life_h * 3600.0, machines)
    if np.isfinite(site.mean_life_h):
        # Let one machine fail in the middle of the run, so that even a short run has a failure.
        death_time[rng.integers(machines)] = 0.5 * seconds.sum() / site.cores
    free = [(0.0, core) for core in range(site.cores)]
    waiting = iter(range(len(seconds)))
    lost_tasks: list[tuple[float, int]] = []
    driver = makespan = busy = lost = 0.0
    repeated, step = 0, 1.0 / site.handed_out_per_s
    while True:
        now, core = free[0]
        if lost_tasks and lost_tasks[0][0] <= max(now, driver):
            task = heapq.heappop(lost_tasks)[1]
        elif (task := next(waiting, -1)) < 0:
            if not lost_tasks:
                break
            lost_at, task = heapq.heappop(lost_tasks)
            now = max(now, lost_at)
        driver = max(driver, now) + step
        machine = core // CORES_PER_MACHINE
        duration = seconds[task] * (SLOWDOWN if slow[machine] else 1.0)
        while death_time[machine] < driver:
            # The machine failed and was repaired while it was idle, so no task was lost. Draw its next failure.
            death_time[machine] += rng.exponential(site.mean_life_h * 3600.0)
        if death_time[machine] < driver + duration:
            repeated += 1
            lost += death_time[machine] - driver
            heapq.heappush(lost_tasks, (death_time[machine], task))
            heapq.heapreplace(free, (death_time[machine] + REPAIR_H * 3600.0, core))
            continue
        busy += duration
        makespan = max(makespan, driver + duration)
        heapq.heapreplace(free, (driver + duration, core))
    return Outcome(makespan, busy, lost, repeated)


def task_orders(seconds: Float, exposures: Int) -> dict[str, Int]:
    """Return three orders in which tasks can be started, as arrays of indices, by name.

    "longest": longest task first, which truesky uses. "observed": by number of the exposure. "shortest": shortest task
    first. `seconds` contains the forecast times of the tasks, and `exposures` the numbers of their exposures.
    """
    return {
        "longest": np.argsort(-seconds, kind="stable"),
        "observed": np.argsort(exposures, kind="stable"),
        "shortest": np.argsort(seconds, kind="stable"),
    }


def makespans(seconds: Float, exposures: Int, rate: float, cores: Sequence[int]) -> dict[str, float]:
    """Simulate runs with several numbers of cores, each with three orders of the tasks.

    Parameters
    ----------
    seconds : float array, shape (n,)
        Forecast times of the tasks in seconds.
    exposures : int array, shape (n,)
        Numbers of the exposures of the tasks.
    rate : float
        Largest number of tasks that Spark's driver can start per second.
    cores : sequence of int
        Numbers of cores to simulate.

    Returns
    -------
    dict of str to float
        `hours_<cores>_<order>` (makespan) and `efficiency_<cores>_<order>` for the orders "longest", "observed" and
        "shortest", `again_<cores>` (number of interrupted tasks), and for a site without slow machines and failures
        `hours_<cores>_sound`, `tasks_per_s_<cores>` and `creates_per_s_<cores>` (created files per second).
    """
    actual_seconds = seconds * np.random.default_rng(1).lognormal(-0.5 * SCATTER**2, SCATTER, len(seconds)) + OVERHEAD_S
    figures = {}
    for num_cores in cores:
        for name, order in task_orders(seconds, exposures).items():
            outcome = simulate(actual_seconds[order], Site(num_cores, rate), np.random.default_rng(2))
            figures[f"hours_{num_cores}_{name}"] = outcome.makespan / 3600.0
            figures[f"efficiency_{num_cores}_{name}"] = outcome.efficiency(num_cores, float(seconds.sum()))
            if name == "longest":
                figures[f"again_{num_cores}"] = outcome.repeated
        faultless = simulate(
            actual_seconds[task_orders(seconds, exposures)["longest"]],
            Site(num_cores, rate, 0.0, math.inf),
            np.random.default_rng(2),
        )
        figures[f"hours_{num_cores}_sound"] = faultless.makespan / 3600.0
        figures[f"tasks_per_s_{num_cores}"] = len(seconds) / faultless.makespan
        figures[f"creates_per_s_{num_cores}"] = FILES_PER_TASK * len(seconds) / faultless.makespan
    return figures


def planned_tasks(quick: bool) -> tuple[Float, Int, dict[str, float]]:
    """Plan the main run of Euclid's eighth science challenge, or a small part of it if `quick`.

    Return the forecast times (s) of its tasks, the numbers of their exposures, and numbers about the plan by name, such
    as `tasks` and `core_hours`.
    """
    request = parse(ROOT / "requests" / "sc8_main.toml")
    if quick:
        short_observations = tuple(
            replace(observation, fields=4 * bool(observation.fields), exposures=4 * bool(observation.exposures))
            for observation in request.observations
        )
        request = replace(request, observations=short_observations)
    planner = plan_exposures.Planner.from_request(None, request)
    plan_tables = [rows.select(["exposure_id", "detector", "seconds"]) for _, rows in planner.tables()]
    seconds, exposures = (
        np.concatenate([rows[name].to_numpy() for rows in plan_tables]) for name in ("seconds", "exposure_id")
    )
    figures = {
        "tasks": len(seconds),
        "core_hours": float(seconds.sum()) / 3600.0,
        "longest_s": float(seconds.max()),
        "plan_parts": len(planner.layout.chunks),
    }
    _, rows = next(planner.tables())
    rows = planned.sort_by_cost(rows.slice(0, 20_000))
    gc.collect()
    tracemalloc.start()
    task_rows = rows.to_pylist()
    parts = tuple(_make_part(task) for task in task_rows)
    figures["python_kb_a_part"] = tracemalloc.get_traced_memory()[0] / len(parts) / 1e3
    tracemalloc.stop()
    return seconds, exposures, figures


def _make_part(task: Json) -> Task:
    return Task(
        part_name(task), {"exposure_id": task["exposure_id"], "detector": task["detector"], reuse.PRODUCT: "0" * 64}
    )


def time_dispatch(num_tasks: int) -> dict[str, float]:
    """Measure the rate at which Spark runs empty tasks on this machine, and the memory that they leave in its driver.

    `num_tasks` is the number of tasks. The result contains tasks per second with and without Python, and the memory of
    the Java process in kB per task.
    """
    spark = get_session("benchmark of the scheduler")
    java = spark.sparkContext._jvm
    task_list = [
        Task(f"{i:06d}-1.parquet", {"exposure_id": i, "detector": "1", reuse.PRODUCT: "0" * 64})
        for i in range(num_tasks)
    ]

    def run_empty_task(part: Task) -> Json:
        return {"part": part.name, "rows": 1, "bytes": 1, "seconds": 0.0, "cpu_s": 0.0, "peak_gb": 0.0, "machine": "x"}

    def java_memory() -> float:
        java.System.gc()
        runtime = java.Runtime.getRuntime()
        return float(runtime.totalMemory() - runtime.freeMemory())

    _collect(spark, run_empty_task, task_list[:64])
    spark.range(0, 64, 1, numPartitions=64).count()
    initial_memory, started = java_memory(), time.perf_counter()
    assert len(_collect(spark, run_empty_task, task_list)) == num_tasks
    ours = time.perf_counter() - started
    final_memory, started = java_memory(), time.perf_counter()
    spark.sparkContext._jsc.sc().range(0, num_tasks, 1, num_tasks).count()
    return {
        "spark_tasks_per_s": num_tasks / ours,
        "java_tasks_per_s": num_tasks / (time.perf_counter() - started),
        "java_kb_a_part": max(final_memory - initial_memory, 0.0) / num_tasks / 1e3,
    }


def time_publishing(folder: Path, num_partitions: int) -> dict[str, float]:
    """Measure the time and memory to publish a table whose files have been written by many tasks.

    The files are tiny, and each of the `num_partitions` tasks has left a receipt (a JSON file that lists its files).
    Publishing reads the receipts, writes the manifest (the list of all files), and removes the receipts. The lake is
    made in `folder`.
    """
    root = layout.resolve_lake(folder / f"lake-{num_partitions}")
    partitions = tuple(_make_part({"exposure_id": i // 36, "detector": f"{i % 36}"}) for i in range(num_partitions))
    plan = Plan(PRODUCTS, {"request": {"name": "tiny"}}, partitions)
    stage_folder = layout.stage_folder(root, PRODUCTS.name, plan.key)
    for part in partitions:
        _write_fake_output(stage_folder, part)
    started, cpu = time.perf_counter(), time.process_time()
    target = publish.make_version(root, plan, lambda lake, facts: publish.Output(PRODUCTS.empty()), name="tiny")
    figures = {
        "publish_ms_a_part": 1e3 * (time.perf_counter() - started) / num_partitions,
        "publish_cpu_ms_a_part": 1e3 * (time.process_time() - cpu) / num_partitions,
        "manifest_kb_a_part": (target / manifest.MANIFEST).stat().st_size / num_partitions / 1e3,
        "published_parts": num_partitions,
    }
    started = time.process_time()
    assert len(manifest.load(target, PRODUCTS.name)["parts"]) == num_partitions
    figures["manifest_load_ms_a_part"] = 1e3 * (time.process_time() - started) / num_partitions
    figures["publish_peak_gb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9
    gc.collect()
    tracemalloc.start()
    loaded = manifest._read_manifest(target / manifest.MANIFEST)
    manifest_memory, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    figures["manifest_held_kb_a_part"], figures["manifest_peak_kb_a_part"] = (
        manifest_memory / num_partitions / 1e3,
        peak / num_partitions / 1e3,
    )
    assert len(loaded["parts"]) == num_partitions
    return figures


def _write_fake_output(stage_folder: Path, part: Task) -> None:
    files = []
    number, detector = part.facts["exposure_id"], part.facts["detector"]
    image = f"images/{number:06d}/{detector}_science"
    for relative in (f"dataset/{part.name}", f"{image}.fits", f"{image}.head", f"truth/{part.name}"):
        path = stage_folder / relative
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"x")
        files.append({"path": relative, "bytes": 1, "sha256": _SHA256_OF_X})
    receipt = {"part": part.name, "rows": 1, "files": files, "machine": "x", "span": [[image], [image]]}
    path = stage.receipts_folder(stage_folder) / f"{part.name}.json"
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(receipt))


_SHA256_OF_X = "2d711642b726b04401627ca9fbac32f5c8530fb1903cc4db02258717921a4881"


def draw_picture(figures: Json, file: Path) -> None:
    """Plot makespan and efficiency against the number of cores, for each order of the tasks, into a PNG or JPEG file.

    `figures` contains the results of `makespans` for all numbers in CORES, and `core_hours`.
    """
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    figure, (hours, share) = pyplot.subplots(1, 2, figsize=(10.0, 4.0), layout="constrained")
    ideal = [figures["core_hours"] / num_cores for num_cores in CORES]
    hours.loglog(CORES, ideal, color="0.6", linestyle=":", label="core-hours / cores")
    for name, label in (
        ("longest", "longest first (ours)"),
        ("observed", "as observed"),
        ("shortest", "shortest first"),
    ):
        hours.loglog(CORES, [figures[f"hours_{num_cores}_{name}"] for num_cores in CORES], marker="o", label=label)
        share.semilogx(
            CORES, [100.0 * figures[f"efficiency_{num_cores}_{name}"] for num_cores in CORES], marker="o", label=label
        )
    hours.loglog(
        CORES,
        [figures[f"hours_{num_cores}_sound"] for num_cores in CORES],
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
    """Run the benchmark with the options `argv` (default: the command line), print the results, return 0."""
    options = report.options("scheduler", __doc__ or "", argv, picture=True)
    seconds, exposures, figures = planned_tasks(options.quick)
    figures |= time_dispatch(200 if options.quick else 4000)
    with tempfile.TemporaryDirectory() as name:
        figures |= time_publishing(Path(name), 200 if options.quick else 10_000)
    cores = CORES[:2] if options.quick else CORES
    figures |= makespans(seconds, exposures, figures["java_tasks_per_s"], cores)
    report.print_and_write("scheduler", 1, figures, _NOTES, options.json)
    if options.picture is not None and not options.quick:
        draw_picture(figures, options.picture)
    return 0


if __name__ == "__main__":
    sys.exit(main())
