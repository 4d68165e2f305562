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
from benchmarks._detectors import FIELD, ROOT, lake, prepared, rendered, timed
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
_FAST = ("quicklook", "draft")
# Takes as long as all others together, and no other time depends on it.
_ONCE = "reference"
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


def request(quick: bool) -> Request:
    """The demo's VIS detector; of a brighter universe where it must be quick."""
    wanted = parse(ROOT / "requests" / "demo.toml")
    wanted = replace(wanted, pointings=wanted.pointings[:1], bands=wanted.bands[:1], truth=())
    if quick:
        universe = replace(wanted.universe, galaxy_limit=20.0, star_limit=16.0, lensing_nside=64)
        wanted = replace(wanted, universe=universe)
    return wanted


def full(wanted: Request) -> Request:
    """With every effect of a science image forced on."""
    names = [effect.name for effect in (vis.DRAWN, *vis.SKY) if effect.optional]
    return replace(wanted, effects=Effects(on=tuple(names)))


@contextmanager
def stages(seconds: dict[str, float]) -> Iterator[None]:
    """Adds up the CPU seconds of a render's stages and effects while it is open."""
    places: tuple[tuple[Any, str, str], ...] = (
        (catalogue_rows, "sources", "read"),
        (visible_sources, "psf_of", "psf"),
        (visible_sources, "sources_of", "choose"),
        (stamps, "draw", "draw"),
    )
    kept = [(module, name, getattr(module, name)) for module, name, _ in places]
    effects = vis.EFFECTS["science"]
    for module, name, stage in places:
        setattr(module, name, timed(getattr(module, name), f"stage_{stage}_s", seconds))
    measured = tuple(replace(e, apply=timed(e.apply, f"effect_{e.name}_s", seconds)) for e in effects)
    vis.EFFECTS["science"] = measured  # type: ignore[index]
    try:
        yield
    finally:
        vis.EFFECTS["science"] = effects  # type: ignore[index]
        for module, name, function in kept:
            setattr(module, name, function)


def detectors(folder: Path, quick: bool, repeats: int) -> dict[str, float]:
    """All of a detector's figures."""
    plain = request(quick)
    root, out = lake(folder, plain), {}
    everything = prepared(root, full(plain))
    rendered(root, everything, folder)  # Compiles, and fills the other caches.
    for name in _PRESETS[:2] if quick else _PRESETS:
        wanted = replace(plain, accuracy=preset(name))
        facts = prepared(root, wanted if name in _FAST else full(wanted))
        for state in ("cold", "warm"):
            seconds, peaks = [], []
            for _ in range(1 if name == _ONCE else repeats):
                if state == "cold":
                    one_detector.without_planes(_PLANES)
                used, peak = rendered(root, facts, folder)
                seconds.append(used)
                peaks.append(peak)
            out |= {f"{name}_{state}_s": min(seconds), f"{name}_{state}_peak_gb": max(peaks)}
        if name in _FAST:
            out[f"{name}_full_s"] = rendered(root, prepared(root, full(wanted)), folder)[0]
        if name == "survey":
            # With its planes still in the cache.
            out["survey_needed_s"] = rendered(root, prepared(root, plain), folder)[0]
            parts: dict[str, float] = defaultdict(float)
            with stages(parts):
                rendered(root, facts, folder)
            out |= parts
    return out


def whole_exposure(folder: Path, quick: bool) -> Mapping[str, float]:
    """Wall s of the Spark job that renders all 36 detectors of an exposure; quick: two of a bright universe."""
    block = (ROOT / "requests" / "demo.toml").read_text(encoding="utf-8").split("[[pointing]]")[1]
    pointing = "\n".join(line for line in block.splitlines() if not line.startswith(("centre_on", "detectors")))
    if quick:
        pointing += '\ndetectors = ["3-3", "3-4"]'
    head = one_detector.head(quick).replace("radius = 0.2", f"radius = {FIELD}")
    return {"exposure_s": one_detector.by_job(folder, f"{head}[[pointing]]{pointing}\n")}


def main(argv: Sequence[str] | None = None) -> int:
    """Measures and prints everything."""
    own = argparse.ArgumentParser(add_help=False)
    own.add_argument("--exposure", action="store_true", help="also a whole exposure by the Spark job")
    own.add_argument("--only-exposure", action="store_true", help="the exposure alone")
    own.add_argument("--repeats", type=int, default=2, help="of every time, the best of which counts; reference: 1")
    known, others = own.parse_known_args(argv)
    options = report.options("vis", __doc__ or "", others)
    repeats = 1 if options.quick else known.repeats
    figures: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as name:
        if not known.only_exposure:
            figures |= detectors(Path(name), options.quick, repeats)
        if known.exposure or known.only_exposure:
            figures |= whole_exposure(Path(name), options.quick)
    written = options.json or (None if options.quick or known.only_exposure else RESULTS)
    report.finish("vis", repeats, figures, _NOTES, written)
    return 0


if __name__ == "__main__":
    sys.exit(main())
