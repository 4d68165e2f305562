"""Measure the rendering of a VIS detector with all effects: CPU time, in total and of each stage, and memory.

The time is from the catalogue to the file, in one process with one thread, which has rendered before. The image shows
the field of requests/demo.toml. "cold" times are without images of the PSF in the cache, "warm" times with them. All
optional effects of a science image are switched on. An option also times an exposure of 36 detectors by Spark.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from benchmarks import _detectors as one_detector
from benchmarks import report
from benchmarks._detectors import FIELD_RADIUS, ROOT, add_cpu_time, make_lake, measure_render, plan_detector
from truesky.render.channels import vis
from truesky.render.drawing import stamps
from truesky.render.exposure import visible_sources
from truesky.render.sources import catalogue_rows
from truesky.request.accuracy import preset
from truesky.request.from_toml import parse
from truesky.request.schema import Effects, Request

RESULTS = ROOT / "benchmarks" / "results" / "vis.json"
_PRESETS = ("draft", "survey", "quicklook", "reference")
# Pattern of the names of the cache folders that contain PSF images.
_PLANES = "vis_psf-*"
# Accuracies that are measured twice: with the effects that are noticeable at this accuracy, and with all effects.
_FAST_PRESETS = ("quicklook", "draft")
# Accuracy that is measured only once, because it takes as long as all others together.
_SLOW_PRESET = "reference"
_NOTES = {
    "survey_cold_s": "CPU, catalogue to FITS, all effects, PSF planes computed (target 15)",
    "survey_warm_s": "the same, PSF planes from the cache",
    "draft_warm_s": "the same at draft accuracy with the effects that it selects (target 4)",
    "draft_full_s": "the same with all effects",
    "quicklook_warm_s": "at quicklook accuracy with the effects that it selects",
    "quicklook_full_s": "the same with all effects",
    "reference_cold_s": "at reference accuracy with all effects (target 60)",
    "survey_needed_s": "warm, with the effects that the scene needs",
    "survey_cold_peak_gb": "peak memory of the process (target 2)",
    "exposure_s": "wall, 36 detectors by the Spark job on 2 cores (target 360)",
}


def demo_request(quick: bool) -> Request:
    """Return the request of requests/demo.toml, reduced to its VIS detector; `quick` simulates only bright sources."""
    parsed = parse(ROOT / "requests" / "demo.toml")
    parsed = replace(parsed, pointings=parsed.pointings[:1], bands=parsed.bands[:1], truth=())
    if quick:
        universe = replace(parsed.universe, galaxy_limit=20.0, star_limit=16.0, lensing_nside=64)
        parsed = replace(parsed, universe=universe)
    return parsed


def with_all_effects(request: Request) -> Request:
    """Return a copy of a request that switches on all optional effects of VIS science images."""
    names = [effect.name for effect in (vis.TRANSFER_EFFECT, *vis.SKY) if effect.optional]
    return replace(request, effects=Effects(on=tuple(names)))


@contextmanager
def record_stages(seconds: dict[str, float]) -> Iterator[None]:
    """Record the CPU time of the stages and effects of renderings during a `with` block.

    Times in s are added to `seconds`, which must be a defaultdict, by names such as `stage_draw_s` and
    `effect_cosmic_rays_s`.
    """
    functions: tuple[tuple[Any, str, str], ...] = (
        (catalogue_rows, "read_sources", "read"),
        (visible_sources, "exposure_psf", "psf"),
        (visible_sources, "select_sources", "choose"),
        (stamps, "draw", "draw"),
    )
    originals = [(module, name, getattr(module, name)) for module, name, _ in functions]
    effects = vis.EFFECTS["science"]
    for module, name, stage in functions:
        setattr(module, name, add_cpu_time(getattr(module, name), f"stage_{stage}_s", seconds))
    timed_effects = tuple(replace(e, apply=add_cpu_time(e.apply, f"effect_{e.name}_s", seconds)) for e in effects)
    vis.EFFECTS["science"] = timed_effects  # type: ignore[index]
    try:
        yield
    finally:
        vis.EFFECTS["science"] = effects  # type: ignore[index]
        for module, name, function in originals:
            setattr(module, name, function)


def measure_detectors(folder: Path, quick: bool, repeats: int) -> dict[str, float]:
    """Measure the rendering of one VIS detector at several accuracies.

    Parameters
    ----------
    folder : Path
        Existing folder in which the lake and the image files are written.
    quick : bool
        If True, simulate only bright sources, so that the benchmark is fast.
    repeats : int
        Number of repeats of each measurement; the shortest time counts.

    Returns
    -------
    dict of str to float
        Measured values by name; a name ends with the unit of the value, such as `_s` or `_gb`.
    """
    request = demo_request(quick)
    root, out = make_lake(folder, request), {}
    full_task = plan_detector(root, with_all_effects(request))
    measure_render(root, full_task, folder)  # Untimed: compiles functions and fills the caches.
    for name in _PRESETS[:2] if quick else _PRESETS:
        variant = replace(request, accuracy=preset(name))
        facts = plan_detector(root, variant if name in _FAST_PRESETS else with_all_effects(variant))
        for state in ("cold", "warm"):
            seconds, peaks = [], []
            for _ in range(1 if name == _SLOW_PRESET else repeats):
                if state == "cold":
                    one_detector.remove_planes(_PLANES)
                used, peak = measure_render(root, facts, folder)
                seconds.append(used)
                peaks.append(peak)
            out |= {f"{name}_{state}_s": min(seconds), f"{name}_{state}_peak_gb": max(peaks)}
        if name in _FAST_PRESETS:
            out[f"{name}_full_s"] = measure_render(root, plan_detector(root, with_all_effects(variant)), folder)[0]
        if name == "survey":
            # The time is "warm": the last repeat has left the images of the PSF in the cache.
            out["survey_needed_s"] = measure_render(root, plan_detector(root, request), folder)[0]
            stage_seconds: dict[str, float] = defaultdict(float)
            with record_stages(stage_seconds):
                measure_render(root, facts, folder)
            out |= stage_seconds
    return out


def time_exposure(folder: Path, quick: bool) -> Mapping[str, float]:
    """Return the wall time (s) of the Spark job that renders all 36 detectors of an exposure, or two if `quick`.

    The result has one entry, `exposure_s`. The lake is made in `folder` before the clock starts.
    """
    block = (ROOT / "requests" / "demo.toml").read_text(encoding="utf-8").split("[[pointing]]")[1]
    pointing = "\n".join(line for line in block.splitlines() if not line.startswith(("centre_on", "detectors")))
    if quick:
        pointing += '\ndetectors = ["3-3", "3-4"]'
    head = one_detector.request_head(quick).replace("radius = 0.2", f"radius = {FIELD_RADIUS}")
    return {"exposure_s": one_detector.time_job(folder, f"{head}[[pointing]]{pointing}\n")}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark with the options `argv` (default: the command line), print the results, return 0."""
    extra_parser = argparse.ArgumentParser(add_help=False)
    extra_parser.add_argument("--exposure", action="store_true", help="also time an exposure by the Spark job")
    extra_parser.add_argument("--only-exposure", action="store_true", help="time only the exposure")
    extra_parser.add_argument(
        "--repeats", type=int, default=2, help="repeats (1 at reference accuracy); the shortest time counts"
    )
    extra_options, other_arguments = extra_parser.parse_known_args(argv)
    options = report.options("vis", __doc__ or "", other_arguments)
    repeats = 1 if options.quick else extra_options.repeats
    figures: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as name:
        if not extra_options.only_exposure:
            figures |= measure_detectors(Path(name), options.quick, repeats)
        if extra_options.exposure or extra_options.only_exposure:
            figures |= time_exposure(Path(name), options.quick)
    written = options.json or (None if options.quick or extra_options.only_exposure else RESULTS)
    report.print_and_write("vis", repeats, figures, _NOTES, written)
    return 0


if __name__ == "__main__":
    sys.exit(main())
