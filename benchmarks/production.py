"""Forecast the core-hours of simulating Euclid's eighth science challenge, and measure overheads of its jobs.

The core-hours are computed with the constants in truesky/render/channels, which `python -m benchmarks.planner` measured
on an Intel Xeon of 2.5 GHz. For each camera and passband, the cost of all exposures is extrapolated from a dozen
exposures that are evenly spaced in the plan.
"""

from __future__ import annotations

import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks import _overhead, planner, report, scheduler
from truesky.render.planning import planned_exposures, source_counts, survey, tasks, variants
from truesky.render.planning.mission import mission_of, user_filters
from truesky.request.from_toml import parse
from truesky.validation.lake.suite import inventory, running

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "production.json"
# Number of exposures of each camera, image type and passband whose cost is computed.
_SAMPLE = 12
# Area of the main run in deg2 (Serrano et al. 2024).
AREA = 165.0
_EUCLID = ("VIS", "NISP-P", "NISP-S")
_NOTES = {
    "core_hours_deg2": "main run, all channels, survey accuracy, all effects (target 6; the paper 2433)",
    "core_hours_deg2_euclid": "the three channels of Euclid (target 1.5)",
    "main_core_hours": "main run over 165 deg2",
    "deep_core_hours": "deep run of 30 observations",
    "pilot_core_hours": "pilot run with its calibrations",
    "overhead_ms": "CPU of a task outside rendering, the sum of the next three (target 30)",
    "task_ms": "without rendering and reading sources, most expensive detector; best of 15, in a warm worker",
    "hand_out_ms": "wall, dispatch of an empty task by Spark with Python workers",
    "publish_ms": "CPU, reading the receipt and listing the files in the manifest; mean of 2,000",
    "speedup_2_cores": "speed-up by two cores that follows from the serial share (target 1.95)",
    "serial_share": "serial share of CPU time for 16 detectors, after the start of Java (target 0.025)",
    "wall_2_cores": "speed-up by two cores for 16 detectors, wall time; only on an idle machine",
    "two_cores_cpu": "CPU time of the same work on two cores / on one core",
    "validation_s": "wall, two processes: all checks of images and catalogues of a field (target 120)",
    "validation_detectors": "number of checked detectors of VIS, NISP-P and NISP-S",
}


def core_hours(name: str, sample: int = _SAMPLE) -> tuple[dict[str, float], dict[str, int]]:
    """Return the forecast core-hours and the number of exposures of a request, by channel of Euclid or ground camera.

    `name` is the name of the request's file in requests/ without its ending. `sample` is the number of exposures of
    each camera, image type and passband whose cost is computed; the costs of the others are extrapolated.
    """
    request = parse(ROOT / "requests" / f"{name}.toml")
    mission = mission_of(request.mission)
    exposures_by_kind, plan = defaultdict(list), survey.exposures(request, mission)
    for exposure, settings in plan:
        exposures_by_kind[exposure.channel, exposure.camera, exposure.image_type, exposure.band].append(
            (exposure, settings)
        )
    densities = source_counts.Densities(mission, request.universe)
    hours: dict[str, float] = defaultdict(float)
    counts: dict[str, int] = defaultdict(int)
    for (channel, camera, *_), kind_exposures in exposures_by_kind.items():
        sampled = [
            kind_exposures[i]
            for i in np.unique(
                np.linspace(0, len(kind_exposures) - 1, min(sample, len(kind_exposures))).round().astype(int)
            )
        ]
        rows = planned_exposures.table(
            [exposure for exposure, _ in sampled],
            [settings for _, settings in sampled],
            user_filters(request)[0],
            request.seed,
        )
        task_costs = tasks.table(
            rows,
            [exposure.detectors for exposure, _ in sampled],
            mission,
            densities,
            request.truth,
            request.accuracy,
            variants.forced_effects(request),
        )
        task_costs = tasks.add_persistence_cost(task_costs, rows, (exposure for exposure, _ in plan), mission)
        place = camera if channel == "EXT" else channel
        hours[place] += sum(task_costs["seconds"].to_pylist()) / 3600.0 * len(kind_exposures) / len(sampled)
        counts[place] += len(kind_exposures)
    return dict(hours), dict(counts)


