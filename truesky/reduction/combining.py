"""Combine several frames of the same type (such as bias frames) by a mean that rejects outliers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lake_schema.arrays import Array, Float, Float32
from lake_schema.errors import BadInput

# Number of rows of the frames that are combined at a time, to limit memory.
_ROWS = 64


@dataclass(frozen=True, slots=True)
class CombinedFrame:
    """Mean of several frames of a detector, pixel by pixel.

    Attributes
    ----------
    mean : float32 array, shape (ny, nx)
        Mean of the accepted frames.
    uncertainty : float32 array, shape (ny, nx)
        Standard deviation of the mean, in the same unit; infinite if `clipped_mean` accepts no frame, and 0 everywhere
        in an image that the user made with another program.
    count : int16 array, shape (ny, nx)
        Number of frames accepted in each pixel.
    vignetted : bool
        For a flat, True if its light came through the telescope, so that it contains vignetting. Otherwise False.
    """

    mean: Float32
    uncertainty: Float32
    count: Array
    vignetted: bool = False


def clipped_mean(frames: Array, variance: Callable[[Float, slice], Float], clip: float = 5.0) -> CombinedFrame:
    """Average frames pixel by pixel in two steps that reject outliers.

    First, values near the median of the frames are averaged, then values near this average.

    Parameters
    ----------
    frames : array, shape (n, ny, nx)
        The frames.
    variance : callable
        Function of the expected values of pixels [m, nx] and of their row numbers (a slice). It returns the variance of
        these pixels in a single frame.
    clip : float, optional
        A value is rejected if it differs from the median (first step) or from the first average (second step) by more
        than this number of standard deviations.

    Returns
    -------
    CombinedFrame
        The mean with its uncertainty. If the last step rejects all values of a pixel, its mean is the number with which
        they were compared, its count 0 and its uncertainty infinite.

    Raises
    ------
    BadInput
        If there are no frames.

    Notes
    -----
    The variance is given, not measured from the scatter, so a few frames are sufficient. With one or two frames, the
    first step uses the lower value in place of the median, because cosmic rays and stars only add light.
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
