"""Measure the time to plan exposures, and the errors of the forecast of the costs of rendering them.

Costs are CPU time, memory and disc space. Detector images of VIS and LSST are rendered as in a job for three skies: the
sky of requests/demo.toml, one with few sources, and one with many stars. The constants in truesky/render/channels, from
which costs are forecast, come from this benchmark.
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

from benchmarks import _overhead, report
from benchmarks import lake as bulk
from lake_schema import sky
from lake_schema.ids import GENERATION_ORDER
from lake_schema.store import layout, publish, read
from lake_schema.store.plan import Json, Task
from truesky.catalogue import build_galaxies, build_stars
from truesky.fluxes import compute_fluxes
from truesky.render import plan_exposures, render_exposures
from truesky.render.exposure import truth_maps, visible_sources
from truesky.render.forecasting import speed
from truesky.request.from_toml import from_table, parse
from truesky.request.schema import Request
from truesky.running.task_metrics import peak_memory_gb, reset_peak_memory

ROOT = Path(__file__).resolve().parents[1]
# Number of rows of a crowded HEALPix cell of a catalogue.
CELL_ROWS = 1_200_000
# Number of columns of the galaxy catalogue that the rendering of a detector reads.
CELL_COLUMNS = len(visible_sources.GALAXY_COLUMNS)
# For each sky, the changes of requests/demo.toml, whose field is far from the Galactic plane and has sources to
# I_E = 26.
SKIES: dict[str, dict[str, Any]] = {
    "field": {},
    "sparse": {
        "universe": {"galaxy_limit": 22.0, "star_limit": 20.0},
        "products": {"truth": list(truth_maps.BYTES_PER_PIXEL)},
    },
    "dense": {
        "area": {"cone": {"ra": 270.0, "dec": 0.0, "radius": 0.25}},
        "pointing": {"ra": 270.0, "dec": 0.0, "mjd": 60400.0},
        "products": {"truth": []},
    },
}
# Types of VIS calibration frames that are rendered, too: without light (bias, dark), and with a lamp (flat).
CALIBRATIONS = ("bias", "dark", "flat")
_NOTES = {
    "plan_s": "wall, 331 fields x 4 dithers, all detectors of VIS and NISP (target 60)",
    "plan_tasks": "number of these detectors",
    "source_read_s": "wall, sources of a detector from a cell of 1.2 million rows (target 0.3)",
    "seconds_error": "largest relative error of the forecast CPU time for all skies and channels (target 0.3)",
    "memory_error": "the same for the peak memory of a worker (target 0.3)",
    "bytes_error": "the same for the size of the files (target 0.3)",
}


def sky_request(sky_name: str, quick: bool) -> Request:
    """Return the request of requests/demo.toml for one of the three skies in SKIES.

    If `quick` is True, only bright sources and fewer images are simulated.
    """
    table, change = tomllib.loads((ROOT / "requests" / "demo.toml").read_text()), SKIES[sky_name]
    table["pointing"] = [{**pointing, **change.get("pointing", {})} for pointing in table["pointing"][quick:]]
    table |= {key: value for key, value in change.items() if key in ("area", "products")}
    table["universe"] |= change.get("universe", {})
    if quick:
        table["universe"] |= {"galaxy_limit": 21.0, "star_limit": 18.0, "lensing_nside": 64}
    elif sky_name == "field":
        calibration = {"channels": ["VIS"], "exposures": 1, "detectors": ["3-4"]}
        table["observation"] = [{**calibration, "image_type": kind} for kind in CALIBRATIONS]
    return from_table(table)


def make_lake(folder: Path, sky_name: str, quick: bool, given_request: Request | None = None) -> tuple[Path, Request]:
    """Make a lake with catalogues, fluxes and the plan of exposures of a request.

    Parameters
    ----------
    folder : Path
        Existing folder; the lake is a new folder in it.
    sky_name : str
        Name of one of the SKIES.
    quick : bool
        If True, simulate only bright sources, so that the benchmark is fast.
    given_request : Request, optional
        Request to use; by default the request for this sky.

    Returns
    -------
    root : Path
        Folder of the lake.
    lake_request : Request
        Request from which the lake was made.
    """
    root, lake_request = layout.resolve_lake(folder / sky_name), given_request or sky_request(sky_name, quick)
    for module in (build_galaxies, build_stars, compute_fluxes, plan_exposures):
        for step in module.steps(root, lake_request):
            publish.make_version(root, step.plan, step.run_task)
    return root, lake_request


def time_planning(folder: Path, quick: bool) -> dict[str, float]:
    """Measure the wall and CPU time (s) to plan 331 fields of a wide survey with all detectors of VIS and NISP.

    If `quick` is True, only 20 fields are planned. The numbers of exposures and detector images are returned, too.
    """
    survey_request = parse(ROOT / "requests" / "sc8_main.toml")
    block = replace(survey_request.observations[0], fields=20 if quick else 331)
    survey_request = replace(survey_request, observations=(block,))
    started, cpu = time.perf_counter(), time.process_time()
    _, exposures, tasks = plan_exposures.plan(folder, survey_request)
    seconds = {"plan_s": time.perf_counter() - started, "plan_cpu_s": time.process_time() - cpu}
    return {**seconds, "plan_exposures": len(exposures), "plan_tasks": len(tasks)}


def measure_rendering(root: Path, lake_request: Request, name: str) -> dict[str, float]:
    """Render all planned detector images of a lake, and compare their costs with the forecast.

    Parameters
    ----------
    root : Path
        Folder of the lake, made by `make_lake`.
    lake_request : Request
        Request from which the lake was made.
    name : str
        Beginning of the names of the results.

    Returns
    -------
    dict of str to float
        For each channel and image type: CPU time (names end in `_s`), peak memory (`_gb`) and size of the images
        (`_mb`), and the relative errors of their forecasts (`_s_error`, `_gb_error`, `_mb_error`).
    """
    step = render_exposures.steps(root, lake_request)[0]
    factor = speed.estimate_speed(root).factor
    out: dict[str, float] = {}
    tasks = {(row["exposure_id"], row["detector"]): row for row in read.version(root, "tasks").rows().to_pylist()}
    image_types = {row["exposure_id"]: row["image_type"] for row in read.version(root, "exposures").rows().to_pylist()}

    def run_measured(function: Callable[[Task], Json], parts: Sequence[Task]) -> Iterator[Json]:
        with ProcessPoolExecutor(1, get_context("spawn")) as pool:
            for part, (result, seconds, peak) in zip(
                parts, pool.map(partial(_measure_task, function), parts), strict=True
            ):
                if "error" in result:
                    raise SystemExit(f"benchmarks.planner: {name}, {result['part']}: {result['error']}")
                task = tasks[part.facts["exposure_id"], part.facts["detector"]]
                key = f"{name}_{task['channel']}_{image_types[part.facts['exposure_id']]}".lower().replace(
                    "_science", ""
                )
                size = sum(file["bytes"] for file in result["files"] if file["path"].endswith(".fits"))
                out[f"{key}_sources"] = task["sources"]
                actual = {"s": seconds, "gb": peak, "mb": size / 1e6}
                forecast = {"s": factor * task["seconds"], "gb": task["memory"], "mb": task["bytes"] / 1e6}
                out.update({f"{key}_{unit}": value for unit, value in actual.items()})
                out.update({f"{key}_{unit}_error": forecast[unit] / actual[unit] - 1.0 for unit in actual})
                yield result

    publish.make_version(root, step.plan, step.run_task, run_measured)
    return out


def _measure_task(function: Callable[[Task], Json], part: Task) -> tuple[Json, float, float]:
    """Run a rendering task in this process; return its receipt, the CPU time (s) and the peak memory (GB).

    The receipt is the list of the task's files that the function `function` returns.
    """
    reset_peak_memory()
    started = time.process_time()
    result = function(part)
    return result, time.process_time() - started, peak_memory_gb()


def time_reading(folder: Path, quick: bool) -> dict[str, float]:
    """Return the wall and the CPU time (s) to read the sources near one detector from a crowded catalogue file."""
    rows = 100_000 if quick else CELL_ROWS
    root = layout.resolve_lake(folder / "crowded")
    publish.make_version(root, bulk.catalogue_plan(1, rows), bulk.make_cell)
    version = read.version(root, bulk.TRIAL.name)
    names = [name for name in version.schema.names if not name.startswith("_")][:CELL_COLUMNS]
    place = version.rows(["ra", "dec"]).slice(rows // 2, 1).to_pylist()[0]
    # A circle of 0.1 deg contains a VIS detector and the sources outside it whose light reaches it.
    cells = sky.cells_in_cone(place["ra"], place["dec"], 0.1, GENERATION_ORDER).tolist()
    clocks = {"source_read_s": time.perf_counter, "source_read_cpu_s": time.process_time}
    return {
        k: report.best_time(lambda: version.rows_in_cells(cells, GENERATION_ORDER, names), 3, c)
        for k, c in clocks.items()
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark with the options `argv` (default: the command line), print the results, return 0."""
    options = report.options("planner", __doc__ or "", argv)
    quick = options.quick
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        figures = time_planning(folder, quick) | time_reading(folder, quick)
        for sky_name in ("field",) if quick else SKIES:
            root, lake_request = make_lake(folder, sky_name, quick)
            if sky_name == "field":
                _overhead.compile_all(root, lake_request)
            figures |= measure_rendering(root, lake_request, sky_name)
        for unit, word in (("s", "seconds"), ("gb", "memory"), ("mb", "bytes")):
            figures[f"{word}_error"] = max(abs(v) for k, v in figures.items() if k.endswith(f"_{unit}_error"))
    report.print_and_write("planner", 1, figures, _NOTES, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
