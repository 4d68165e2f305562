"""Planning and what surrounds a render: seconds of a plan, overhead of a task, errors of the forecast, two cores.

The demo's two detectors are rendered from its catalogues; what they take is what jobs/render/costs.csv says.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path

from benchmarks import lake as bulk
from benchmarks import report
from jobs import request as requests
from jobs.catalogue import build_galaxies, build_stars
from jobs.fluxes import compute_fluxes
from jobs.measured import forget_peak, peak_gb
from jobs.render import exposure, plan_exposures, render_exposures
from jobs.request import Request
from lake_schema import layout, publish, read, sky
from lake_schema.ids import GENERATION_ORDER
from lake_schema.plan import Json

ROOT = Path(__file__).resolve().parents[1]
# Rows of a crowded cell, and those of its columns that a detector reads.
CELL_ROWS, CELL_COLUMNS = 1_200_000, len(exposure.GALAXY_COLUMNS)
_NOTES = {
    "plan_s": "wall, 331 fields x 4 dithers, every detector of VIS and NISP (target 60)",
    "plan_tasks": "their number",
    "overhead_ms": "CPU of a task beyond its render and the reading of its sources (target 50)",
    "speedup_2_cores": "16 detectors (target 1.85); a busy machine has no two cores to give",
    "source_read_s": "wall, a detector's sources from a cell of 1.2 million rows (target 0.3)",
}


def demo(folder: Path, quick: bool) -> tuple[Path, Request]:
    """A lake of the demo's catalogues, fluxes and plan; of a brighter and smaller one where it must be quick."""
    root, wanted = layout.lake(folder / "lake"), requests.parse(ROOT / "requests" / "demo.toml")
    if quick:
        universe = replace(wanted.universe, galaxy_limit=21.0, star_limit=18.0, lensing_nside=64)
        wanted = replace(wanted, universe=universe, pointings=wanted.pointings[1:])
    for module in (build_galaxies, build_stars, compute_fluxes, plan_exposures):
        for step in module.steps(root, wanted):
            publish.make(root, step.plan, step.work)
    return root, wanted


def planning(folder: Path, quick: bool) -> dict[str, float]:
    """Seconds of the plan of the wide survey's fields."""
    wanted = requests.parse(ROOT / "requests" / "sc8_main.toml")
    block = replace(wanted.observations[0], fields=20 if quick else 331)
    wanted = replace(wanted, observations=(block,))
    started, cpu = time.perf_counter(), time.process_time()
    _, exposures, tasks = plan_exposures.plan(folder, wanted)
    seconds = {"plan_s": time.perf_counter() - started, "plan_cpu_s": time.process_time() - cpu}
    return {**seconds, "plan_exposures": len(exposures), "plan_tasks": len(tasks)}


def rendering(root: Path, wanted: Request) -> dict[str, float]:
    """What each detector takes, of what was predicted, and what of a task is no render."""
    step = render_exposures.steps(root, wanted)[0]
    tasks = {(row["exposure_id"], row["detector"]): row for row in read.version(root, "tasks").rows().to_pylist()}
    out: dict[str, float] = {}
    for part in step.plan.parts:
        facts = {**step.plan.facts, **part.facts}
        task = tasks[part.facts["exposure_id"], part.facts["detector"]]
        name = task["channel"].lower()
        # The first render: what is compiled or computed once a process, or once a machine, is not a detector's.
        out["overhead_ms"] = max(out.get("overhead_ms", 0.0), 1e3 * _overhead(root, facts))
        forget_peak()
        seconds = report.best(lambda facts=facts: step.work(root, facts), 2, time.process_time)  # type: ignore[misc]
        out |= {f"{name}_s": seconds, f"{name}_sources": task["sources"], f"{name}_peak_gb": peak_gb()}
        out[f"{name}_empty_s"] = report.best(partial(_without_sources, root, facts), 1, time.process_time)
        out[f"{name}_prediction_error"] = task["seconds"] / seconds - 1.0
        out[f"{name}_memory_error"] = task["memory"] / out[f"{name}_peak_gb"] - 1.0
    out["prediction_error"] = max(abs(v) for k, v in out.items() if k.endswith("prediction_error"))
    return out


