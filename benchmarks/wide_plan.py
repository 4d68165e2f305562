"""Plan the whole wide survey with spark-submit, and measure the time and the peak memory of Spark's driver and workers.

The survey consists of two caps around the Galactic poles. It has 34,000 fields with all exposures of Euclid, which are
16 million detector images. The benchmark then measures the memory of functions that read this plan.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

from benchmarks import report
from lake_schema.store import layout, read
from truesky.render import plan_exposures
from truesky.render.forecasting import speed
from truesky.render.planning import exposure_chunks
from truesky.request.from_toml import parse
from truesky.running.task_metrics import peak_memory_gb, reset_peak_memory

ROOT = Path(__file__).resolve().parents[1]
FIELDS, QUICK_FIELDS = 34_000, 600
REQUEST = """name = "wide"
seed = 1
area = {{ patches = [[192.86, 27.13, 54.0], [12.86, -27.13, 54.0]] }}

[[observation]]
channels = ["VIS", "NISP-P", "NISP-S"]
fields = {fields}
"""
_NOTES = {
    "plan_s": "wall time with the start of Java (target 600 on two cores of an idle machine)",
    "driver_gb": "peak memory of the driver, Python and Java together (target 2)",
    "driver_python_gb": "peak memory of its Python process",
    "worker_gb": "peak memory of a worker",
    "forecast_gb": "memory to read the whole plan for the forecast",
    "chosen_gb": "memory to select one detector of a thousand exposures",
}
_POLL_S = 0.5


def measure_planner(folder: Path, fields: int, cores: int) -> dict[str, float]:
    """Run the Spark job that plans a survey, and measure its wall time and the memory of its processes.

    The memory is read from /proc twice per second, so this works on Linux only.

    Parameters
    ----------
    folder : Path
        Existing folder in which the request (wide.toml) and the lake are written.
    fields : int
        Number of fields of the survey.
    cores : int
        Number of cores that Spark uses.

    Returns
    -------
    dict of str to float
        `plan_s` (wall time in s), `tasks` (number of detector images), `parts` (number of files of the plan), and peak
        memory in GB: `driver_gb` (Python and Java), `driver_python_gb` and `worker_gb` (largest worker).

    Raises
    ------
    SystemExit
        If the job fails.
    """
    request, lake = folder / "wide.toml", folder / "lake"
    request.write_text(REQUEST.format(fields=fields))
    submit = shutil.which("spark-submit", path=str(Path(sys.executable).parent)) or "spark-submit"
    job = ROOT / "jobs" / "render" / "plan_exposures.py"
    command = [submit, "--master", f"local[{cores}]", job, "--lake", lake, "--request", request]
    peaks: dict[str, float] = defaultdict(float)
    started = time.perf_counter()
    with subprocess.Popen([str(word) for word in command], cwd="/", stdout=sys.stderr) as running:
        while running.poll() is None:
            for name, size in _process_memory(running.pid).items():
                peaks[name] = max(peaks[name], size)
            time.sleep(_POLL_S)
    if running.returncode:
        raise SystemExit(f"plan_exposures ended with status {running.returncode}")
    version = read.version(layout.resolve_lake(lake), "tasks")
    return {
        "plan_s": time.perf_counter() - started,
        "tasks": version.num_rows,
        "parts": len(version.partitions),
        **peaks,
    }


def _process_memory(pid: int) -> dict[str, float]:
    """Return the present memory (GB) of the processes of a Spark job that the process `pid` has started.

    The keys are `driver_gb` (Python and Java), `driver_python_gb` and `worker_gb` (largest Python worker). Processes
    that end meanwhile are ignored.
    """
    java = python = worker = 0.0
    for process_id in _process_tree(pid):
        try:
            name = Path(f"/proc/{process_id}/cmdline").read_text().replace("\0", " ")
            resident_gb = (
                int(Path(f"/proc/{process_id}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e9
            )
        except (OSError, IndexError):
            continue
        if "truesky.running.spark_workers" in name:
            worker = max(worker, resident_gb)
        elif "plan_exposures.py" in name and "java" in name.split(" ")[0]:
            java += resident_gb
        elif "plan_exposures.py" in name and "python" in name.split(" ")[0]:
            python += resident_gb
    return {"driver_gb": java + python, "driver_python_gb": python, "worker_gb": worker}


def _process_tree(pid: int) -> list[int]:
    """Return the identifiers of a process and of all its descendants, from /proc."""
    parents = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            parents[int(path.parent.name)] = int(path.read_text().rpartition(")")[2].split()[1])
        except OSError:
            continue
    process_ids = [pid]
    for process_id in process_ids:
        process_ids += [child for child, parent in parents.items() if parent == process_id]
    return process_ids


def added_memory(reader: Callable[[Path], None], lake: Path) -> float:
    """Return the memory (GB) by which a function that reads the lake increases the peak memory of this process.

    Call this in a new process, because the peak memory of earlier work would hide the increase.
    """
    reset_peak_memory()
    initial = peak_memory_gb()
    reader(lake)
    return peak_memory_gb() - initial


def sum_plan(lake: Path) -> None:
    """Read the whole plan of a lake and print the sum of its forecast costs, as the planning job does at its end."""
    speed.estimate_speed(lake)
    plan_exposures._print_published(lake, read.version(lake, "tasks"))


def choose_detectors(lake: Path) -> None:
    """Select the rendering tasks of detector 3-4 from the plan of a lake, as the rendering job does, at most 1000.

    The request is read from wide.toml in the folder that contains the lake.
    """
    versions = {name: read.version(lake, name) for name in ("exposures", "tasks")}
    request = parse(lake.parent / "wide.toml")
    last = versions["exposures"].num_rows
    narrow = replace(request, detectors=("3-4",), limit=1000)
    exposure_chunks.select_for_rendering(versions["exposures"], versions["tasks"], narrow, range(last - 10, last))


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark with the options `argv` (default: the command line), print the results, return 0."""
    options = report.options("wide_plan", __doc__ or "", argv)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        figures = measure_planner(folder, QUICK_FIELDS if options.quick else FIELDS, 2)
        with ProcessPoolExecutor(1, get_context("spawn"), max_tasks_per_child=1) as pool:
            for key, reader in (("forecast_gb", sum_plan), ("chosen_gb", choose_detectors)):
                figures[key] = pool.submit(added_memory, reader, layout.resolve_lake(folder / "lake")).result()
    report.print_and_write("wide_plan", 1, figures, _NOTES, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
