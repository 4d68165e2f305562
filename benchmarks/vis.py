"""A VIS detector with everything: seconds from the catalogue to the file, of each stage, and memory; an exposure of 36.

One process, one thread, the demo's field. Each time is of a process that has rendered before, as a worker has; "cold"
is without the PSF's planes in the cache, "warm" with them. Everything: every effect of a science image is forced on.
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
# Folders of the PSF's planes in the cache.
_PLANES = "vis_psf-*"
# Which take what effects they ask for themselves, and all of them besides.
_FAST_PRESETS = ("quicklook", "draft")
# Takes as long as all others together, and no other time depends on it.
_SLOW_PRESET = "reference"
_NOTES = {
    "survey_cold_s": "CPU, catalogue to FITS, everything on, PSF planes computed (target 15)",
    "survey_warm_s": "the same, PSF planes from the cache",
    "draft_warm_s": "the same at draft accuracy, its own choice of effects (target 4)",
    "draft_full_s": "the same with everything on",
    "quicklook_warm_s": "at quicklook accuracy, its own choice of effects",
    "quicklook_full_s": "the same with everything on, as draft_full_s",
    "reference_cold_s": "at reference accuracy, everything on (target 60)",
    "survey_needed_s": "warm, with the effects that the scene asks for",
    "survey_cold_peak_gb": "largest memory of the process (target 2)",
    "exposure_s": "wall, 36 detectors by the Spark job on 2 cores (target 360)",
}


def demo_request(quick: bool) -> Request:
    """The demo's VIS detector; of a brighter universe where it must be quick."""
    parsed = parse(ROOT / "requests" / "demo.toml")
    parsed = replace(parsed, pointings=parsed.pointings[:1], bands=parsed.bands[:1], truth=())
    if quick:
        universe = replace(parsed.universe, galaxy_limit=20.0, star_limit=16.0, lensing_nside=64)
        parsed = replace(parsed, universe=universe)
    return parsed


def with_all_effects(request: Request) -> Request:
    """With every effect of a science image forced on."""
    names = [effect.name for effect in (vis.TRANSFER_EFFECT, *vis.SKY) if effect.optional]
    return replace(request, effects=Effects(on=tuple(names)))


@contextmanager
def record_stages(seconds: dict[str, float]) -> Iterator[None]:
    """Adds up the CPU seconds of a render's stages and effects while it is open."""
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
    """All of a detector's figures."""
    request = demo_request(quick)
    root, out = make_lake(folder, request), {}
    full_task = plan_detector(root, with_all_effects(request))
    measure_render(root, full_task, folder)  # Compiles, and fills the other caches.
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
            # With its planes still in the cache.
            out["survey_needed_s"] = measure_render(root, plan_detector(root, request), folder)[0]
            stage_seconds: dict[str, float] = defaultdict(float)
            with record_stages(stage_seconds):
                measure_render(root, facts, folder)
            out |= stage_seconds
    return out


def time_exposure(folder: Path, quick: bool) -> Mapping[str, float]:
    """Wall s of the Spark job that renders all 36 detectors of an exposure; quick: two of a bright universe."""
    block = (ROOT / "requests" / "demo.toml").read_text(encoding="utf-8").split("[[pointing]]")[1]
    pointing = "\n".join(line for line in block.splitlines() if not line.startswith(("centre_on", "detectors")))
    if quick:
        pointing += '\ndetectors = ["3-3", "3-4"]'
    head = one_detector.request_head(quick).replace("radius = 0.2", f"radius = {FIELD_RADIUS}")
    return {"exposure_s": one_detector.time_job(folder, f"{head}[[pointing]]{pointing}\n")}


def main(argv: Sequence[str] | None = None) -> int:
    """Measures and prints everything."""
    extra_parser = argparse.ArgumentParser(add_help=False)
    extra_parser.add_argument("--exposure", action="store_true", help="also a whole exposure by the Spark job")
    extra_parser.add_argument("--only-exposure", action="store_true", help="the exposure alone")
    extra_parser.add_argument(
        "--repeats", type=int, default=2, help="of every time, the best of which counts; reference: 1"
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