def forecast_core_hours(quick: bool) -> dict[str, float]:
    """Return the core-hours of the pilot, deep and main runs of the science challenge, or only of deep if `quick`.

    For the main run the core-hours per deg2 are returned, too.
    """
    out: dict[str, float] = {}
    for run in ("deep",) if quick else ("pilot", "deep", "main"):
        hours, counts = core_hours(f"sc8_{run}", 2 if quick else _SAMPLE)
        out[f"{run}_core_hours"] = sum(hours.values())
        for place in hours:
            key = place.lower().replace("-", "_")
            out[f"{run}_{key}_core_hours"], out[f"{run}_{key}_exposures"] = hours[place], counts[place]
    if not quick:
        out["core_hours_deg2"] = out["main_core_hours"] / AREA
        euclid = [out[f"main_{place.lower().replace('-', '_')}_core_hours"] for place in _EUCLID]
        out["core_hours_deg2_euclid"] = sum(euclid) / AREA
    return out


def overhead(quick: bool) -> dict[str, float]:
    """Measure the time that rendering jobs spend outside rendering, per task and per job.

    The result contains `overhead_ms` (sum of the times per task in ms) and its parts. `quick` measures only some parts.
    """
    with tempfile.TemporaryDirectory() as name:
        # Detectors with almost no sources are used to measure the time of a task outside rendering. The shares of CPU
        # time below are measured with eight copies of each pointing of requests/demo.toml.
        empty_request = replace(
            planner.sky_request("field", quick), universe=planner.sky_request("field", True).universe, observations=()
        )
        root, _ = planner.make_lake(Path(name), "field", True, empty_request)
        figures = {
            "task_ms": _overhead.task_ms(root, empty_request),
            "publish_ms": scheduler.time_publishing(Path(name), 100 if quick else 2000)["publish_cpu_ms_a_part"],
        }
        if not quick:
            repeated_pointings = tuple(
                replace(pointing, realisations=8) for pointing in planner.sky_request("field", False).pointings
            )
            repeated_request = replace(
                planner.sky_request("field", False), pointings=repeated_pointings, observations=()
            )
            root = planner.make_lake(Path(name) / "demo", "field", False, repeated_request)[0]
            figures |= _overhead.cpu_shares(root, repeated_request)
            figures["hand_out_ms"] = 1e3 / scheduler.time_dispatch(2000)["spark_tasks_per_s"]
    return {**figures, "overhead_ms": sum(figures.get(key, 0.0) for key in ("task_ms", "hand_out_ms", "publish_ms"))}


def time_validation(lake: Path) -> dict[str, float]:
    """Measure the wall time (s) of `truesky validate` for the Euclid science images of a lake, with two processes.

    The result also contains the number of checked detector images.
    """
    contents = inventory.read_contents(lake)
    shots = tuple(
        shot
        for shot in contents.science_files
        if shot.place.channel in _EUCLID and shot.exposure["image_type"] == "science"
    )
    started = time.perf_counter()
    running.run_checks(replace(contents, science_files=shots), 2)
    return {"validation_s": time.perf_counter() - started, "validation_detectors": float(len(shots))}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark with the options `argv` (default: the command line), print the results, return 0."""
    lake_help = "also time the validation of this lake with a rendered field of Euclid, for example of `make pilot`"
    options = report.options("production", __doc__ or "", argv, lake=lake_help)
    figures = overhead(options.quick) | forecast_core_hours(options.quick)
    if options.lake is not None:
        figures |= time_validation(options.lake)
    report.print_and_write("production", 1, figures, _NOTES, options.json or (None if options.quick else RESULTS))
    return 0


if __name__ == "__main__":
    sys.exit(main())
