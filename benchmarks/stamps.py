"""Measure images of single places (`Lake.render`) and sources that are added to an image of a lake (`Lake.frame`).

The lake is that of `make demo`, by default out/demo/lake. CPU times are of one process and thread, without the first
image unless stated. Each place is compared with the noise-free image of the same detector in the lake.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

import truesky
from benchmarks import report
from lake_schema.fits import psfex

ROOT = Path(__file__).resolve().parents[1]
# Places on the VIS detector of the demo request (deg), and size of the images (arcsec).
_PLACES = ((53.117, -27.808), (53.137, -27.808), (53.117, -27.828), (53.097, -27.788), (53.102, -27.823))
_SIZE, _SMALL = 64.0, 10.0
_NEW = {"ra": [53.117], "dec": [-27.808], "mag": [20.0]}
_NOTES = {
    "import_s": "import truesky, in a process of its own (target 0.5)",
    "first_s": "first image of a process, with the PSF in the cache (target 3)",
    "vis_quicklook_s": "64 arcsec, VIS (target 0.2)",
    "vis_survey_s": "(target 0.5)",
    "vis_reference_s": "(target 0.8)",
    "vis_noise_s": "64 arcsec, VIS, survey, with noise",
    "lsst_r_s": "64 arcsec, LSST r, survey (target 0.25)",
    "small_s": "10 arcsec, VIS, survey (target 1/30)",
    "stamps_per_core_s": "10 arcsec, VIS, survey: images per s and core with two processes (target 30)",
    "largest_difference": "from the noise-free image of the detector, in units of the noise of a pixel (target 1/320)",
    "raw_s": "raw VIS image without sources",
    "frame_s": "one source added to it (target 3)",
    "given_s": "one source added to a calibrated image of 2048 x 2048 pixels, SIP (target 0.02)",
    "frame_differences": "pixels that differ from the image in the lake if no source is added (target 0)",
}


def _cpu_of(work: Callable[[], Any], places: Sequence[Any]) -> float:
    """Return the mean CPU time of a function of a place."""
    started = time.process_time()
    for place in places:
        work(place)
    return (time.process_time() - started) / len(places)


def _process_s(code: str) -> float:
    """Return the CPU time that Python code reports on its last line, when it runs in a separate process."""
    text = f"import time; {code}; print(time.process_time())"
    done = subprocess.run([sys.executable, "-c", text], cwd=ROOT, check=True, capture_output=True, text=True)
    return float(done.stdout.split()[-1])


def measure(root: Path, quick: bool) -> dict[str, float]:
    """Return CPU times in s, and differences from the images in the lake. With `quick`, only one place is drawn."""
    places = _PLACES[:1] if quick else _PLACES
    first = f"import truesky; truesky.open({str(root)!r}).render({places[0][0]}, {places[0][1]}, noise=False)"
    figures = {"import_s": _process_s("import truesky"), "first_s": _process_s(first)}
    with truesky.open(root) as lake:
        draw = {
            "vis_quicklook": {"accuracy": "quicklook"}, "vis_survey": {}, "vis_reference": {"accuracy": "reference"},
            "vis_noise": {"noise": True}, "lsst_r": {"band": "lsst_r"}, "small": {"size": _SMALL},
        }  # fmt: skip
        for name, options in draw.items():
            arguments: dict[str, Any] = {"size": _SIZE, "noise": False, **options}
            lake.render(*places[0], **arguments)
            figures[f"{name}_s"] = _cpu_of(lambda place, a=arguments: lake.render(*place, **a), places)  # type: ignore[misc]
        figures |= _differences(lake, places) | _frames(lake) | _given_frame() | _series(lake, 32 if quick else 400)
    return figures


def _differences(lake: Any, places: Sequence[tuple[float, float]]) -> dict[str, float]:
    files = lake.images("noise_free")
    path = files[files["band"] == "euclid_vis"].iloc[0]
    whole, largest = lake.image(path["path"]).data, 0.0
    for place in places:
        drawn = lake.render(*place, size=_SIZE, exposure=int(path["exposure_id"]), noise=False)
        (column, row), (ny, nx) = drawn.first_pixel, drawn.electrons.shape
        noise = np.sqrt(drawn.exposure["sky"] * drawn.exposure["exposure_time_s"])
        part = whole[row : row + ny, column : column + nx]
        # The stored image has single precision.
        rounding = 2.0**-24 * np.abs(part)
        largest = max(largest, float((np.abs(drawn.electrons - part) - rounding).max() / noise))
    return {"largest_difference": largest}


def _frames(lake: Any) -> dict[str, float]:
    files = lake.images()
    path = files[files["band"] == "euclid_vis"].iloc[0]
    frame = lake.frame(int(path["exposure_id"]), path["detector"])
    raw_s = _cpu_of(lambda _: frame.raw, [None])
    differences = int((frame.raw != lake.image(path["path"]).data).sum())
    seconds = _cpu_of(lambda rows: frame.with_sources(rows).raw, [_NEW])
    return {"raw_s": raw_s, "frame_s": seconds, "frame_differences": differences}


def _given_frame() -> dict[str, float]:
    """Add a source to an image of zeros, with distortion and a PSF file."""
    side, samples = 2048, 51
    header = fits.Header({
        "CTYPE1": "RA---TAN-SIP", "CTYPE2": "DEC--TAN-SIP", "CRVAL1": 53.117, "CRVAL2": -27.808, "CRPIX1": 1024.0,
        "CRPIX2": 1024.0, "CD1_1": -7e-5, "CD1_2": 0.0, "CD2_1": 0.0, "CD2_2": 7e-5, "A_ORDER": 2, "A_2_0": 2e-6,
        "B_ORDER": 2, "B_0_2": 2e-6, "MAGZERO": 30.0, "GAIN": 2.0, "SATURATE": 6e4,
    })  # fmt: skip
    y, x = (np.mgrid[:samples, :samples] - samples // 2) * 0.7
    light = (1.0 + (x**2 + y**2) / 6.0) ** -3.0
    planes = (light / light.sum()).astype(np.float32)[np.newaxis]
    with tempfile.TemporaryDirectory() as folder:
        image, psf = Path(folder, "image.fits"), Path(folder, "image.psf")
        fits.PrimaryHDU(np.zeros((side, side), np.float32), header).writeto(image)
        psfex.write(psf, planes, 0.7, 3.0, (side / 2, side / 2), (float(side), float(side)), 1.0)
        frame = truesky.frame(image, psf=psf)
    frame.with_sources(_NEW)
    return {"given_s": _cpu_of(lambda _: frame.with_sources(_NEW), [None] * 10)}


def _series(lake: Any, count: int) -> dict[str, float]:
    """Draw images at random places; the time counts from the first one, so that the start of processes is left out."""
    rng = np.random.default_rng(1)
    ra, dec = (np.sort(middle + rng.uniform(-0.05, 0.05, count)) for middle in _PLACES[0])
    images = lake.stamps({"ra": ra, "dec": dec}, size=_SMALL, noise=False, processes=2)
    # Each process draws its first images slowly.
    for _ in range(count // 4):
        next(images)
    started = time.perf_counter()
    drawn = sum(1 for _ in images)
    return {"stamps_per_core_s": drawn / (time.perf_counter() - started) / 2.0}


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark with the options `argv` (default: the command line), print the results, return 0."""
    options = report.options("stamps", __doc__ or "", argv, lake="lake of make demo (default: out/demo/lake)")
    root = options.lake or ROOT / "out" / "demo" / "lake"
    report.print_and_write("stamps", 1, measure(root, options.quick), _NOTES, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
