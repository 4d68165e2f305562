"""Measure a NISP-S detector with all effects: CPU time from catalogue to file, and memory; and exposures by Spark.

The benchmark uses one process and one thread. The image is the field of the demo with grism RGS000: all sources to
H_E = 23 or with an H alpha flux of 1e-16, in all orders. The process has rendered before, like a worker. "cold" is
without the planes of the PSF in the cache, "warm" with them.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import galsim
import numpy as np

from benchmarks import _detectors as one_detector
from benchmarks import _dispersion, _peers_slitless, report
from benchmarks._detectors import FIELD_RADIUS, ROOT, measure_render, plan_detector
from lake_schema.store.plan import Json
from truesky.render.channels import nisp_s
from truesky.render.dispersing import draw
from truesky.render.drawing import transfer
from truesky.render.sources import galaxy_shapes, spectra
from truesky.request.accuracy import preset
from truesky.request.from_toml import parse
from truesky.request.schema import Effects, Request

RESULTS = ROOT / "benchmarks" / "results" / "nisp_s.json"
# Folders of the PSF's planes in the cache.
_PLANES = "nisp*_psf-*"
# Pointing (deg) for which DET22 lies in the middle of the area of the demo.
_RA, _DEC = 53.0135, -27.907
_RAMP = nisp_s.SKY[nisp_s.SKY.index(nisp_s.persistence.EFFECT) + 1 :]
# Number of sources that galsim draws, and side of its stamps in pixels.
_NUM_GALSIM, _STAMP = 8, 32
_NOTES = {
    "survey_cold_s": "CPU, catalogue to FITS, all effects, PSF planes computed",
    "survey_warm_s": "the same, PSF planes from the cache (target 12 on a Xeon of 2.5 GHz)",
    "draft_s": "the same at draft accuracy with the effects that it selects (target 5)",
    "reference_s": "the same at reference accuracy with all effects (target 40)",
    "draw_s": "part of survey_warm_s: drawing all spectra once, including",
    "spectra_s": "the computation of the spectra (target 1.5)",
    "colours_s": "part of survey_warm_s: drawing bright sources again for the response of pixels to colours",
    "sources": "number of sources whose spectra are drawn",
    "ramp_s": "part of survey_warm_s: effects from cosmic rays to the converter",
    "peak_gb": "peak memory of the process at survey accuracy (target 2)",
    "exposure_s": "wall, an exposure of 16 detectors by the Spark job on 2 cores (target 480 for four exposures)",
    "spectrum_s": "CPU, first order of a star or a small galaxy in the comparison with slitlessutils",
    "slitlessutils_spectrum_s": "CPU, the same by slitlessutils",
    "against_slitlessutils": "time of slitlessutils / ours",
    "slitlessutils_flux": "largest relative difference of light in intervals of 64 pixels (target 0.01)",
    "against_galsim": "time of galsim for a first order, pixel by pixel / ours for all orders",
}


def request_text(
    quick: bool, detectors: str = 'detectors = ["DET22"]', place: tuple[float, float] = (_RA, _DEC)
) -> str:
    """Return a request for the field of the demo with the red grism; spectra are selected as in Serrano et al. 2024.

    Parameters
    ----------
    quick : bool
        Use a universe with bright sources only.
    detectors : str, optional
        Line of the request that selects detectors.
    place : tuple of float, optional
        RA and Dec of the pointing in degrees.

    Returns
    -------
    str
        The request as TOML.
    """
    return f"""{one_detector.request_head(quick)}
[mission.overrides]
"nisp.spectra.selection" = {{ value = 1.0, unit = "" }}

[fluxes]
bands = ["euclid_h", "nisp_red"]

