"""Measure the rendering of a NISP-P detector (near-infrared images) with all effects: CPU time and memory.

The time is from the catalogue to the file, in one process with one thread, which has rendered before. The image shows
the field of requests/demo.toml in H. "cold" times are without images of the PSF in the cache, "warm" times with them.
An option also times an exposure of 16 detectors by Spark.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from benchmarks import _detectors as one_detector
from benchmarks import report
from benchmarks._detectors import FIELD_RADIUS, ROOT, measure_render, plan_detector, plan_tasks
from truesky.render.channels import nisp_p
from truesky.request.accuracy import preset
from truesky.request.from_toml import parse
from truesky.request.schema import Effects, Request

RESULTS = ROOT / "benchmarks" / "results" / "nisp_p.json"
# Pattern of the names of the cache folders that contain PSF images.
_PLANES = "nisp*_psf-*"
_RAMP = nisp_p.SKY[nisp_p.SKY.index(nisp_p.persistence.EFFECT) + 1 :]
# Offsets of four dithers, arcsec to the east and to the north, and seconds between their starts.
_DITHERS, _DITHER_S = ((0.0, 0.0), (50.0, -30.0), (100.0, 20.0), (60.0, 100.0)), 1080.0
# Channels and bands of a dither, and seconds from its start.
_SEQUENCE = (
    ("NISP-S", "nisp_red", 0.0),
    ("NISP-P", "euclid_j", 620.0),
    ("NISP-P", "euclid_y", 754.0),
    ("NISP-P", "euclid_h", 888.0),
)
_NOTES = {
    "survey_cold_s": "CPU, catalogue to FITS, all effects, PSF planes computed (target 5)",
    "survey_warm_s": "the same, PSF planes from the cache (target 2.5)",
    "draft_s": "the same at draft accuracy with the effects that it selects (target 1)",
    "ramp_s": "part of survey_warm_s: effects from cosmic rays to the converter",
    "peak_gb": "peak memory of the process (target 1.2)",
    "third_s": "as survey_warm_s, third exposure of a dither with persistence of the first two, alone",
    "after_15_alone_s": "as survey_warm_s, after four NISP-S and eleven NISP-P exposures, whose charge maps it draws",
    "after_15_s": "the same in order of time: the map of the last of the fifteen is drawn, the others are in memory",
    "after_15_gb": "peak memory of the process in order of time",
    "exposure_s": "wall, 16 detectors by the Spark job on 2 cores (target 30)",
}


def request_text(quick: bool, detectors: str = 'detectors = ["DET22"]', exposures: int = 1) -> str:
    """Return a request for NISP exposures of the field of requests/demo.toml.

    Parameters
    ----------
    quick : bool
        If True, simulate only bright sources, so that the benchmark is fast.
    detectors : str, optional
        Line of TOML that selects detectors; "" for all detectors.
    exposures : int, optional
        Number of exposures, 1 to 3, which begin 134 s apart. The last one is in H, and earlier ones in J and Y.

    Returns
    -------
    str
        The request as TOML.
    """
    text = one_detector.request_head(quick).split("[products]")[0]
    for number, band in enumerate(("h", "j", "y")[:exposures][::-1]):
        text += f"""
[[pointing]]
channel = "NISP-P"
camera = "nisp"
band = "euclid_{band}"
ra = 53.117
dec = -27.808
{'centre_on = "DET22"' if detectors else ""}
{detectors}
mjd = {60905.0 + number * 134.0 / 86400.0!r}
"""
    return text


def sequence_text(quick: bool) -> str:
    """Return a request for sixteen exposures of the field of requests/demo.toml: NISP-S, J, Y and H in four dithers.

    If `quick` is True, only bright sources are simulated.
    """
    text = one_detector.request_head(quick).split("[products]")[0]
    for dither, (east, north) in enumerate(_DITHERS):
        for channel, band, seconds in _SEQUENCE:
            text += f"""
