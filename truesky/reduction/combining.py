"""Combine frames of the same kind by a clipped mean."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lake_schema.arrays import Array, Float, Float32
from lake_schema.errors import BadInput

# Rows that are combined at a time, to limit memory.
_ROWS = 64


@dataclass(frozen=True, slots=True)
class CombinedFrame:
    """A combined frame.

    Attributes
    ----------
    mean : float32 array, shape (ny, nx)
        Mean of the frames.
    uncertainty : float32 array, shape (ny, nx)
        Uncertainty of the mean, infinite if no frame is accepted.
    count : int16 array, shape (ny, nx)
        Number of accepted frames.
    vignetted : bool
        For a flat, True if its light came through the telescope, so that it contains vignetting.
    """

    mean: Float32
    uncertainty: Float32
    count: Array
    vignetted: bool = False


def clipped_mean(frames: Array, variance: Callable[[Float, slice], Float], clip: float = 5.0) -> CombinedFrame:
    """Return the mean of the frames that are near their median, then of those near that mean.

    Parameters
    ----------
    frames : array, shape (n, ny, nx)
        The frames.
    variance : callable
        Function of the expected values of pixels [m, nx] and their rows (a slice). It returns the variance of these
        pixels in one frame.
    clip : float, optional
        Largest distance in standard deviations.

    Returns
    -------
    CombinedFrame
        The mean with its uncertainty.

    Raises
    ------
    BadInput
        If there are no frames.

    Notes
    -----
    The variance is known in advance, so that few frames are sufficient. From one or two frames, the lower value is used
    for the first step, since cosmic rays and stars only add light.
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
