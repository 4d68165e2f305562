"""Make the rows of the table `depth` in a HEALPix cell from the footprints that touch it."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import pyarrow as pa

from lake_schema import sky
from lake_schema.arrays import Array, Float, Int
from lake_schema.tables.survey.depth import BAD_PIXELS, BOTH, DEPTH, EDGE, MEASURED, ORDER, PLANNED, SATURATED
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
        Rows sorted by pixel, then by band.
    """
    bands = sorted(set(footprints.band))
    layers, is_observed = [], np.zeros((len(grid.centres), len(bands)), bool)
    for number, name in enumerate(bands):
        chosen = footprints.select(footprints.band == name)
        sums = Sums.zeros(len(grid.centres), len(VALUES))
        add_footprints(grid, chosen.normals, chosen.exposure, chosen.values, sums)
        is_observed[:, number] = sums.exposures > 0
        bits = masks(name, chosen, grid) if masks is not None else np.zeros(len(grid.centres), np.int64)
        bits = _with_measured(bits, grid, chosen, sums)
        observed = np.flatnonzero(is_observed[:, number])
        # Most bands observe all pixels of a cell or none: do not copy all sums.
        layers.append(_layer(sums if is_observed[:, number].all() else sums.select(observed), bits[observed]))
    if not is_observed.any():
        return DEPTH.empty()
    row, band = np.nonzero(is_observed)
    rows_of_band = [np.flatnonzero(band == number) for number in range(len(bands))]
    columns: dict[str, Array | pa.Array] = {}
    for name in layers[0]:
        columns[name] = np.empty(len(row), layers[0][name].dtype)
        for rows, layer in zip(rows_of_band, layers, strict=True):
            columns[name][rows] = layer[name]
    cameras = [footprints.camera[footprints.band == name][0] for name in bands]
    pixel = grid.first_pixel + row
    return DEPTH.build(
        {
            "_healpix_29": pixel << 2 * (sky.MAX_ORDER - ORDER),
            "pixel": pixel,
            "band": _texts(bands, band),
            "camera": _texts(cameras, band),
            **columns,
            "a_v": a_v[row],
        }
    )


def _texts(names: Sequence[str], numbers: Int) -> pa.Array:
    """Return the names with some numbers, as Arrow texts."""
    return pa.DictionaryArray.from_arrays(pa.array(numbers.astype(np.int16)), pa.array(names)).cast(pa.string())


def _origin(sums: Sums) -> Int:
    """Return the column `origin` of each pixel: the measured part of its exposure time is 0, all, or in between."""
    time, measured = (sums.values[VALUES.index(name)] for name in ("time", "measured_time"))
    return np.where(measured == 0.0, PLANNED, np.where(measured == time, MEASURED, BOTH))


def _with_measured(bits: Int, grid: PixelGrid, footprints: Footprints, sums: Sums) -> Int:
    """Return mask bits together with the bits that were measured on frames.

    If all exposures of a pixel were measured, its saturation is that of the frames, not the predicted one.
    """
    chosen = np.flatnonzero([measured is not None for measured in footprints.measured])
    if not len(chosen):
        return bits
    out = np.where(_origin(sums) == MEASURED, bits & ~SATURATED, bits)
    out[_pixels_of(grid, footprints, chosen, "saturated")[1]] |= SATURATED
    # An exposure counts once for a pixel that two of its detectors touch.
    pairs = np.unique(_pixels_of(grid, footprints, chosen, "bad_pixels"), axis=1)
    number = np.bincount(pairs[1], minlength=len(out))
    out[(number > 0) & (number >= sums.exposures)] |= BAD_PIXELS
    return out


def _pixels_of(grid: PixelGrid, footprints: Footprints, chosen: Int, name: str) -> Int:
    """Return exposures and indices of pixels of the cell, shape (2, n), that measurements with a name list."""
    lists = [getattr(footprints.measured[i], name) - grid.first_pixel for i in chosen]
    exposures = np.repeat(footprints.exposure[chosen], [len(pixels) for pixels in lists])
    pairs = np.stack([exposures, np.concatenate(lists)])
    return pairs[:, (pairs[1] >= 0) & (pairs[1] < len(grid.centres))]


def _layer(sums: Sums, mask_bits: Int) -> dict[str, Array]:
    """Return the columns of a band from the sums in the pixels that have exposures."""
    covered = sums.covered_fraction()
    values = dict(zip(VALUES, sums.values, strict=True))
    columns: dict[str, Array] = {
        "exposures": sums.exposures.astype(np.int16),
        "exposure_time_s": (values["time"] / covered).astype(np.float32),
        **{name: (values[name] / values["time"]).astype(np.float32) for name in _WEIGHTED},
    }
    for name in ("point", "aperture"):
        inverse = values[name] / covered
        columns[f"depth_{name}"] = (1.25 * np.log10(inverse) - 2.5 * np.log10(_SIGMA)).astype(np.float32)
    columns["covered"] = covered.astype(np.float32)
    columns["origin"] = _origin(sums).astype(np.int8)
    columns["mask"] = (np.where(sums.edges, EDGE, 0) | mask_bits).astype(np.int16)
    return columns
