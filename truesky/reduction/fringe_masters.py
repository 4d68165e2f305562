"""Make the master fringe frame of a detector in a band from its exposures of the sky.

Each exposure is calibrated and divided by a smooth model of its sky. The median of the exposures is smoothed, and
computed once more without the sources that it reveals in each exposure. Exposures with different pointings are
required: what lies at the same pixels in all of them is taken for fringes.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import ndimage

from lake_schema.arrays import Array, Bool, Float, Float32
from truesky.numerics import matrices
from truesky.reduction import calibration, files
from truesky.reduction.calibration import Masters, SkyMesh, SkyPattern
from truesky.reduction.combining import CombinedFrame
from truesky.reduction.frames import Frame
from truesky.render.effects.light import pixel_area

# Exposures whose pointings differ by less than this (arcsec) have the same sources at the same pixels.
_LEAST_STEP = 5.0
# Degree of the polynomial of the position that describes the sky of an exposure.
_SKY_DEGREE = 2
# Pixels within this distance (pixels) of a detected source are masked.
_SOURCE_MARGIN = 5
# Light counts as a source if, smoothed by a Gaussian of one pixel, it exceeds its noise by this factor.
_SOURCE_SIGMA = 4.0
# Standard deviation in pixels of the Gaussian that smooths the master. Fringes are tens of pixels wide.
_SMOOTHING = 2.0
# Number of rows that are combined at a time, to limit memory.
_ROWS = 64


def can_combine(frames: Sequence[Frame]) -> bool:
    """Return True if the median of exposures of the sky does not contain their sources.

    Fewer than half of them may have the same pointing. They therefore have at least three pointings.
    """
    rows = [frame.exposure for frame in frames]
    ra, dec = (np.radians([getattr(row, axis) for row in rows]) for axis in ("ra", "dec"))
    place = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=-1)
    step = np.linalg.norm(place[:, None] - place, axis=-1)
    same = (step < np.radians(_LEAST_STEP / 3600.0)).sum(axis=1)
    return bool(2 * same.max(initial=0) < len(frames))


def combine(frames: Sequence[Frame], masters: Masters, stack: Array) -> CombinedFrame:
    """Combine exposures of the sky in one band to a master fringe frame.

    Parameters
    ----------
    frames : sequence of Frame
        Exposures of the sky with a detector in a band, with different pointings.
    masters : Masters
        Bias, dark and flat of the detector.
    stack : float32 array, shape (n, ny, nx)
        Temporary space for n frames, which is overwritten.

    Returns
    -------
    CombinedFrame
        Fringes as a fraction of the sky, smoothed by a Gaussian with a standard deviation of two pixels. Pixels that
        are masked in all exposures have the smoothed value of their neighbours, or 0.
    """
    variance = [0.0] * len(frames)
    for number, frame in enumerate(frames):
        stack[number], variance[number] = _relative_sky(frame, masters)
    # The first median contains the wings of sources. Pixels of an exposure that exceed it are sources, and are masked.
    first, _ = _smoothed_median(stack)
    for plane, noise in zip(stack, variance, strict=True):
        plane[_sources(plane - first, noise)] = np.nan
    mean, count = _smoothed_median(stack)
    # The median of n values has pi / 2 times the variance of their mean. The Gaussian averages 4 pi sigma^2 pixels.
    single_variance = 0.5 * np.pi * float(np.mean(variance)) / (4.0 * np.pi * _SMOOTHING**2)
    uncertainty = np.sqrt(single_variance / np.maximum(count, 1))
    return CombinedFrame(mean, uncertainty.astype(np.float32), count)


def _smoothed_median(stack: Array) -> tuple[Float32, Array]:
    """Return the median of frames, float32[ny, nx], smoothed by a Gaussian, and the number of values of each pixel.

    `stack`, float32[n, ny, nx], is NaN where a frame has no value. Pixels without a value have no influence on others.
    """
    shape = stack.shape[1:]
    mean: Float32 = np.zeros(shape, np.float32)
    count: Array = np.zeros(shape, np.int16)
    for first in range(0, shape[0], _ROWS):
        rows = slice(first, first + _ROWS)
        # NaN are the last values after sorting.
        values = np.sort(np.asarray(stack[:, rows]), axis=0)
        number = np.isfinite(values).sum(axis=0)
        middle = [
            np.take_along_axis(values, np.clip(at, 0, None)[None], axis=0)[0] for at in ((number - 1) // 2, number // 2)
        ]
        mean[rows] = np.where(number > 0, 0.5 * (middle[0] + middle[1]), 0.0)
        count[rows] = number
    share = ndimage.gaussian_filter((count > 0).astype(np.float32), _SMOOTHING, mode="nearest")
    mean = ndimage.gaussian_filter(mean, _SMOOTHING, mode="nearest")
    return np.asarray(mean / np.maximum(share, np.float32(1e-6)), np.float32), count


def _sources(above: Float32, variance: float) -> Bool:
    """Return a mask that is True near sources. `above` is an image without sky, and `variance` that of its pixels."""
    smooth = ndimage.gaussian_filter(np.nan_to_num(above), 1.0, mode="nearest")
    # A Gaussian with a standard deviation of one pixel reduces the variance by a factor of 4 pi.
    is_source = np.abs(smooth) > _SOURCE_SIGMA * np.sqrt(variance / (4.0 * np.pi))
    return np.asarray(ndimage.binary_dilation(is_source, iterations=_SOURCE_MARGIN))


def _relative_sky(frame: Frame, masters: Masters) -> tuple[Float32, float]:
    """Return a frame minus a smooth model of its sky, divided by the sky in each pixel, and the median of its variance.

    Bad pixels are NaN.
    """
    pattern = SkyPattern(area=pixel_area.parameters(frame.scene)[1:] if files.corrects_area(frame, ()) else None)
    image = calibration.calibrate(
        frame.electrons(), frame.saturated_pixels(), masters, frame.scene, frame.applied, 1.0, pattern
    )
    used = image.weight > 0.0
    sky = _smooth_sky(SkyMesh.from_image(image.image, used))
    level = float(np.median(sky))
    if not used.any() or level <= 0.0:
        return np.full(used.shape, np.nan, np.float32), 0.0
    variance = 1.0 / float(np.median(image.weight[used])) / level**2
    # The area changes the light of fringes, too.
    relative = (image.image / sky - 1.0) / pattern.factor(slice(0, len(sky)))
    return np.where(used & (sky > 0.0), relative, np.nan).astype(np.float32), variance


def _smooth_sky(mesh: SkyMesh) -> Float:
    """Return the polynomial of the position that is fitted to the levels of the sky on a mesh, float64[ny, nx]."""
    degree = min(_SKY_DEGREE, min(mesh.values.shape) - 1)
    powers = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
    y, x = (2.0 * at / max(side - 1, 1) - 1.0 for at, side in zip(mesh.middles, mesh.shape, strict=True))
    basis = np.stack([np.multiply.outer(y**j, x**i).ravel() for i, j in powers], axis=1)
    terms = matrices.least_squares(basis, mesh.values.ravel())
    along, across = (np.linspace(-1.0, 1.0, side) for side in mesh.shape)
    coefficients = np.zeros((degree + 1, degree + 1))
    for (i, j), term in zip(powers, terms, strict=True):
        coefficients[j, i] = term
    rows, columns = (np.stack([at**k for k in range(degree + 1)], axis=1) for at in (along, across))
    return np.asarray(matrices.matmul(matrices.matmul(rows, coefficients), columns.T))
