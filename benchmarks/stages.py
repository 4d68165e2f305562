"""Measure the CPU time of each stage of a rendered detector, and its error, for each accuracy and four cameras.

A detector of VIS, of NISP-P, of NISP-S and of LSSTCam is rendered at each accuracy with the effects that the accuracy
selects, from the catalogue to the files. The scenes were not used to choose the settings of the drawing code. The image
of expected electrons is compared with the image at reference accuracy, in pixels of the sky and in those of sources.
For effects that an accuracy leaves out, the error is the largest expected change of a pixel. With --picture, times and
errors are drawn, next to the times of GalSim and UFig in results/render.json.
"""

from __future__ import annotations

import json
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np

from benchmarks import _detectors as one_detector
from benchmarks import ext, nisp_p, nisp_s, report, vis
from benchmarks._detectors import ROOT, add_cpu_time, make_lake, plan_detector
from lake_schema.arrays import Array
from lake_schema.store.plan import Json
from truesky.render import render_exposures
from truesky.render.channels import registry
from truesky.render.effects.effect import Effect
from truesky.render.exposure import render
from truesky.render.exposure.rendered_detector import RenderedDetector
from truesky.render.sources import catalogue_rows
from truesky.request.accuracy import PRESETS, preset
from truesky.request.from_toml import parse
from truesky.request.schema import Request

RESULTS = ROOT / "benchmarks" / "results" / "stages.json"
# Functions of each stage. A stage does not contain the others.
_STAGES: tuple[tuple[Any, str, str], ...] = (
    (catalogue_rows, "read_sources", "read"),
    (render, "visible_light", "select"),
    (render, "visible_spectra", "select"),
    (render, "_draw_images", "draw"),
    (render, "_draw_spectra", "draw"),
    (render, "_apply_effects", "effects"),
)
STAGES = ("read", "select", "draw", "effects", "write", "other")
SCENES = ("vis", "nisp_p", "nisp_s", "lsst")
_NOTES = {
    "vis_survey_s": "CPU, a VIS detector of the demo field, from the catalogue to the files",
    "vis_survey_read_s": "part of it: reading the catalogues",
    "vis_survey_select_s": "choosing the sources, with their colours, shapes and PSF",
    "vis_survey_draw_s": "drawing, with truth maps",
    "vis_survey_effects_s": "effects of the detector, with its noise",
    "vis_survey_write_s": "compressing and writing the files",
    "vis_survey_other_s": "planning, tables of truth, headers",
    "vis_survey_sky_sigma": "largest difference from reference accuracy in a pixel of the sky, of its noise",
    "vis_survey_misplaced": "fraction of the light of sources that is in another pixel than at reference accuracy",
    "vis_survey_left_out": "number of effects that are left out",
    "vis_survey_left_out_sigma": "largest change of a pixel by one of them, of its noise",
}


def scene_request(name: str, folder: Path, quick: bool) -> Request:
    """Return the request for one detector of a scene.

    Parameters
    ----------
    name : str
        Name in `SCENES`.
    folder : Path
        Existing folder, in which the request is written as TOML.
    quick : bool
        If True, simulate only bright sources, so that the benchmark is fast.

    Returns
    -------
    Request
        The request at survey accuracy, with the effects that the accuracy selects.
    """
    if name == "vis":
        return vis.demo_request(quick)
    texts = {
        "nisp_p": lambda: nisp_p.request_text(quick),
        "nisp_s": lambda: nisp_s.request_text(quick, selection=nisp_s.NOTICEABLE),
        "lsst": lambda: ext.one_detector_text("lsst", quick),
    }
    file = folder / f"{name}.toml"
    file.write_text(texts[name](), encoding="utf-8")
    return parse(file)


