"""A production of the eighth science challenge: core-hours by channel, and a square degree.

The costs are those of the forecast, measured channel by channel on an Intel Xeon of 2.5 GHz (jobs/render/channels,
python -m benchmarks.planner). Of each camera and band a dozen exposures, evenly spaced in the plan, are priced detector
by detector, and stand for all.
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from benchmarks import report
from jobs.render.planning import planned_exposures, source_counts, survey, tasks, variants
from jobs.render.planning.mission import mission_of, user_filters
from jobs.request.from_toml import parse

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks" / "results" / "production.json"
# Exposures of a kind that are priced; sky of the main run, deg2 (Serrano et al. 2024).
_SAMPLE, AREA = 12, 165.0
_EUCLID = ("VIS", "NISP-P", "NISP-S")
_NOTES = {
    "core_hours_deg2": "main run, all channels, survey accuracy, every effect (target 6; the paper 2433)",
    "core_hours_deg2_euclid": "its three channels of Euclid (target 1.5)",
    "main_core_hours": "over 165 deg2",
    "deep_core_hours": "30 observations",
    "pilot_core_hours": "with its calibrations",
}


def core_hours(name: str, sample: int = _SAMPLE) -> tuple[dict[str, float], dict[str, int]]:
    """Of a shipped request by channel, of the ground by camera; and the exposures."""
    wanted = parse(ROOT / "requests" / f"{name}.toml")
    mission = mission_of(wanted.mission)
    kinds = defaultdict(list)
    for exposure, own in survey.exposures(wanted, mission):
        kinds[exposure.channel, exposure.camera, exposure.image_type, exposure.band].append((exposure, own))
    densities = source_counts.Densities(mission, wanted.universe)
    hours: dict[str, float] = defaultdict(float)
    counts: dict[str, int] = defaultdict(int)
    for (channel, camera, *_), found in kinds.items():
        some = [
            found[i] for i in np.unique(np.linspace(0, len(found) - 1, min(sample, len(found))).round().astype(int))
        ]
        rows = planned_exposures.table(
            [exposure for exposure, _ in some], [own for _, own in some], user_filters(wanted)[0], wanted.seed
        )
        priced = tasks.table(
            rows,
            [exposure.detectors for exposure, _ in some],
            mission,
            densities,
            wanted.truth,
            wanted.accuracy,
            variants.forced(wanted),
        )
        place = camera if channel == "EXT" else channel
        hours[place] += sum(priced["seconds"].to_pylist()) / 3600.0 * len(found) / len(some)
        counts[place] += len(found)
    return dict(hours), dict(counts)


def forecast(quick: bool) -> dict[str, float]:
    """Of the three productions; quick: of the deep field alone."""
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


def main(argv: Sequence[str] | None = None) -> int:
    """Forecasts and prints."""
    options = report.options("production", __doc__ or "", argv)
    figures = forecast(options.quick)
    report.finish("production", 1, figures, _NOTES, options.json or (None if options.quick else RESULTS))
    return 0


if __name__ == "__main__":
    sys.exit(main())
