"""Planning: seconds of a plan, errors of the forecast.

Detectors of VIS and LSST are rendered as a job renders them, of three skies: the demo's, one of few sources and one of
many stars. What they take are the costs in truesky/render/channels.
"""

from __future__ import annotations

import sys
import tempfile
import time
import tomllib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from benchmarks import _around, report
from benchmarks import lake as bulk
from lake_schema import sky
from lake_schema.ids import GENERATION_ORDER
from lake_schema.store import layout, publish, read
from lake_schema.store.plan import Json, Part
from truesky.catalogue import build_galaxies, build_stars
from truesky.fluxes import compute_fluxes
from truesky.render import plan_exposures, render_exposures
from truesky.render.exposure import truth_maps, visible_sources
from truesky.render.forecasting import speed
from truesky.request.from_toml import from_table, parse
from truesky.request.schema import Request
from truesky.running.measured import forget_peak, peak_gb

ROOT = Path(__file__).resolve().parents[1]
# Rows of a crowded cell, and those of its columns that a detector reads.
CELL_ROWS, CELL_COLUMNS = 1_200_000, len(visible_sources.GALAXY_COLUMNS)
# What is changed of the demo: its sky is high above the Milky Way, with sources to I_E = 26.
SKIES: dict[str, dict[str, Any]] = {
    "field": {},
    "sparse": {"universe": {"galaxy_limit": 22.0, "star_limit": 20.0}, "products": {"truth": list(truth_maps.BYTES)}},
    "dense": {
        "area": {"cone": {"ra": 270.0, "dec": 0.0, "radius": 0.25}},
        "pointing": {"ra": 270.0, "dec": 0.0, "mjd": 60400.0},
        "products": {"truth": []},
    },
}
# VIS frames without a sky, and one with a lamp.
CALIBRATIONS = ("bias", "dark", "flat")
_NOTES = {
    "plan_s": "wall, 331 fields x 4 dithers, every detector of VIS and NISP (target 60)",
    "plan_tasks": "their number",
    "source_read_s": "wall, a detector's sources from a cell of 1.2 million rows (target 0.3)",
    "seconds_error": "of the forecast against CPU s, the worst of all skies and channels (target 0.3)",
    "memory_error": "against the peak of a worker (target 0.3)",
    "bytes_error": "against the files (target 0.3)",
}


def request(sky_name: str, quick: bool) -> Request:
    """The demo's request over one of the skies; of fewer sources where it must be quick."""
    table, change = tomllib.loads((ROOT / "requests" / "demo.toml").read_text()), SKIES[sky_name]
    table["pointing"] = [{**pointing, **change.get("pointing", {})} for pointing in table["pointing"][quick:]]
    table |= {key: value for key, value in change.items() if key in ("area", "products")}
    table["universe"] |= change.get("universe", {})
    if quick:
        table["universe"] |= {"galaxy_limit": 21.0, "star_limit": 18.0, "lensing_nside": 64}
    elif sky_name == "field":
        one = {"channels": ["VIS"], "exposures": 1, "detectors": ["3-4"]}
        table["observation"] = [{**one, "image_type": kind} for kind in CALIBRATIONS]
    return from_table(table)


def lake(folder: Path, sky_name: str, quick: bool, own: Request | None = None) -> tuple[Path, Request]:
    """A lake with catalogues, fluxes and plan; own : a request to take in place of that of the sky."""
    root, wanted = layout.lake(folder / sky_name), own or request(sky_name, quick)
    for module in (build_galaxies, build_stars, compute_fluxes, plan_exposures):
        for step in module.steps(root, wanted):
            publish.make(root, step.plan, step.work)
    return root, wanted


