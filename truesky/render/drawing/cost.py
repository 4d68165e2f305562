"""Predicted cost of drawing: work, CPU time and memory."""

from __future__ import annotations

import numpy as np

from lake_schema.arrays import Float, Int
from truesky.render.drawing import far_light, outskirts, stamp_sizes, stamps, transfer, wings
from truesky.render.drawing.stamp_sizes import BRIGHT, SIZES
from truesky.render.drawing.stamps import DEEP
from truesky.render.psf.model import Psf
from truesky.render.sources import selection
from truesky.render.sources.source_list import Sources

# Measured memory of drawing, bytes: per pixel of the frame (integers and result); per pixel of the largest stamp (its
# plane and transforms) in single precision, in double precision and if it is followed beyond the PSF's last frequency;
# per source (its form and weights); and for everything else (planes of the small stamps).
_FRAME_BYTES, _STAMP_BYTES, _DOUBLE_BYTES, _DEEP_BYTES, _SOURCE_BYTES, _OTHER_BYTES = 16, 160, 190, 470, 900, 40_000_000
# Measured bytes per pixel of the largest stamp of a picture.
_PICTURE_BYTES = 370
# Measured CPU time of drawing, s (2.5 GHz, one core): per pixel of a stamp, of a PSF plane on a stamp's grid and of the
# frame; per block that a galaxy's light beyond its stamp may reach; and for everything else.
_STAMP_S, _PLANE_S, _FRAME_S, _BLOCK_S, _START_S = 2.0e-8, 2.3e-7, 1.1e-8, 1.5e-8, 0.01


def count_work(sources: Sources, sizes: Int, psf: Psf) -> tuple[int, int]:
    """Amount of work of `stamps.draw`, before anything is drawn.

    Parameters
    ----------
    sources : Sources
        Sources at rest, or pieces of trails.
    sizes : int array, shape (n,)
        Sides of their stamps, pixels.
    psf : Psf
        PSF of the detector.

    Returns
    -------
    (int, int)
        Number of stamp pixels, and number of grid points of transformed PSF planes.
    """
    planes, transformed = transfer.plane_count(psf), 0
    for size in np.unique(sizes).tolist():
        individual, sharing = stamps.split_by_size(sources, sizes, psf, size, stamps.in_double_precision(sources, None))
        transformed += size**2 * (len(individual) + planes * (len(sharing) > 0))
    return int((sizes.astype(np.int64) ** 2).sum()), transformed


def seconds(sources: Sources, sizes: Int, psf: Psf, nx: int, ny: int) -> float:
    """Predicted CPU time of `stamps.draw`, s.

    Parameters
    ----------
    sources : Sources
        Sources to be drawn.
    sizes : int array, shape (n,)
        Sides of their stamps, pixels.
    psf : Psf
        PSF of the detector.
    nx, ny : int
        Columns and rows of the detector.

    Returns
    -------
    float
        CPU time, s, accurate to a factor of 2 on the machine of the measurements.
    """
    pieces, trail, parent = stamps.split_into_pieces(sources)
    sizes = sizes[parent]
    on_frame, body = selection.overlaps_frame(pieces.column, pieces.row, sizes, nx, ny), pieces.shape >= 0
    pixels, transformed = count_work(pieces.take(on_frame), sizes[on_frame], psf)
    reach, _ = stamp_sizes.light_beyond_stamps(pieces.shapes.take(pieces.shape[body]), sizes[body], psf.pixel_scale)
    blocks = float(((2 * reach / wings.BLOCK) ** 2).sum())
    with_far_light = stamp_sizes.has_far_light(pieces.electrons, sizes, pieces.shape, pieces.picture, psf)
    far_s = far_light.seconds(sources.trail_length[np.unique(parent[with_far_light])], nx, ny)
    far_s += far_light.remove_aliased_seconds(
        np.hypot(*trail[on_frame & with_far_light].T), sizes[on_frame & with_far_light]
    )
    largest = stamp_sizes.on_largest(pieces.shape, sizes)
    far_s += outskirts.FRAME_S * nx * ny * float(largest.sum())
    far_s += outskirts.STAMP_S * float(SIZES[-1]) ** 2 * float((largest & on_frame).sum())
    return _STAMP_S * pixels + _PLANE_S * transformed + _BLOCK_S * blocks + far_s + _FRAME_S * nx * ny + _START_S


def memory(electrons: Float, sizes: Int, nx: int, ny: int, picture: Int | None = None) -> float:
    """Predicted peak memory of `stamps.draw` in addition to its arguments, from the stamps alone.

    Parameters
    ----------
    electrons : float array, shape (n,)
        Expected electrons of the sources.
    sizes : int array, shape (n,)
        Sides of their stamps, pixels.
    nx, ny : int
        Columns and rows of the detector.
    picture : int array, shape (n,), optional
        Number of the picture of each source, -1 for none; None if no source has a picture.

    Returns
    -------
    float
        Bytes. The true peak is between a third of this and this, since faint sources are not followed to the PSF's last
        frequency.
    """
    bright = electrons > BRIGHT
    pictured = np.zeros(len(sizes), bool) if picture is None else picture >= 0
    largest = [
        bytes_per_pixel * float(sizes[chosen].max(initial=0)) ** 2
        for bytes_per_pixel, chosen in (
            (_STAMP_BYTES, ~bright),
            (_DOUBLE_BYTES, bright),
            (_DEEP_BYTES, bright & (sizes <= DEEP)),
            (_PICTURE_BYTES, pictured),
        )
    ]
    return _FRAME_BYTES * nx * ny + max(largest) + _SOURCE_BYTES * len(sizes) + _OTHER_BYTES