[[pointing]]
channel = "{channel}"
camera = "nisp"
band = "{band}"
ra = {53.117 + east / 3600.0 / math.cos(math.radians(27.808))!r}
dec = {-27.808 + north / 3600.0!r}
centre_on = "DET22"
detectors = ["DET22"]
mjd = {60905.0 + (_DITHER_S * dither + seconds) / 86400.0!r}
"""
    return text


def measure_sequence(folder: Path, root: Path, sequence: Request) -> dict[str, float]:
    """Measure the last exposure of a sequence, alone and in order of time.

    Parameters
    ----------
    folder : Path
        Existing folder in which the image files are written.
    root : Path
        Folder of the lake, with the catalogues and fluxes of the request.
    sequence : Request
        Request for the exposures.

    Returns
    -------
    dict of str to float
        `after_15_alone_s`, `after_15_s` and `after_15_gb`.
    """
    from truesky.render.previous_exposures import DEFAULT_LIMIT_MB, ChargeMaps

    charge_maps = ChargeMaps(DEFAULT_LIMIT_MB)
    previous, last = plan_tasks(root, with_all_effects(sequence))[-2:]
    single_s, _ = measure_render(root, last, folder)
    measure_render(root, previous, folder, charge_maps)
    seconds, peak = measure_render(root, last, folder, charge_maps)
    return {"after_15_alone_s": single_s, "after_15_s": seconds, "after_15_gb": peak}


def with_all_effects(request: Request) -> Request:
    """Return a copy of a request that switches on all optional effects of NISP-P science images.

    Of two models of non-linearity, the one of the ramp (all readouts) is on, and not the one of the final signal.
    """
    names = [effect.name for effect in nisp_p.SKY if effect.optional and effect.name != "signal_nonlinearity"]
    return replace(request, effects=Effects(on=tuple(names)))


def measure_detector(folder: Path, quick: bool, repeats: int) -> dict[str, float]:
    """Measure the rendering of one NISP-P detector, also as the third exposure of a sequence with persistence.

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
    three_exposures, sequence = (
        parse_text(folder, text) for text in (request_text(quick, exposures=3), sequence_text(quick))
    )
    last_exposure = replace(three_exposures, pointings=three_exposures.pointings[-1:])
    root = one_detector.make_lake(folder, sequence)
    full_task = plan_detector(root, with_all_effects(last_exposure))
    measure_render(root, full_task, folder)  # Untimed: compiles functions and fills the caches.
    out = one_detector.time_cold_and_warm(root, full_task, folder, _PLANES, repeats)
    out |= {f"survey_{state}_s": out.pop(f"{state}_s") for state in ("cold", "warm")}
    # The renderer recognises these two effects by identity, so they must not be replaced by timed copies.
    channel_effects = nisp_p.CHANNEL.persistence_effect, nisp_p.CHANNEL.chromatic_effect
    effects = one_detector.effect_seconds(
        nisp_p.EFFECTS, channel_effects, lambda: measure_render(root, full_task, folder)
    )
    out |= {"ramp_s": sum(effects[f"effect_{effect.name}_s"] for effect in _RAMP), **effects}
    draft = plan_detector(root, replace(last_exposure, accuracy=preset("draft")))
    out["draft_s"] = min(measure_render(root, draft, folder)[0] for _ in range(repeats + 1))
    last_task = plan_detector(root, with_all_effects(three_exposures), -1)
    out["third_s"] = min(measure_render(root, last_task, folder)[0] for _ in range(repeats + 1))
    return out | measure_sequence(folder, root, sequence)


def parse_text(folder: Path, text: str) -> Request:
    """Return the request of a TOML text, which is written to a file in a folder."""
    file = folder / "request.toml"
    file.write_text(text, encoding="utf-8")
    return parse(file)


def time_exposure(folder: Path, quick: bool) -> Mapping[str, float]:
    """Return the wall time (s) of the Spark job that renders all 16 detectors of an exposure, or two if `quick`.

    The result has one entry, `exposure_s`. The lake is made in `folder` before the clock starts.
    """
    text = request_text(quick, 'detectors = ["DET22", "DET23"]' if quick else "")
    return {"exposure_s": one_detector.time_job(folder, text.replace("radius = 0.2", f"radius = {FIELD_RADIUS}"))}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark with the options `argv` (default: the command line), print the results, return 0."""
    extra_parser = argparse.ArgumentParser(add_help=False)
    extra_parser.add_argument("--exposure", action="store_true", help="also time an exposure by the Spark job")
    extra_parser.add_argument("--repeats", type=int, default=2, help="repeats; the shortest time counts")
    extra_options, other_arguments = extra_parser.parse_known_args(argv)
    options = report.options("nisp_p", __doc__ or "", other_arguments)
    repeats = 1 if options.quick else extra_options.repeats
    with tempfile.TemporaryDirectory() as name:
        figures = dict(measure_detector(Path(name), options.quick, repeats))
        if extra_options.exposure:
            figures |= time_exposure(Path(name), options.quick)
    report.print_and_write("nisp_p", repeats, figures, _NOTES, options.json or (None if options.quick else RESULTS))
    return 0


if __name__ == "__main__":
    sys.exit(main())
