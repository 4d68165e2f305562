"""Measure the rendering of a detector of each ground camera with all effects: CPU time, memory, errors of forecasts.

The time is from the catalogue to the file, in one process with one thread, which has rendered before. The field is
observed without the Moon. All optional effects of a science image are switched on. The forecast of time and memory is
compared with the measurements. An option also times an exposure of LSSTCam by Spark.
"""

from __future__ import annotations

import argparse
import multiprocessing
import sys
import tempfile
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

from benchmarks import _detectors as one_detector
from benchmarks import report
from benchmarks._detectors import ROOT, measure_render, plan_detector
from lake_schema.store import read
from truesky.render import render_exposures
from truesky.render.channels import ground
from truesky.render.forecasting import speed
from truesky.request.accuracy import preset
from truesky.request.from_toml import parse
from truesky.request.schema import Effects, Request

RESULTS = ROOT / "benchmarks" / "results" / "ext.json"
# Radius (deg) of the simulated area that contains all sources on one detector of JPCam, the largest detector.
_FIELD_RADIUS = 0.47
# Radius (deg) of the area that contains all sources on all detectors of LSSTCam.
_LSST_RADIUS = 2.1
# Radius (deg) of the area with --quick.
_QUICK_RADIUS = 0.2
# Magnitude limits of galaxies and of stars.
_DEEP = (26.0, 26.0)
# Magnitude limits of galaxies and of stars with --quick.
_BRIGHT = (20.0, 16.0)


@dataclass(frozen=True, slots=True)
class Camera:
    """A ground camera with a passband, a detector near its optical axis, and a date.

    At the date `mjd` the field of the benchmark is high above the horizon in a night without the Moon.
    """

    name: str
    band: str
    detector: str
    mjd: float


LSST = Camera("lsstcam", "lsst_r", "R22_S11", 61088.2)
# Cameras by the beginning of the names of their results. JPCam has the largest detector. The passbands of HSC and
# Pan-STARRS (gpc1) have fringes.
CAMERAS = {
    "lsst": LSST,
    "decam": Camera("decam", "des_r", "S4", 61088.2),
    "jpcam": Camera("jpcam", "jedis_g", "ccd05", 61088.0),
    "megacam": Camera("megacam", "cfis_r", "ccd22", 61088.4),
    "hsc": Camera("hsc", "hsc_z", "1_00", 61088.4),
    "gpc1": Camera("gpc1", "ps1_i", "XY33", 61088.4),
}
_LARGEST = "jpcam"
_NOTES = {
    "lsst_survey_s": "CPU, catalogue to FITS, all effects (target 5)",
    "lsst_draft_s": "the same at draft accuracy with the effects that it selects",
    "lsst_sources": "number of galaxies and stars that are drawn",
    "decam_survey_s": "as lsst_survey_s (target 3)",
    "jpcam_survey_s": "as lsst_survey_s, 85 million pixels (target 25)",
    "jpcam_peak_gb": "peak memory of the process (target 4)",
    "seconds_error": "largest relative error of the forecast CPU time of all cameras (target 0.3)",
    "memory_error": "the same for the peak memory (target 0.3)",
    "lsst_exposure_s": "wall, 189 detectors at draft accuracy by the Spark job on 2 cores (target 720)",
}


def request_text(
    cameras: Sequence[Camera], radius: float, limits: tuple[float, float] = _DEEP, whole_cameras: bool = False
) -> str:
    """Return a request for one exposure per camera of a field that is visible from all sites.

    Parameters
    ----------
    cameras : sequence of Camera
        Cameras, each with its passband, detector and date.
    radius : float
        Radius of the simulated area in degrees.
    limits : tuple of float, optional
        Magnitude limits of galaxies and stars.
    whole_cameras : bool, optional
        If True, render all detectors at draft accuracy; by default one detector per camera at survey accuracy.

    Returns
    -------
    str
        The request as TOML.
    """
    text = f"""name = "ext"
seed = 20240401
accuracy = "{"draft" if whole_cameras else "survey"}"

[area]
cone = {{ ra = 150.117, dec = 2.208, radius = {radius} }}

[universe]
galaxy_limit = {limits[0]}
star_limit = {limits[1]}
box_cells = 192
lensing_nside = {256 if limits == _DEEP else 64}
"""
    for camera in cameras:
        detector_lines = f'centre_on = "{camera.detector}"\ndetectors = ["{camera.detector}"]'
        text += f"""
[[pointing]]
channel = "EXT"
camera = "{camera.name}"
band = "{camera.band}"
ra = 150.117
dec = 2.208
position_angle = 0.0
mjd = {camera.mjd!r}
{"" if whole_cameras else detector_lines}
"""
    return f"{text}\n[products]\ntruth = []\n"


def one_detector_text(name: str, quick: bool) -> str:
    """Return a request for one detector of a camera of `CAMERAS`, as TOML; `quick` simulates only bright sources."""
    # A detector of the largest camera covers a wider area.
    radius = _QUICK_RADIUS if quick and name != _LARGEST else _FIELD_RADIUS
    return request_text([CAMERAS[name]], radius, _BRIGHT if quick else _DEEP)


