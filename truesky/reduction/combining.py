"""Frames of the same kind combined into one: a mean without what is in few of them.

clipped_mean    frames -> mean, its uncertainty, how many frames it is of
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lake_schema.arrays import Array, Float, Float32
from lake_schema.errors import BadInput

# Rows that are combined at a time: memory.
_ROWS = 64


@dataclass(frozen=True, slots=True)
class CombinedFrame:
    """A combined frame.

    mean, uncertainty : float32[ny, nx], the latter of the mean, infinite where no frame is left
    count             : int16[ny, nx] frames that are left
    vignetted         : of a flat, whether its light came through the telescope, whose vignetting is in it
    """

    mean: Float32
    uncertainty: Float32
    count: Array
    vignetted: bool = False


def clipped_mean(frames: Array, variance: Callable[[Float, slice], Float], clip: float = 5.0) -> CombinedFrame:
    """Mean of frames [n, ny, nx] of what lies within `clip` standard deviations of their median, then of that mean.

    variance : (expected value of pixels [m, nx], their rows) -> variance of one frame's; known, so that few frames do
    Error    : of two frames, and of one, the lower is believed: rays and stars only add
    """
    if not len(frames):
        raise BadInput("no frames to combine")
    shape = frames.shape[1:]
    mean: Float32 = np.zeros(shape, np.float32)
    uncertainty: Float32 = np.zeros(shape, np.float32)
    count: Array = np.zeros(shape, np.int16)
    for first in range(0, shape[0], _ROWS):
        rows = slice(first, first + _ROWS)
        values = np.asarray(frames[:, rows], np.float64)
        centre = np.median(values, axis=0) if len(values) > 2 else values.min(axis=0)
        for _ in range(2):
            accepted = np.abs(values - centre) <= clip * np.sqrt(variance(centre, rows))
            accepted_count = accepted.sum(axis=0)
            centre = np.where(
                accepted_count > 0, np.where(accepted, values, 0.0).sum(axis=0) / np.maximum(accepted_count, 1), centre
            )
        mean[rows], count[rows] = centre, accepted_count
        with np.errstate(divide="ignore"):
            uncertainty[rows] = np.sqrt(variance(centre, rows) / accepted_count)
    return CombinedFrame(mean, uncertainty, count)
