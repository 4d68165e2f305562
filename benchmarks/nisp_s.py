"""Measure the rendering of a NISP-S detector (slitless spectra) with all effects: CPU time and memory.

The time is from the catalogue to the file, in one process with one thread, which has rendered before. The image shows
the field of requests/demo.toml through grism RGS000. Most times are of an image with all spectral orders of all sources
with H_E < 23 or an H alpha flux above 1e-16 erg s-1 cm-2. Figures whose names begin with "default" are of an image with
the default selection: all sources whose light is noticeable, 38,956 instead of 10,940. Times called "cold" are without
images of the PSF in the cache, times called "warm" with them. An option also times a whole exposure by Spark.
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
# Pattern of the names of the cache folders that contain PSF images.
_PLANES = "nisp*_psf-*"
# Pointing (ICRS, deg) for which detector DET22 lies in the middle of the area of requests/demo.toml.
_RA, _DEC = 53.0135, -27.907
_RAMP = nisp_s.SKY[nisp_s.SKY.index(nisp_s.persistence.EFFECT) + 1 :]
# Number of sources that galsim draws for comparison.
_NUM_GALSIM = 8
# Width and height of the stamps that galsim draws, pixels.
_STAMP = 32
# Values of the mission parameter `nisp.spectra.selection`: all sources with noticeable light (the default), and sources
# above flux limits.
NOTICEABLE, _FLUX_LIMITED = 0, 1
_NOTES = {
    "survey_cold_s": "CPU, catalogue to FITS, all effects, PSF planes computed",
    "survey_warm_s": "the same, PSF planes from the cache (target 12 on a Xeon of 2.5 GHz)",
    "default_warm_s": "the same for the default selection of sources",
    "default_sources": "number of sources of the default selection",
    "draft_s": "as survey_warm_s, at draft accuracy with the effects that it selects (target 5)",
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
    quick: bool,
    detectors: str = 'detectors = ["DET22"]',
    place: tuple[float, float] = (_RA, _DEC),
    selection: int = _FLUX_LIMITED,
) -> str:
    """Return a request for an exposure of the field of requests/demo.toml with the red grism.

    Parameters
    ----------
    quick : bool
        If True, simulate only bright sources, so that the benchmark is fast.
    detectors : str, optional
        Line of TOML that selects detectors; "" for all detectors.
    place : tuple of float, optional
        RA and Dec of the pointing in degrees.
    selection : int, optional
        Sources whose spectra are drawn: 0 for all sources with noticeable light, which is the default of truesky, or 1
        for sources above flux limits as in Serrano et al. 2024.

    Returns
    -------
    str
        The request as TOML.
    """
    return f"""{one_detector.request_head(quick)}
[mission.overrides]
"nisp.spectra.selection" = {{ value = {selection:.1f}, unit = "" }}

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
    """Return a copy of a request that switches on all optional effects of NISP-S science images.

    Of two models of non-linearity, the one of the ramp (all readouts) is on, and not the one of the final signal.
    """
    names = [effect.name for effect in nisp_s.SKY if effect.optional and effect.name != "signal_nonlinearity"]
    return replace(request, effects=Effects(on=tuple(names)))


@contextmanager
def record_drawing(seconds: dict[str, float], drawn: list[tuple[Any, ...]]) -> Iterator[None]:
    """Record the drawing of spectra in renderings during a `with` block.

    The CPU time of drawing (`draw_s`, `colours_s`) and of computing spectra (`spectra_s`) is added to `seconds`, which
    must be a defaultdict. The arguments of each call of the drawing function are appended to `drawn`. The first call of
    a rendering draws all sources; later calls draw bright sources again, because the response of pixels depends on
    colour.
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
    """Return the mean CPU time (s) that galsim needs for the first order of a source.

    galsim draws one stamp per pixel along the trace, with the same PSF at all wavelengths. `drawn` contains the
    arguments of the drawing function of truesky: sources, dispersion, PSF. The mean is over 8 of the sources.
    """
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
    """Measure the CPU time of the stages of one rendering, and compare the drawing of spectra with galsim.

    Parameters
    ----------
    root : Path
        Folder of the lake.
    full_task : dict
        Description of the rendering task, as `plan_detector` returns it.
    folder : Path
        Folder in which the image files are written.

    Returns
    -------
    dict of str to float
        Measured values by name; a name ends with the unit of the value, such as `_s` or `_gb`.
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


def measure_default_selection(root: Path, full_task: Json, folder: Path, repeats: int) -> dict[str, float]:
    """Measure the rendering of the default selection of sources, with images of the PSF in the cache.

    Parameters
    ----------
    root : Path
        Folder of the lake.
    full_task : dict
        Description of the rendering task, as `plan_detector` returns it.
    folder : Path
        Folder in which the image files are written.
    repeats : int
        Number of repeats; the shortest time counts.

    Returns
    -------
    dict of str to float
        `default_warm_s` (CPU time in seconds) and `default_sources` (number of sources).
    """
    drawn: list[tuple[Any, ...]] = []
    with record_drawing(defaultdict(float), drawn):
        shortest = min(measure_render(root, full_task, folder)[0] for _ in range(repeats))
    return {"default_warm_s": shortest, "default_sources": len(drawn[0][0])}


def measure_detector(folder: Path, quick: bool, repeats: int) -> dict[str, float]:
    """Measure the rendering of one NISP-S detector at several accuracies.

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
    file = folder / "one.toml"
    file.write_text(request_text(quick), encoding="utf-8")
    request = parse(file)
    root = one_detector.make_lake(folder, request)
    full_task = plan_detector(root, with_all_effects(request))
    measure_render(root, full_task, folder)  # Untimed: compiles functions and fills the caches.
    out = one_detector.time_cold_and_warm(root, full_task, folder, _PLANES, repeats)
    out |= {f"survey_{state}_s": out.pop(f"{state}_s") for state in ("cold", "warm")}
    out |= measure_stages(root, full_task, folder)
    file.write_text(request_text(quick, selection=NOTICEABLE), encoding="utf-8")
    default_task = plan_detector(root, with_all_effects(parse(file)))
    out |= measure_default_selection(root, default_task, folder, repeats)
    for name, variant in (("draft", request), ("reference", with_all_effects(request))):
        facts = plan_detector(root, replace(variant, accuracy=preset(name)))
        out[f"{name}_s"] = min(measure_render(root, facts, folder)[0] for _ in range(repeats + 1))
    return out


def time_exposure(folder: Path, quick: bool) -> dict[str, float]:
    """Return the wall time (s) of the Spark job that renders all 16 detectors of an exposure, or two if `quick`.

    The result has one entry, `exposure_s`. The lake is made in `folder` before the clock starts.
    """
    text = request_text(quick, 'detectors = ["DET22", "DET23"]' if quick else "", (53.117, -27.808))
    return {"exposure_s": one_detector.time_job(folder, text.replace("radius = 0.2", f"radius = {FIELD_RADIUS}"))}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark with the options `argv` (default: the command line), print the results, return 0."""
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