def with_all_effects(request: Request) -> Request:
    """Return a copy of a request that switches on all optional effects of science images of ground cameras."""
    return replace(request, effects=Effects(on=tuple(effect.name for effect in ground.SKY if effect.optional)))


def measure_detectors(folder: Path, quick: bool, repeats: int) -> dict[str, float]:
    """Measure the rendering of one detector of each ground camera.

    Each camera is measured in a new process, because the peak memory of a process includes that of earlier work.

    Parameters
    ----------
    folder : Path
        Existing folder in which the lake and the image files are written.
    quick : bool
        If True, simulate a small field with bright sources only, without JPCam.
    repeats : int
        Number of repeats of each measurement; the shortest time counts.

    Returns
    -------
    dict of str to float
        Measured values by name; a name ends with the unit of the value, such as `_s` or `_gb`.
    """
    file, out = folder / "detectors.toml", dict[str, float]()
    cameras = {name: camera for name, camera in CAMERAS.items() if not (quick and name == _LARGEST)}
    field, limits = (_QUICK_RADIUS, _BRIGHT) if quick else (_FIELD_RADIUS, _DEEP)
    file.write_text(request_text(tuple(cameras.values()), field, limits), encoding="utf-8")
    request = parse(file)
    root = one_detector.make_lake(folder, request)
    context = multiprocessing.get_context("spawn")
    for number, name in enumerate(cameras):
        camera_request = replace(request, pointings=request.pointings[number : number + 1])
        with ProcessPoolExecutor(1, mp_context=context) as process:
            out |= process.submit(_camera_figures, name, root, camera_request, repeats).result()
    worst = {unit: max(abs(out[f"{name}_{unit}_error"]) for name in cameras) for unit in ("s", "gb")}
    return {**out, "seconds_error": worst["s"], "memory_error": worst["gb"]}


def _camera_figures(name: str, root: Path, camera_request: Request, repeats: int) -> dict[str, float]:
    """Measure the rendering of one detector of a camera, and the errors of the forecast; return the results by name.

    `name` is the key of the camera in CAMERAS. `camera_request` contains only the exposure of this camera.
    """
    folder, full_task = root.parent, plan_detector(root, with_all_effects(camera_request))
    # The first rendering is not timed: it compiles functions and fills the caches.
    sources = render_exposures.render_task(root, full_task).rows["sources"][0].as_py()
    measurements = [measure_render(root, full_task, folder) for _ in range(repeats)]
    (forecast,) = read.version(root, "tasks").rows().to_pylist()
    out = {
        f"{name}_sources": float(sources),
        f"{name}_survey_s": min(seconds for seconds, _ in measurements),
        f"{name}_peak_gb": max(gb for _, gb in measurements),
    }
    factor = speed.estimate_speed(root).factor
    out[f"{name}_s_error"] = factor * forecast["seconds"] / out[f"{name}_survey_s"] - 1.0
    out[f"{name}_gb_error"] = forecast["memory"] / out[f"{name}_peak_gb"] - 1.0
    if name == "lsst":
        out |= one_detector.effect_seconds(ground.EFFECTS, (), lambda: measure_render(root, full_task, folder))
        draft = plan_detector(root, replace(camera_request, accuracy=preset("draft")))
        out |= {"lsst_draft_s": min(measure_render(root, draft, folder)[0] for _ in range(repeats))}
    return out


def time_exposure(folder: Path, limits: tuple[float, float]) -> Mapping[str, float]:
    """Return the wall time (s) of the Spark job that renders all 189 detectors of LSSTCam, as `lsst_exposure_s`.

    `limits` are the magnitude limits of galaxies and of stars. The lake is made in `folder` before the clock starts.
    """
    return {
        "lsst_exposure_s": one_detector.time_job(folder, request_text([LSST], _LSST_RADIUS, limits, whole_cameras=True))
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark with the options `argv` (default: the command line), print the results, return 0."""
    extra_parser = argparse.ArgumentParser(add_help=False)
    extra_parser.add_argument("--exposure", action="store_true", help="also time an exposure by the Spark job")
    extra_parser.add_argument("--repeats", type=int, default=2, help="repeats; the shortest time counts")
    extra_options, other_arguments = extra_parser.parse_known_args(argv)
    options = report.options("ext", __doc__ or "", other_arguments)
    repeats = 1 if options.quick else extra_options.repeats
    with tempfile.TemporaryDirectory() as name:
        figures = measure_detectors(Path(name), options.quick, repeats)
        if extra_options.exposure:
            figures |= time_exposure(Path(name), _BRIGHT if options.quick else _DEEP)
    report.print_and_write("ext", repeats, figures, _NOTES, options.json or (None if options.quick else RESULTS))
    return 0


if __name__ == "__main__":
    sys.exit(main())
