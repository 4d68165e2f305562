"""Draw a picture of four spiral galaxies, with smooth discs and with spiral arms and knots of star formation.

    python -m scripts.structure_picture [FILE]

The galaxies are drawn with the PSF of VIS and without noise. FILE is the JPEG to write, by default docs/structure.jpg.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
from matplotlib import image

from lake_schema.arrays import Float
from lake_schema.mission.configuration import resolve
from truesky.fluxes import passbands
from truesky.render.camera import astrometry, detectors
from truesky.render.camera.pointing import boresight_for
from truesky.render.drawing import stamp_sizes, stamps
from truesky.render.drawing.settings import settings_for
from truesky.render.psf import euclid
from truesky.render.sources import disc_structure, galaxy_shapes
from truesky.render.sources.disc_structure import DiscStructure
from truesky.render.sources.source_list import Sources
from truesky.request.accuracy import SURVEY
from truesky.request.structure import Arms

ROOT = Path(__file__).resolve().parents[1]
# Width and height of the panel of one galaxy, pixels.
_SIDE = 160
# Electrons per galaxy.
_LIGHT = 2e5
# Noise per pixel (electrons) from which the size of the drawn stamps is chosen; no noise is added.
_NOISE = 12.0
# Electrons per pixel at which the grey scale, asinh(electrons / _SOFT), changes from linear to logarithmic.
_SOFT = 8.0
# Electrons per pixel that are drawn white.
_WHITE = 1000.0
_GALAXIES = {
    "bulge_half_light_radius": [0.5, 0.6, 0.3, 0.4], "disk_half_light_radius": [2.2, 2.4, 1.5, 2.6],
    "bulge_fraction": [0.1, 0.3, 0.05, 0.15], "bulge_sersic_index": [2.0, 3.0, 1.5, 2.0],
    "bulge_axis_ratio": [0.9, 0.8, 0.9, 0.8], "inclination": [20.0, 48.0, 60.0, 74.0],
    "position_angle": [10.0, 60.0, 95.0, 130.0], "kappa": [0.0] * 4, "gamma1": [0.0] * 4, "gamma2": [0.0] * 4,
}  # fmt: skip


def draw(discs: DiscStructure | None) -> Float:
    """Return an image (electrons) of the four galaxies side by side.

    `discs` describes the spiral arms and knots; None means smooth discs.
    """
    mission = resolve()
    detector = replace(detectors.detector("vis", "3-4", mission), nx=4 * _SIDE, ny=_SIDE)
    system = astrometry.wcs(detector, *boresight_for(detector, 53.1, -27.8, 0.0))
    column: Float = _SIDE * (np.arange(4.0) + 0.5)
    row = np.full(4, _SIDE / 2)
    shape = galaxy_shapes.shapes(pa.table(_GALAXIES))
    jacobian = astrometry.jacobian(system, column, row)
    sources = Sources(np.arange(4), column, row, jacobian, np.full(4, _LIGHT), np.arange(4), shape)
    psf, settings = euclid.vis_psf(detector, passbands.load("euclid_vis"), mission), settings_for(SURVEY)
    sizes = stamp_sizes.stamp_sizes(sources.electrons, sources.shape, shape, psf, _NOISE, settings)
    sizes = stamp_sizes.smallest_allowed_sizes(sizes, disc_structure.sides(shape, discs) / psf.pixel_scale)
    return stamps.draw(disc_structure.add_structure(sources, shape, discs), sizes, psf, detector.nx, detector.ny)


def write(path: Path) -> None:
    """Write the picture to a JPEG file: smooth discs in one row, discs with arms and knots in the other."""
    panels = np.concatenate([draw(None)[::-1], draw(DiscStructure(Arms(), 1))[::-1]])
    grey = np.arcsinh(np.maximum(panels, 0.0) / _SOFT) / np.arcsinh(_WHITE / _SOFT)
    enlarged = np.minimum(grey, 1.0).repeat(2, axis=0).repeat(2, axis=1)
    image.imsave(path, enlarged, cmap="gray", vmin=0.0, vmax=1.0, pil_kwargs={"quality": 85})


if __name__ == "__main__":
    write(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "docs" / "structure.jpg")
