"""A ground camera's detector with everything: CPU seconds from the catalogue to the file, and memory; all of LSSTCam.

One process, one thread, one field without the Moon. Each time is of a process that has rendered before, as a worker
has. Everything: every effect of a science image is forced on. What the forecast says is compared with it.
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
from benchmarks._detectors import ROOT, prepared, rendered
from lake_schema.store import read
from truesky.render import render_exposures
from truesky.render.channels import ground
from truesky.render.forecasting import speed
from truesky.request.accuracy import preset
from truesky.request.from_toml import parse
from truesky.request.schema import Effects, Request

RESULTS = ROOT / "benchmarks" / "results" / "ext.json"
# As far from the field's centre as sources of JPCam's detectors may lie, and of LSSTCam's all; of one in haste; deg.
_FIELD, _WHOLE, _SMALL = 0.47, 2.1, 0.2
# Faintest galaxies and stars, and those of one in haste.
_DEEP, _BRIGHT = (26.0, 26.0), (20.0, 16.0)


@dataclass(frozen=True, slots=True)
class Camera:
    """A detector near the axis, and a date, MJD, when the field is high in a dark night."""

    name: str
    band: str
    detector: str
    mjd: float


LSST = Camera("lsstcam", "lsst_r", "R22_S11", 61088.2)
# By the name of their figures; JPCam's is the largest. HSC's and Pan-STARRS' bands have fringes.
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
    "lsst_survey_s": "CPU, catalogue to FITS, everything on (target 5)",
    "lsst_draft_s": "the same at draft accuracy, its own choice of effects",
    "lsst_sources": "galaxies and stars drawn on it",
    "decam_survey_s": "as lsst_survey_s (target 3)",
    "jpcam_survey_s": "as lsst_survey_s, 85 million pixels (target 25)",
    "jpcam_peak_gb": "largest memory of the process (target 4)",
    "seconds_error": "of the forecast against CPU s, the worst of all cameras (target 0.3)",
    "memory_error": "against the peak of a worker (target 0.3)",
    "lsst_exposure_s": "wall, 189 detectors at draft accuracy by the Spark job on 2 cores (target 720)",
}


def request(cameras: Sequence[Camera], radius: float, limits: tuple[float, float] = _DEEP, whole: bool = False) -> str:
    """A field that all sites see, with a detector of each camera; or whole cameras, at draft accuracy.

    radius : deg, of the area;  limits : magnitudes of the faintest galaxies and stars
    """
    text = f"""name = "ext"
seed = 20240401
accuracy = "{"draft" if whole else "survey"}"

[area]
cone = {{ ra = 150.117, dec = 2.208, radius = {radius} }}

[universe]
galaxy_limit = {limits[0]}
star_limit = {limits[1]}
box_cells = 192
lensing_nside = {256 if limits == _DEEP else 64}
"""
    for camera in cameras:
        one = f'centre_on = "{camera.detector}"\ndetectors = ["{camera.detector}"]'
        text += f"""
[[pointing]]
channel = "EXT"
camera = "{camera.name}"
band = "{camera.band}"
ra = 150.117
dec = 2.208
position_angle = 0.0
mjd = {camera.mjd!r}
{"" if whole else one}
"""
    return f"{text}\n[products]\ntruth = []\n"


def full(wanted: Request) -> Request:
    """With every effect of a science image forced on."""
    return replace(wanted, effects=Effects(on=tuple(effect.name for effect in ground.SKY if effect.optional)))


def detectors(folder: Path, quick: bool, repeats: int) -> dict[str, float]:
    """All figures of single detectors, each camera's of a process of its own, which holds nothing of the others."""
    file, out = folder / "detectors.toml", dict[str, float]()
    cameras = {name: camera for name, camera in CAMERAS.items() if not (quick and name == _LARGEST)}
    field, limits = (_SMALL, _BRIGHT) if quick else (_FIELD, _DEEP)
    file.write_text(request(tuple(cameras.values()), field, limits), encoding="utf-8")
    wanted = parse(file)
    root = one_detector.lake(folder, wanted)
    alone = multiprocessing.get_context("spawn")
    for number, name in enumerate(cameras):
        one = replace(wanted, pointings=wanted.pointings[number : number + 1])
        with ProcessPoolExecutor(1, mp_context=alone) as process:
            out |= process.submit(_figures, name, root, one, repeats).result()
    worst = {unit: max(abs(out[f"{name}_{unit}_error"]) for name in cameras) for unit in ("s", "gb")}
    return {**out, "seconds_error": worst["s"], "memory_error": worst["gb"]}


def _figures(name: str, root: Path, one: Request, repeats: int) -> dict[str, float]:
    """Of a camera's detector; one : the request of it alone."""
    folder, everything = root.parent, prepared(root, full(one))
    # Compiles, and fills the caches.
    sources = render_exposures.work(root, everything).rows["sources"][0].as_py()
    took = [rendered(root, everything, folder) for _ in range(repeats)]
    (said,) = read.version(root, "tasks").rows().to_pylist()
    out = {
        f"{name}_sources": float(sources),
        f"{name}_survey_s": min(seconds for seconds, _ in took),
        f"{name}_peak_gb": max(gb for _, gb in took),
    }
    factor = speed.of_machine(root).factor
    out[f"{name}_s_error"] = factor * said["seconds"] / out[f"{name}_survey_s"] - 1.0
    out[f"{name}_gb_error"] = said["memory"] / out[f"{name}_peak_gb"] - 1.0
    if name == "lsst":
        out |= one_detector.effect_seconds(ground.EFFECTS, (), lambda: rendered(root, everything, folder))
        draft = prepared(root, replace(one, accuracy=preset("draft")))
        out |= {"lsst_draft_s": min(rendered(root, draft, folder)[0] for _ in range(repeats))}
    return out


def whole_exposure(folder: Path, limits: tuple[float, float]) -> Mapping[str, float]:
    """Wall s of the Spark job that renders all 189 detectors of LSSTCam; limits : as of `request`."""
    return {"lsst_exposure_s": one_detector.by_job(folder, request([LSST], _WHOLE, limits, whole=True))}


def main(argv: Sequence[str] | None = None) -> int:
    """Measures and prints everything."""
    own = argparse.ArgumentParser(add_help=False)
    own.add_argument("--exposure", action="store_true", help="also a whole exposure by the Spark job")
    own.add_argument("--repeats", type=int, default=2, help="of every time, the best of which counts")
    known, others = own.parse_known_args(argv)
    options = report.options("ext", __doc__ or "", others)
    repeats = 1 if options.quick else known.repeats
    with tempfile.TemporaryDirectory() as name:
        figures = detectors(Path(name), options.quick, repeats)
        if known.exposure:
            figures |= whole_exposure(Path(name), _BRIGHT if options.quick else _DEEP)
    report.finish("ext", repeats, figures, _NOTES, options.json or (None if options.quick else RESULTS))
    return 0


if __name__ == "__main__":
    sys.exit(main())
