"""Predict the cost of drawing the sources of a detector: number of pixels to be computed, CPU time and memory."""

from __future__ import annotations

import numpy as np

from lake_schema.arrays import Float, Int
from truesky.render.drawing import far_light, outskirts, stamp_sizes, stamps, transfer, wings
from truesky.render.drawing.stamp_sizes import BRIGHT, SIZES
from truesky.render.drawing.stamps import DEEP
from truesky.render.psf.model import Psf
from truesky.render.sources import selection
from truesky.render.sources.source_list import Sources

# Measured memory of drawing, bytes per pixel of the detector, for the image in integers and the result.
_FRAME_BYTES = 16
# Measured memory, bytes per pixel of the largest stamp that is drawn in single precision: PSF image and transforms.
_STAMP_BYTES = 160
# Measured memory, bytes per pixel of the largest stamp that is drawn in double precision: PSF image and transforms.
_DOUBLE_BYTES = 190
# Measured memory, bytes per pixel of the largest stamp of a bright source that has a side of at most DEEP pixels (more
# frequencies are computed for such sources).
_DEEP_BYTES = 470
# Measured memory of drawing, bytes per source: mainly its shape, and the weights of the images whose weighted sum is
# its PSF.
_SOURCE_BYTES = 900
# Measured memory of drawing for everything else, bytes: mainly transforms of the PSF for small stamps.
_OTHER_BYTES = 40_000_000
# Measured memory, bytes per pixel of the largest stamp of a source that is drawn from an image, such as a lensed arc.
_PICTURE_BYTES = 370
# Measured CPU time of drawing a source on its stamp and adding it to the image, s per pixel of the stamp (2.5 GHz, one
# core).
_STAMP_S = 2.0e-8
# Measured CPU time of transforming a PSF image for a stamp, s per pixel of the stamp (2.5 GHz, one core).
_PLANE_S = 2.3e-7
# Measured CPU time that does not depend on the sources, s per pixel of the detector (2.5 GHz, one core).
_FRAME_S = 1.1e-8
# Measured CPU time, s per block of 8 x 8 pixels to which a galaxy may add light beyond its stamp (2.5 GHz, one core).
_BLOCK_S = 1.5e-8
# Measured CPU time of drawing for everything else, s per detector (2.5 GHz, one core).
_START_S = 0.01


def count_work(sources: Sources, sizes: Int, psf: Psf) -> tuple[int, int]:
    """Predict the amount of work of `stamps.draw`.

    Parameters
    ----------
    sources : Sources
        Sources at rest, or pieces of the trails of moving sources. All are counted, also outside the detector.
    sizes : int array, shape (n,)
        Sides of the stamps on which they are drawn, pixels.
    psf : Psf
        PSF of the detector.

    Returns
    -------
    (int, int)
        Total number of pixels of all stamps; and total number of pixels of the PSF images that must be transformed, at
        the pixel scale of the detector. (0, 0) without sources.
    """
    planes, transformed = transfer.plane_count(psf), 0
    for size in np.unique(sizes).tolist():
        individual, sharing = stamps.split_by_size(sources, sizes, psf, size, stamps.in_double_precision(sources, None))
        transformed += size**2 * (len(individual) + planes * (len(sharing) > 0))
    return int((sizes.astype(np.int64) ** 2).sum()), transformed


def seconds(sources: Sources, sizes: Int, psf: Psf, nx: int, ny: int) -> float:
    """Predict the CPU time of `stamps.draw`.

    Parameters
    ----------
    sources : Sources
        Sources to be drawn.
    sizes : int array, shape (n,)
        Sides of the sources' stamps, pixels.
    psf : Psf
        PSF of the detector.
    nx, ny : int
        Number of columns and of rows of the detector.

    Returns
    -------
    float
        CPU time on one core of 2.5 GHz, s, accurate to a factor of 2.
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
    """Predict the peak memory of `stamps.draw` in addition to that of its arguments, from the sizes of the stamps.

    Parameters
    ----------
    electrons : float array, shape (n,)
        Expected electrons of the sources.
    sizes : int array, shape (n,)
        Sides of the sources' stamps, pixels.
    nx, ny : int
        Number of columns and of rows of the detector.
    picture : int array, shape (n,), optional
        Index of the picture (an image that is drawn instead of a profile or in addition) of each source, -1 for none;
        None if no source has a picture.

    Returns
    -------
    float
        Upper limit of the memory, bytes. The true peak is at least a third of this value. It is smaller because high
        frequencies are not computed for faint sources.
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
