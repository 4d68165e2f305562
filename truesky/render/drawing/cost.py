"""What drawing takes: floating-point work, seconds and memory.

work, seconds, memory    what it goes through, and takes
"""

from __future__ import annotations

import numpy as np

from lake_schema.arrays import Float, Int
from truesky.render.drawing import far_light, outskirts, stamp_sizes, stamps, transfer, wings
from truesky.render.drawing.stamp_sizes import BRIGHT, SIZES
from truesky.render.drawing.stamps import DEEP
from truesky.render.psf.model import Psf
from truesky.render.sources import selection
from truesky.render.sources.source_list import Sources

# Bytes while drawing, measured, of what is drawn to the PSF's last frequency: of a frame's pixel (integers and result),
# of a pixel of the largest stamp (its plane and transforms) in single and double precision, and where it is followed
# farther, of a source (its form and
# weights), of all else (planes of the small stamps).
_FRAME_BYTES, _STAMP_BYTES, _DOUBLE_BYTES, _DEEP_BYTES, _SOURCE_BYTES, _OTHER_BYTES = 16, 160, 190, 470, 900, 40_000_000
# The same of a pixel of the largest stamp of a picture.
_PICTURE_BYTES = 370
# CPU s while drawing, measured (2.5 GHz, one core): of a pixel of a stamp, of a plane of the PSF on a stamp's grid and
# of the frame; of a block that a galaxy's light beyond its stamp may reach; of all else.
_STAMP_S, _PLANE_S, _FRAME_S, _BLOCK_S, _START_S = 2.0e-8, 2.3e-7, 1.1e-8, 1.5e-8, 0.01


def count_work(sources: Sources, sizes: Int, psf: Psf) -> tuple[int, int]:
    """(pixels of stamps, samples' places of the PSF's planes) that `draw` goes through, before anything is drawn."""
    planes, transformed = transfer.plane_count(psf), 0
    for size in np.unique(sizes).tolist():
        individual, sharing = stamps.split_by_size(sources, sizes, psf, size, stamps.in_double_precision(sources, None))
        transformed += size**2 * (len(individual) + planes * (len(sharing) > 0))
    return int((sizes.astype(np.int64) ** 2).sum()), transformed


def seconds(sources: Sources, sizes: Int, psf: Psf, nx: int, ny: int) -> float:
    """CPU s that `draw` takes, predicted from the sources and their stamps.

    sources, sizes : as of `draw`;  psf : of the detector;  nx, ny : its pixels
    Error : between half and twice of what the machine takes that it was measured on
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
    """Bytes that `draw` takes at its peak on top of its arguments, predicted from the stamps alone.

    picture : of Sources
    electrons, sizes : float64[n], int64[n] stamps' sides;  nx, ny : pixels of the detector
    Error : the peak is between a third of it and all of it: what is faint is not followed to the last frequency
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