[[observation]]
channels = ["NISP-S"]
ra = {place[0]}
dec = {place[1]}
position_angle = 0.0
dither = "none"
{detectors}
mjd = 60905.0
"""


def with_all_effects(request: Request) -> Request:
    """Force all effects of a science image on, with the non-linearity of the ramp in place of that of the signal."""
    names = [effect.name for effect in nisp_s.SKY if effect.optional and effect.name != "signal_nonlinearity"]
    return replace(request, effects=Effects(on=tuple(names)))


@contextmanager
def record_drawing(seconds: dict[str, float], drawn: list[tuple[Any, ...]]) -> Iterator[None]:
    """Add the CPU time of drawing and of spectra to `seconds`, and the arguments of drawing to `drawn`.

    A rendering draws all sources first, and then some of them again for their colours.
    """
    original_draw, original_of_rows = draw.draw, spectra.spectrum_function

    def draw_and_record(*arguments: Any, **options: Any) -> Any:
        name = "colours_s" if drawn else "draw_s"
        drawn.append(arguments)
        return one_detector.add_cpu_time(original_draw, name, seconds)(*arguments, **options)

    def read_timed_spectra(*arguments: Any, **options: Any) -> Any:
        prepared_of = one_detector.add_cpu_time(original_of_rows, "spectra_s", seconds)
        return one_detector.add_cpu_time(prepared_of(*arguments, **options), "spectra_s", seconds)

    draw.draw, spectra.spectrum_function = draw_and_record, read_timed_spectra
    try:
        yield
    finally:
        draw.draw, spectra.spectrum_function = original_draw, original_of_rows


def galsim_seconds(drawn: tuple[Any, ...]) -> float:
    """Return the mean CPU time (s) of galsim for a first order: one stamp per pixel of the trace, and one PSF."""
    sources, dispersed, psf = drawn[:3]
    (first,) = (order.trace for order in dispersed.orders if order.trace.order == 1)
    indices = np.linspace(0, len(sources) - 1, _NUM_GALSIM).astype(int)
    weights = transfer.basis_weights(psf, None, sources.column, sources.row)
    seconds = 0.0
    for i in indices.tolist():
        psf_image = galsim.InterpolatedImage(
            galsim.Image(transfer.image_of(psf.planes, weights[i]), scale=1.0 / psf.planes.samples)
        )
        along, across = first.polynomials(float(sources.column[i]), float(sources.row[i]))
        frame = galsim.ImageF(galsim.BoundsI(-1024, 1024, -256, 256), init_value=0.0)
        started = time.process_time()
        profile = psf_image
        if sources.shape[i] >= 0:
            body = galaxy_shapes.profile(sources.shapes, int(sources.shape[i]), 1e-6)
            profile = galsim.Convolve([galsim.JacobianWCS(*sources.jacobian[i].ravel()).toImage(body), psf_image])
        for t in np.linspace(0.0, 1.0, max(int(abs(along[1:].sum())), 1)):
            x, y = (float(np.polynomial.polynomial.polyval(t, part)) for part in (along, across))
            stamp = profile.drawImage(nx=_STAMP, ny=_STAMP, scale=1.0, center=galsim.PositionD(x, y))
            shared = frame.bounds & stamp.bounds
            frame[shared] += stamp[shared]
        seconds += time.process_time() - started
    return seconds / len(indices)


def measure_stages(root: Path, full_task: Json, folder: Path) -> dict[str, float]:
    """Measure the stages of one rendering, and compare with galsim for the same number of sources.

    Parameters
    ----------
    root : Path
        Folder of the lake.
    full_task : dict
        Facts of the task.
    folder : Path
        Folder for the files.

    Returns
    -------
    dict of str to float
        The figures.
    """
    seconds: dict[str, float] = defaultdict(float)
    drawn: list[tuple[Any, ...]] = []
    with record_drawing(seconds, drawn):
        effects = one_detector.effect_seconds(
            nisp_s.EFFECTS,
            (nisp_s.CHANNEL.persistence_effect, nisp_s.CHANNEL.chromatic_effect),
            lambda: measure_render(root, full_task, folder),
        )
    sources = len(drawn[0][0])
    return {
        **seconds,
        "sources": sources,
        "ramp_s": sum(effects[f"effect_{effect.name}_s"] for effect in _RAMP),
        "against_galsim": galsim_seconds(drawn[0]) * sources / seconds["draw_s"],
        **effects,
    }


def measure_detector(folder: Path, quick: bool, repeats: int) -> dict[str, float]:
    """Return all figures of a detector.

    Parameters
    ----------
    folder : Path
        Folder for the lake and the files.
    quick : bool
        Use a universe with bright sources only.
    repeats : int
        Number of repeats.

    Returns
    -------
    dict of str to float
        The figures.
    """
    file = folder / "one.toml"
    file.write_text(request_text(quick), encoding="utf-8")
    request = parse(file)
    root = one_detector.make_lake(folder, request)
    full_task = plan_detector(root, with_all_effects(request))
    measure_render(root, full_task, folder)  # Compile, and fill the other caches.
    out = one_detector.time_cold_and_warm(root, full_task, folder, _PLANES, repeats)
    out |= {f"survey_{state}_s": out.pop(f"{state}_s") for state in ("cold", "warm")}
    out |= measure_stages(root, full_task, folder)
    for name, variant in (("draft", request), ("reference", with_all_effects(request))):
        facts = plan_detector(root, replace(variant, accuracy=preset(name)))
        out[f"{name}_s"] = min(measure_render(root, facts, folder)[0] for _ in range(repeats + 1))
    return out


def time_exposure(folder: Path, quick: bool) -> dict[str, float]:
    """Return the wall time (s) of the Spark job for all 16 detectors of an exposure, or for two if `quick`."""
    text = request_text(quick, 'detectors = ["DET22", "DET23"]' if quick else "", (53.117, -27.808))
    return {"exposure_s": one_detector.time_job(folder, text.replace("radius = 0.2", f"radius = {FIELD_RADIUS}"))}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark and print the figures."""
    extra_parser = argparse.ArgumentParser(add_help=False)
    extra_parser.add_argument("--exposure", action="store_true", help="also time an exposure by the Spark job")
    extra_parser.add_argument(
        "--peer",
        action="store_true",
        help=f"also time slitlessutils, see ${_peers_slitless.PYTHON_VARIABLE}",
    )
    extra_parser.add_argument(
        "--settings", action="store_true", help="only measure the settings of drawing again and write their table"
    )
    extra_parser.add_argument("--repeats", type=int, default=2, help="repeats; the shortest time counts")
    extra_options, other_arguments = extra_parser.parse_known_args(argv)
    options = report.options("nisp_s", __doc__ or "", other_arguments)
    repeats = 1 if options.quick else extra_options.repeats
    if extra_options.settings:
        draw.TABLE.write_text(_dispersion.settings_table(repeats), encoding="utf-8")
        return 0
    with tempfile.TemporaryDirectory() as name:
        figures = measure_detector(Path(name), options.quick, repeats)
        if extra_options.exposure:
            figures |= time_exposure(Path(name), options.quick)
        if extra_options.peer:
            figures |= _peers_slitless.slitlessutils_figures()
    report.print_and_write("nisp_s", repeats, figures, _NOTES, options.json or (None if options.quick else RESULTS))
    return 0


if __name__ == "__main__":
    sys.exit(main())
