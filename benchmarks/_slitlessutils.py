"""Disperse images of sources with the program slitlessutils, and measure its CPU time.

Usage: python benchmarks/_slitlessutils.py CONFIGURATION INPUT OUTPUT

The benchmark `_peers_slitless` runs this script with a Python interpreter that has slitlessutils. Classes of
slitlessutils read the configuration of the grism (grismconf) and invert the trace. They clip each pixel of a source
image at each wavelength against the pixels of the detector, and multiply by the sensitivity. The loop is the same as in
its modules `tabulate` and `simulate`, but without the instrument files that these would download.
"""

from __future__ import annotations

import sys
import time
import types
import urllib.request
from pathlib import Path

import numpy as np


def _no_network(*_args: object, **_options: object) -> None:
    raise OSError("network access is disabled: slitlessutils checks for new versions of its files")


def _detector(configuration: Path, shape: tuple[int, int]) -> object:
    from slitlessutils.core.wfss.config.instrumentconfig import DetectorConfig

    ny, nx = shape
    settings = {
        "naxis": [nx, ny], "crpix": [nx / 2, ny / 2], "scale": [0.3, 0.3], "noise": {"dark": 0.0, "read": 0.0},
        "extensions": {}, "siaf": {"v2": 0.0, "v3": 0.0, "v3y": 0.0},
        "blockers": {"": {"sip": None, "config": {"grism": str(configuration)}}},
    }  # fmt: skip
    return DetectorConfig("made", settings, types.SimpleNamespace(blocking="", name="grism"), "")


def main(configuration: Path, input_file: Path, output_file: Path) -> None:
    """Disperse the source images in a file and write the image of the detector.

    Parameters
    ----------
    configuration : Path
        Configuration of the grism in the format of grismconf.
    input_file : Path
        File of numpy (.npz) with the arrays `images` [n, side, side], `corners` (column and row of their first pixels
        on the detector) [n, 2], `waves` (wavelengths, A) [v], `spectra` (f_lambda) [n, v], and `shape` (ny, nx) of the
        detector.
    output_file : Path
        File of numpy (.npz) to write, with the arrays `frame` (image of the detector) and `seconds` (CPU time).
    """
    urllib.request.urlopen = _no_network  # type: ignore[assignment]
    with np.load(input_file) as read:
        images, corners, waves, spectra, shape = (read[n] for n in ("images", "corners", "waves", "spectra", "shape"))
    # slitlessutils looks for reference files of instruments and would download them. They are not needed here, so
    # create an empty set of reference files.
    fixture = Path.home() / ".slitlessutils" / "1.0.0"
    fixture.mkdir(parents=True, exist_ok=True)
    (fixture / "version.json").write_text('{"version": "1.0.0", "date": "1970-01-01"}')
    detector = _detector(configuration, tuple(shape.tolist()))
    order, step = detector["+1"], float(waves[1] - waves[0])  # type: ignore[index]
    frame, start = np.zeros(shape), time.process_time()
    for image, (first_column, first_row), spectrum in zip(images, corners, spectra, strict=True):
        detected = order.sensitivity(waves) * spectrum * step
        for row, column in np.argwhere(image > 1e-6 * image.sum()).tolist():
            # Coordinates of the four corners of the pixel; slitlessutils counts pixels from 1.
            x = first_column + column + 1 + np.array([-0.5, -0.5, 0.5, 0.5])
            y = first_row + row + 1 + np.array([-0.5, 0.5, 0.5, -0.5])
            to_x, to_y, wave, area = detector.drizzle(x, y, "+1", waves)  # type: ignore[attr-defined]
            np.add.at(frame, (to_y, to_x), area * image[row, column] * detected[wave])
    np.savez(output_file, frame=frame, seconds=time.process_time() - start)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:4]))