def planning(folder: Path, quick: bool) -> dict[str, float]:
    """Seconds of the plan of the wide survey's fields."""
    wanted = parse(ROOT / "requests" / "sc8_main.toml")
    block = replace(wanted.observations[0], fields=20 if quick else 331)
    wanted = replace(wanted, observations=(block,))
    started, cpu = time.perf_counter(), time.process_time()
    _, exposures, tasks = plan_exposures.plan(folder, wanted)
    seconds = {"plan_s": time.perf_counter() - started, "plan_cpu_s": time.process_time() - cpu}
    return {**seconds, "plan_exposures": len(exposures), "plan_tasks": len(tasks)}


def rendering(root: Path, wanted: Request, name: str) -> dict[str, float]:
    """What each detector takes, written and hashed, and by how much the forecast was wrong."""
    step = render_exposures.steps(root, wanted)[0]
    factor = speed.of_machine(root).factor
    out: dict[str, float] = {}
    tasks = {(row["exposure_id"], row["detector"]): row for row in read.version(root, "tasks").rows().to_pylist()}
    kinds = {row["exposure_id"]: row["image_type"] for row in read.version(root, "exposures").rows().to_pylist()}

    def measured(function: Callable[[Part], Json], parts: Sequence[Part]) -> Iterator[Json]:
        with ProcessPoolExecutor(1, get_context("spawn")) as pool:
            for part, (result, seconds, peak) in zip(parts, pool.map(partial(_taken, function), parts), strict=True):
                task = tasks[part.facts["exposure_id"], part.facts["detector"]]
                key = f"{name}_{task['channel']}_{kinds[part.facts['exposure_id']]}".lower().replace("_science", "")
                size = sum(file["bytes"] for file in result["files"] if file["path"].endswith(".fits"))
                out[f"{key}_sources"] = task["sources"]
                took = {"s": seconds, "gb": peak, "mb": size / 1e6}
                said = {"s": factor * task["seconds"], "gb": task["memory"], "mb": task["bytes"] / 1e6}
                out.update({f"{key}_{unit}": value for unit, value in took.items()})
                out.update({f"{key}_{unit}_error": said[unit] / took[unit] - 1.0 for unit in took})
                yield result

    publish.make(root, step.plan, step.work, measured)
    return out


def _taken(function: Callable[[Part], Json], part: Part) -> tuple[Json, float, float]:
    """What a worker says of a part: its receipt, CPU s, peak GB."""
    forget_peak()
    started = time.process_time()
    result = function(part)
    return result, time.process_time() - started, peak_gb()


def reading(folder: Path, quick: bool) -> dict[str, float]:
    """s, wall and CPU, to read a detector's generation cells from one file."""
    rows = 100_000 if quick else CELL_ROWS
    root = layout.lake(folder / "crowded")
    publish.make(root, bulk.plan(1, rows), bulk.work)
    version = read.version(root, bulk.TRIAL.name)
    names = [name for name in version.schema.names if not name.startswith("_")][:CELL_COLUMNS]
    place = version.rows(["ra", "dec"]).slice(rows // 2, 1).to_pylist()[0]
    # A VIS detector and its margin.
    cells = sky.cells_in_cone(place["ra"], place["dec"], 0.1, GENERATION_ORDER).tolist()
    clocks = {"source_read_s": time.perf_counter, "source_read_cpu_s": time.process_time}
    return {k: report.best(lambda: version.in_cells(cells, GENERATION_ORDER, names), 3, c) for k, c in clocks.items()}


def main(argv: Sequence[str] | None = None) -> int:
    """Measures and prints everything."""
    options = report.options("planner", __doc__ or "", argv)
    quick = options.quick
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        figures = planning(folder, quick) | reading(folder, quick)
        for sky_name in ("field",) if quick else SKIES:
            root, wanted = lake(folder, sky_name, quick)
            if sky_name == "field":
                _around.compile_all(root, wanted)
            figures |= rendering(root, wanted, sky_name)
        for unit, word in (("s", "seconds"), ("gb", "memory"), ("mb", "bytes")):
            figures[f"{word}_error"] = max(abs(v) for k, v in figures.items() if k.endswith(f"_{unit}_error"))
    report.finish("planner", 1, figures, _NOTES, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
