"""Draw the pictures of docs/places.md and docs/injection.md.

    python -m scripts.place_pictures [LAKE]

LAKE is the lake of `make demo`, by default out/demo/lake. The pictures are docs/places.jpg and docs/injection.jpg.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from astropy.io import fits
from matplotlib.figure import Figure

import truesky
from lake_schema.arrays import Float

ROOT = Path(__file__).resolve().parents[1]
# Galaxy of the demo in the middle of the picture (deg), and side of the picture (arcsec).
_PLACE, _SIZE = (53.0899, -27.8692), 30.0
_NEW = {
    "ra": [53.0869], "dec": [-27.867], "mag": [18.5], "half_light_radius": [1.2], "axis_ratio": [0.35],
    "position_angle": [60.0],
}  # fmt: skip
# Frame and galaxies of docs/injection.md.
_CARDS = {
    "CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRVAL1": 150.1, "CRVAL2": 2.2, "CRPIX1": 128.0, "CRPIX2": 128.0,
    "CD1_1": -0.2 / 3600, "CD1_2": 0.0, "CD2_1": 0.0, "CD2_2": 0.2 / 3600, "MAGZERO": 27.0, "GAIN": 2.0,
}  # fmt: skip
_GALAXIES = {
    "ra": [150.1, 150.1035, 150.097], "dec": [2.2, 2.2025, 2.197], "mag": [17.5, 18.0, 18.5],
    "half_light_radius": [1.2, 0.8, 0.5], "bulge_fraction": [0.2, 0.5, 0.0], "axis_ratio": [0.4, 0.8, 0.6],
    "position_angle": [30.0, 0.0, 110.0],
}  # fmt: skip
# Noise of a pixel of the frame, counts rms.
_RMS = 3.0


def write_places(lake: Path, path: Path) -> None:
    """Write the picture of a galaxy of the demo in VIS, with another galaxy, and in LSST r to a JPEG file."""
    with truesky.open(lake) as sky:
        vis, added = (sky.render(*_PLACE, size=_SIZE, extra=extra) for extra in (None, _NEW))
        ground = sky.render(*_PLACE, size=_SIZE, band="lsst_r")
    panels = (
        ("VIS, expected electrons", vis.electrons),
        ("VIS, one exposure", vis.signal),
        ("VIS, with another galaxy", added.signal),
        ("LSST r, one exposure", ground.signal),
    )
    _write(path, panels)


def write_injection(path: Path) -> None:
    """Write the picture of a frame, the frame with three galaxies, and their difference to a JPEG file."""
    sky = np.random.default_rng(1).normal(0.0, _RMS, (256, 256)).astype(np.float32)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "image.fits"
        fits.PrimaryHDU(sky, fits.Header(_CARDS)).writeto(file)
        new = truesky.frame(file, psf=0.8).with_sources(_GALAXIES, seed=1)
    _write(path, (("frame", sky), ("with three galaxies", new.image), ("difference", new.image - sky)), _RMS)


def _write(path: Path, panels: Sequence[tuple[str, Float]], least_noise: float = 1e-3) -> None:
    """Write images side by side; the grey scale begins at the noise of an image, or `least_noise` if it is larger."""
    figure = Figure(figsize=(3.2 * len(panels), 3.5), layout="constrained")
    for axes, (title, pixels) in zip(figure.subplots(1, len(panels)), panels, strict=True):
        # The scale is linear up to the noise above the sky, and logarithmic beyond.
        level = np.median(pixels)
        noise = max(1.48 * float(np.median(np.abs(pixels - level))), least_noise)
        axes.imshow(np.arcsinh((pixels - level) / (2.0 * noise)), origin="lower", cmap="gray", vmin=-1.0, vmax=5.0)
        axes.set_title(title, fontsize=10)
        axes.set_axis_off()
    figure.savefig(path, dpi=110, pil_kwargs={"quality": 88})


if __name__ == "__main__":
    write_places(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "out/demo/lake", ROOT / "docs" / "places.jpg")
    write_injection(ROOT / "docs" / "injection.jpg")
