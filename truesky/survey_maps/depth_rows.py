"""Make the rows of the table `depth` in a HEALPix cell from the footprints that touch it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pyarrow as pa

from lake_schema import sky
from lake_schema.arrays import Array, Float, Int
from lake_schema.tables.survey.depth import DEPTH, EDGE, ORDER
from truesky.survey_maps.pixel_overlap import PixelGrid, Sums, add_footprints
from truesky.survey_maps.planned_footprints import VALUES, Footprints

# Signal-to-noise ratio of the depth.
_SIGMA = 5.0
# Column of the table for each sum that is weighted by the exposure time.
_WEIGHTED = ("sky", "seeing", "psf_area")

# Function of the name of a band, the footprints of the band, and the pixels that returns mask bits of the pixels.
MaskFunction = Callable[[str, Footprints, PixelGrid], Int]


def build(grid: PixelGrid, footprints: Footprints, a_v: Float, masks: MaskFunction | None = None) -> pa.Table:
    """Return the rows of the table `depth` in a cell.

    Parameters
    ----------
    grid : PixelGrid
        Pixels of the cell.
    footprints : Footprints
        Footprints of detectors; some may be outside the cell.
    a_v : float array, shape (n,)
        Extinction A(V) of each pixel, mag.
    masks : callable, optional
        Function that returns further mask bits of the pixels in a band.

    Returns
    -------
    pyarrow.Table
        Rows sorted by pixel, then by band. The origin of all is the plan.
    """
    bands = sorted(set(footprints.band))
    layers, is_observed = [], np.zeros((len(grid.centres), len(bands)), bool)
    for number, name in enumerate(bands):
        chosen = footprints.select(footprints.band == name)
        sums = Sums.zeros(len(grid.centres), len(VALUES))
        add_footprints(grid, chosen.normals, chosen.exposure, chosen.values, sums)
        is_observed[:, number] = sums.exposures > 0
        bits = masks(name, chosen, grid)[is_observed[:, number]] if masks is not None else 0
        layers.append(_layer(sums.select(is_observed[:, number]), bits))
    if not is_observed.any():
        return DEPTH.empty()
    row, band = np.nonzero(is_observed)
    columns: dict[str, Array | pa.Array] = {}
    for name in layers[0]:
        columns[name] = np.empty(len(row), layers[0][name].dtype)
        for number, layer in enumerate(layers):
            columns[name][band == number] = layer[name]
    cameras = [footprints.camera[footprints.band == name][0] for name in bands]
    pixel = grid.first_pixel + row
    band_number = pa.array(band, pa.int32())
    return DEPTH.build(
        {
            "_healpix_29": pixel << 2 * (sky.MAX_ORDER - ORDER),
            "pixel": pixel,
            "band": pa.array(bands).take(band_number),
            "camera": pa.array(cameras).take(band_number),
            **columns,
            "a_v": a_v[row],
            "origin": np.zeros(len(row), np.int8),
        }
    )


def _layer(sums: Sums, mask_bits: Int | int) -> dict[str, Array]:
    """Return the columns of a band from the sums in the pixels that have exposures."""
    covered = sums.covered_fraction()
    values = dict(zip(VALUES, sums.values.T, strict=True))
    columns: dict[str, Array] = {
        "exposures": sums.exposures.astype(np.int16),
        "exposure_time_s": (values["time"] / covered).astype(np.float32),
        **{name: (values[name] / values["time"]).astype(np.float32) for name in _WEIGHTED},
    }
    for name in ("point", "aperture"):
        inverse = values[name] / covered
        columns[f"depth_{name}"] = (1.25 * np.log10(inverse) - 2.5 * np.log10(_SIGMA)).astype(np.float32)
    columns["covered"] = covered.astype(np.float32)
    columns["mask"] = (np.where(sums.edges, EDGE, 0) | mask_bits).astype(np.int16)
    return columns