@contextmanager
def record_stages(seconds: dict[str, float], rendered: list[RenderedDetector]) -> Iterator[None]:
    """Record the CPU time of the stages of renderings, and the rendered detectors, during a `with` block.

    `seconds` must be a defaultdict; times in s are added to it by name of the stage.
    """
    original = render._apply_effects

    def apply_and_keep(*arguments: Any) -> RenderedDetector:
        rendered.append(original(*arguments))
        return rendered[-1]

    with ExitStack() as stack:
        stack.enter_context(mock.patch.object(render, "_apply_effects", apply_and_keep))
        for module, function, stage in _STAGES:
            timed = add_cpu_time(getattr(module, function), stage, seconds)
            stack.enter_context(mock.patch.object(module, function, timed))
        yield


def measure_stages(root: Path, facts: Json, folder: Path) -> tuple[dict[str, float], RenderedDetector]:
    """Render a detector once, and measure the CPU time of its stages.

    Parameters
    ----------
    root : Path
        Folder of the lake.
    facts : dict
        Description of the rendering task, as `plan_detector` returns it.
    folder : Path
        Folder in which the image files are written.

    Returns
    -------
    seconds : dict of str to float
        CPU time in seconds of each of `STAGES`, and `all`.
    rendered : RenderedDetector
        The image and the decisions about effects.
    """
    seconds: dict[str, float] = defaultdict(float)
    rendered: list[RenderedDetector] = []
    started = time.process_time()
    with record_stages(seconds, rendered):
        output = render_exposures.render_task(root, facts)
    before_writing = time.process_time()
    for path, write in output.files.items():
        file = folder / path
        file.parent.mkdir(parents=True, exist_ok=True)
        write(file)
    seconds["all"] = time.process_time() - started
    seconds["write"] = time.process_time() - before_writing
    seconds["other"] = seconds["all"] - sum(seconds[stage] for stage in STAGES[:-1])
    # The task of an image may draw others, for example for persistence: the last one is the image itself.
    return {name: seconds[name] for name in ("all", *STAGES)}, rendered[-1]


def errors(rendered: RenderedDetector, truth: Array) -> dict[str, float]:
    """Return the errors of a rendered detector.

    Parameters
    ----------
    rendered : RenderedDetector
        The detector at some accuracy.
    truth : float array, shape (ny, nx)
        Expected electrons at reference accuracy.

    Returns
    -------
    dict of str to float
        `sky_sigma`, the largest difference in pixels in which sources have less variance than the sky; `misplaced`, the
        fraction of the light that is in another pixel; `left_out` and `left_out_sigma`, the number of effects that are
        left out, and the largest change of a pixel by one of them. Both names with "sigma" are in units of the noise of
        a pixel of the sky.
    """
    noise = rendered.scene.pixel_noise
    difference = np.abs(rendered.maps["noise_free"].astype(float) - truth)
    names = {decision.name for decision in rendered.decisions if not decision.applied}
    changes = [effect.contribution(rendered.scene) for effect in left_out_effects(rendered, names)]
    return {
        "sky_sigma": float(difference[truth < noise**2].max(initial=0.0)) / noise,
        # Light that is missing in one pixel is usually in another one.
        "misplaced": 0.5 * float(difference.sum()) / float(truth.sum()),
        "left_out": len(names),
        "left_out_sigma": max(changes, default=0.0) / noise,
    }


def left_out_effects(rendered: RenderedDetector, names: set[str]) -> list[Effect]:
    """Return the effects of a science image of the detector's channel that have the given names."""
    effects = registry.CHANNELS[rendered.exposure.channel].effects["science"]
    return [effect for effect in effects if effect.name in names]


