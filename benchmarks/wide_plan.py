"""A plan of the whole wide survey through spark-submit: its time, and what driver and workers hold at most.

Two caps about the Galactic poles, 34,000 fields with every exposure of Euclid's: 16 million detectors. Then the plan is
read as its readers read it, and the memory of that measured, too.
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
from truesky.render.planning import parts
from truesky.request.from_toml import parse
from truesky.running.measured import forget_peak, peak_gb

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
    "plan_s": "wall, with the start of Java (target 600 on two cores of a quiet machine)",
    "driver_gb": "Python and Java of the driver, the largest of both together (target 2)",
    "driver_python_gb": "of it Python alone",
    "worker_gb": "the largest of a worker",
    "forecast_gb": "what reading the whole plan for the forecast adds to a process",
    "chosen_gb": "what choosing a detector of a thousand exposures adds",
}
_POLL_S = 0.5


def planned(folder: Path, fields: int, cores: int) -> dict[str, float]:
    """The job, its clock, and the memory of its processes, looked at twice a second."""
    request, lake = folder / "wide.toml", folder / "lake"
    request.write_text(REQUEST.format(fields=fields))
    submit = shutil.which("spark-submit", path=str(Path(sys.executable).parent)) or "spark-submit"
    job = ROOT / "jobs" / "render" / "plan_exposures.py"
    words = [submit, "--master", f"local[{cores}]", job, "--lake", lake, "--request", request]
    most: dict[str, float] = defaultdict(float)
    started = time.perf_counter()
    with subprocess.Popen([str(word) for word in words], cwd="/", stdout=sys.stderr) as running:
        while running.poll() is None:
            for name, size in _held(running.pid).items():
                most[name] = max(most[name], size)
            time.sleep(_POLL_S)
    if running.returncode:
        raise SystemExit(f"plan_exposures ended with status {running.returncode}")
    version = read.version(layout.lake(lake), "tasks")
    return {"plan_s": time.perf_counter() - started, "tasks": version.num_rows, "parts": len(version.parts), **most}


def _held(pid: int) -> dict[str, float]:
    """GB of the driver's Python and Java together, of its Python, of the largest worker."""
    java = python = worker = 0.0
    for own in _below(pid):
        try:
            name = Path(f"/proc/{own}/cmdline").read_text().replace("\0", " ")
            held = int(Path(f"/proc/{own}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e9
        except (OSError, IndexError):
            continue
        if "truesky.running.spark_workers" in name:
            worker = max(worker, held)
        elif "plan_exposures.py" in name and "java" in name.split(" ")[0]:
            java += held
        elif "plan_exposures.py" in name and "python" in name.split(" ")[0]:
            python += held
    return {"driver_gb": java + python, "driver_python_gb": python, "worker_gb": worker}


def _below(pid: int) -> list[int]:
    """The process and those that it started."""
    parents = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            parents[int(path.parent.name)] = int(path.read_text().rpartition(")")[2].split()[1])
        except OSError:
            continue
    found = [pid]
    for one in found:
        found += [child for child, parent in parents.items() if parent == one]
    return found


def grown(reader: Callable[[Path], None], lake: Path) -> float:
    """GB that a reader adds to a process of its own."""
    forget_peak()
    before = peak_gb()
    reader(lake)
    return peak_gb() - before


def forecast(lake: Path) -> None:
    """Add up the whole plan."""
    speed.of_machine(lake)
    plan_exposures._print_published(lake, read.version(lake, "tasks"))


def chosen(lake: Path) -> None:
    """Choose one detector of each of the last thousand exposures that have it."""
    versions = {name: read.version(lake, name) for name in ("exposures", "tasks")}
    request = parse(lake.parent / "wide.toml")
    last = versions["exposures"].num_rows
    narrow = replace(request, detectors=("3-4",), limit=1000)
    parts.chosen(versions["exposures"], versions["tasks"], narrow, range(last - 10, last))


def main(argv: Sequence[str] | None = None) -> int:
    """Measures and prints."""
    options = report.options("wide_plan", __doc__ or "", argv)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        figures = planned(folder, QUICK_FIELDS if options.quick else FIELDS, 2)
        with ProcessPoolExecutor(1, get_context("spawn"), max_tasks_per_child=1) as pool:
            for key, reader in (("forecast_gb", forecast), ("chosen_gb", chosen)):
                figures[key] = pool.submit(grown, reader, layout.lake(folder / "lake")).result()
    report.finish("wide_plan", 1, figures, _NOTES, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