def _without_sources(root: Path, facts: Json) -> None:
    """The same detector of an empty sky."""
    draw = exposure.render

    def empty(task: Json, exposed: Json, *, galaxies, galaxy_fluxes, stars, star_fluxes, **rest):  # type: ignore[no-untyped-def]
        tables = (galaxies, galaxy_fluxes, stars, star_fluxes)
        return draw(task, exposed, *(table.slice(0, 0) for table in tables), **rest)

    _with_render(empty, root, facts)


def _overhead(root: Path, facts: Json) -> float:
    """CPU s of a task whose render takes none, nor the reading of its sources, which has a figure of its own."""
    kept: list[exposure.Rendered] = []
    draw = exposure.render
    _with_render(lambda *a, **k: kept.append(draw(*a, **k)) or kept[0], root, facts)  # type: ignore[func-returns-value]
    read_rows, rows = read.Version.in_cells, {}

    def from_memory(version, *wanted):  # type: ignore[no-untyped-def]
        if version.table not in rows:
            rows[version.table] = read_rows(version, *wanted)
        return rows[version.table]

    read.Version.in_cells = from_memory  # type: ignore[method-assign]
    try:
        return report.best(lambda: _with_render(lambda *a, **k: kept[0], root, facts), 3, time.process_time)
    finally:
        read.Version.in_cells = read_rows  # type: ignore[method-assign]


def _with_render(function, root: Path, facts: Json) -> None:  # type: ignore[no-untyped-def]
    before, exposure.render = exposure.render, function
    try:
        render_exposures.work(root, facts)
    finally:
        exposure.render = before


def two_cores(root: Path, wanted: Request, tasks: int) -> float:
    """Wall time of so many detectors one after another, over that of two at a time; both in workers that are warm."""
    step = render_exposures.steps(root, wanted)[0]
    part = min(step.plan.parts, key=lambda part: part.facts["exposure_id"] != len(wanted.pointings))
    facts = [{**step.plan.facts, **part.facts}] * tasks
    seconds = {}
    for cores in (1, 2):
        with ProcessPoolExecutor(cores, get_context("spawn")) as pool:
            list(pool.map(_one, [root] * cores, facts[:cores]))
            started = time.perf_counter()
            list(pool.map(_one, [root] * tasks, facts))
            seconds[cores] = time.perf_counter() - started
    return seconds[1] / seconds[2]


def _one(root: Path, facts: Json) -> None:
    render_exposures.work(root, facts)


def reading(folder: Path, quick: bool) -> float:
    """s to read a detector's generation cells from one file."""
    rows = 100_000 if quick else CELL_ROWS
    root = layout.lake(folder / "crowded")
    publish.make(root, bulk.plan(1, rows), bulk.work)
    version = read.version(root, bulk.TRIAL.name)
    names = [name for name in version.schema.names if not name.startswith("_")][:CELL_COLUMNS]
    place = version.rows(["ra", "dec"]).slice(rows // 2, 1).to_pylist()[0]
    # A VIS detector and its margin.
    cells = sky.cells_in_cone(place["ra"], place["dec"], 0.1, GENERATION_ORDER).tolist()
    return report.best(lambda: version.in_cells(cells, GENERATION_ORDER, names), 3)


def main(argv: Sequence[str] | None = None) -> int:
    """Measures and prints everything."""
    options = report.options("planner", __doc__ or "", argv)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        figures = planning(folder, options.quick) | {"source_read_s": reading(folder, options.quick)}
        root, wanted = demo(folder, options.quick)
        figures |= rendering(root, wanted)
        if not options.quick:
            figures["speedup_2_cores"] = two_cores(root, wanted, 16)
    report.finish("planner", 2, figures, _NOTES, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