def measure_scene(name: str, folder: Path, quick: bool, repeats: int) -> dict[str, float]:
    """Measure one detector at each accuracy.

    Parameters
    ----------
    name : str
        Name in `SCENES`.
    folder : Path
        Existing folder in which the lake and the image files are written.
    quick : bool
        If True, simulate only bright sources, at two accuracies.
    repeats : int
        Number of repeats; the one with the shortest time counts.

    Returns
    -------
    dict of str to float
        Measured values by name, such as `vis_survey_draw_s`.
    """
    request = scene_request(name, folder, quick)
    root = make_lake(folder, request)
    out: dict[str, float] = {}
    truth: Array | None = None
    for accuracy in ("reference", "quicklook") if quick else reversed(PRESETS):
        facts = plan_detector(root, replace(request, accuracy=preset(accuracy)))
        one_detector.measure_render(root, facts, folder)  # Untimed: compiles functions and fills the caches.
        measured = [measure_stages(root, facts, folder) for _ in range(repeats)]
        seconds, rendered = min(measured, key=lambda one: one[0]["all"])
        truth = rendered.maps["noise_free"].astype(float) if truth is None else truth
        figures = {"s": seconds["all"], **{f"{stage}_s": seconds[stage] for stage in STAGES}}
        figures |= errors(rendered, truth)
        out |= {f"{name}_{accuracy}_{key}": value for key, value in figures.items()}
    return out


def draw_picture(figures: Mapping[str, Any], file: Path) -> None:
    """Draw the time of each stage, and the time and the error of each accuracy, into a PNG or JPEG file.

    `figures` are the results of the benchmark.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    peers = json.loads((RESULTS.parent / "render.json").read_text(encoding="utf-8"))
    figure, axes = plt.subplots(2, len(SCENES), figsize=(15, 7.5), layout="constrained")
    titles = {"vis": "VIS", "nisp_p": "NISP-P", "nisp_s": "NISP-S", "lsst": "LSSTCam"}
    names = tuple(PRESETS)
    for column, scene in enumerate(SCENES):
        top, bottom = axes[:, column]
        start = np.zeros(len(names))
        for number, stage in enumerate(STAGES):
            part = np.array([figures[f"{scene}_{name}_{stage}_s"] for name in names])
            top.barh(names, part, left=start, color=f"C{number}", label=stage)
            start += part
        top.bar_label(top.containers[-1], [f" {value:.2g} s" for value in start], fontsize=9)
        top.margins(x=0.2)
        top.invert_yaxis()
        top.set(title=titles[scene], xlabel="CPU s of a detector")
        seconds = [figures[f"{scene}_{name}_s"] for name in names[:-1]]
        misplaced = [figures[f"{scene}_{name}_misplaced"] for name in names[:-1]]
        bottom.loglog(misplaced, seconds, "o-", color="k", label="truesky, whole detector")
        for name, error, value in zip(names[:-1], misplaced, seconds, strict=True):
            bottom.annotate(name, (error, value), (4, 4), textcoords="offset points", fontsize=8)
        for number, (peer, label) in enumerate((("galsim_cached", "GalSim, galaxies"), ("ufig", "UFig, all sources"))):
            if f"{scene}_{peer}_s" in peers:
                bottom.axhline(peers[f"{scene}_{peer}_s"], color=f"C{number + 3}", ls=":", label=f"drawing by {label}")
        bottom.set(xlabel="fraction of light in another pixel", ylabel="CPU s of a detector")
        bottom.set(xlim=(1e-4, 1e-1), ylim=(1.0, 120.0))
        bottom.set_yticks((ticks := [1, 2, 5, 10, 20, 50, 100]), [str(tick) for tick in ticks])
        bottom.minorticks_off()
        bottom.grid(alpha=0.3)
        bottom.legend(fontsize=8)
    figure.legend(*axes[0, 0].get_legend_handles_labels(), loc="outside upper center", ncols=len(STAGES))
    figure.savefig(file, dpi=110)
    plt.close(figure)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark with the options `argv` (default: the command line), print the results, return 0."""
    options = report.options("stages", __doc__ or "", argv, picture=True)
    repeats = 1 if options.quick else 3
    figures: dict[str, float] = {}
    for name in SCENES:
        with tempfile.TemporaryDirectory() as folder:
            figures |= measure_scene(name, Path(folder), options.quick, repeats)
    report.print_and_write("stages", repeats, figures, _NOTES, options.json or (None if options.quick else RESULTS))
    if options.picture is not None and not options.quick:
        draw_picture(figures, options.picture)
    return 0


if __name__ == "__main__":
    sys.exit(main())
