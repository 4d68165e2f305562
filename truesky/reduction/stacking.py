"""Combine resampled images of the same sky to a stack, and reject cosmic rays and other outliers of single images.

The module also measures the correlated noise of a stack, and computes its effective PSF.

References
----------
Gruen, Seitz & Bernstein 2014, PASP 126, 158: the clipped mean of SWarp.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from astropy.wcs import WCS
from scipy import ndimage

from lake_schema.arrays import Bool, Float
from truesky.reduction import calibration
from truesky.reduction.calibration import COSMIC_RAY, NO_DATA, ReducedImage
from truesky.reduction.resampling import Grid, ResampledImage, pixel_map, resample
from truesky.render.camera import astrometry

# An image contributes to a pixel of the stack only if its good pixels cover more than this fraction of the pixel.
_MIN_COVER = 0.5
# Allowed difference of a value from the median of the images due to noise, in standard deviations. A value is rejected
# if its difference is larger than the sum of the differences that _SIGMAS, _PART and _STEP allow.
_SIGMAS = 5.0
# Allowed difference of a value from the median of the images, as a fraction of the median: stars are sampled
# differently in dithered images (Gruen et al. 2014).
_PART = 0.1
# Allowed difference of a value from the median of the images, as a fraction of the range (maximum minus minimum) of the
# median in the 3 x 3 pixels around (Fruchter & Hook 2002). The part of the range that noise explains does not count.
_STEP = 1.0
# Neighbours of rejected pixels are rejected beyond this fraction of the allowed number of standard deviations.
_NEIGHBOUR_FACTOR = 0.4
# The noise of a stack is measured only in pixels whose weight is at least this fraction of the median weight.
_MIN_DEPTH = 0.7
# Standard deviations, in pixels, of the two Gaussians with which sources are detected before noise is measured.
_WIDTHS = (1.5, 6.0)
# Side, in pixels, of the square blocks whose sums show the correlation of the noise.
BLOCK = 8
# Side, in pixels of the stack, of the effective PSF image (odd).
PSF_SIDE = 41
# Number of samples per pixel of the stack, along each axis, of the effective PSF image.
PSF_SAMPLES = 3


@dataclass(frozen=True, slots=True)
class Stack:
    """Weighted mean of several resampled images.

    Attributes
    ----------
    reduced : ReducedImage
        Electrons per second in each pixel, flags, and weights. The inverse of a weight is the variance of the sum over
        many pixels, divided by their number; it includes the correlation of the noise.
    variance : float32 array, shape (ny, nx)
        Variance of each single pixel. It is smaller than the inverse weight, because resampling correlates the noise of
        neighbouring pixels.
    """

    reduced: ReducedImage
    variance: Float


def combine(images: Sequence[ResampledImage], weights: Sequence[float]) -> Stack:
    """Return the weighted mean of images on the same grid, without outliers such as cosmic rays.

    Parameters
    ----------
    images : sequence of ResampledImage
        The images, at least one.
    weights : sequence of float
        Weight of each image, 0 or more. It is the same for all pixels of an image, so that bright and faint sources
        have the same PSF.

    Returns
    -------
    Stack
        The mean. Pixels without any accepted image have the value 0, the weight 0 and the flag NO_DATA. Pixels in which
        an image was rejected have the flag COSMIC_RAY.
    """
    light, cover, variance, density = (
        np.stack([getattr(image, name) for image in images]) for name in ("image", "cover", "variance", "density")
    )
    is_covered = cover > _MIN_COVER
    accepted = is_covered & ~outliers(light, np.sqrt(density), is_covered)
    share = accepted * np.reshape(weights, (-1, 1, 1))
    total = share.sum(axis=0)
    has_value = total > 0.0
    share = np.divide(share, total, out=np.zeros(share.shape), where=has_value)
    mean = (share * light).sum(axis=0)
    spread = (share**2 * density).sum(axis=0)
    weight = np.divide(1.0, spread, out=np.zeros(spread.shape), where=spread > 0.0)
    flags = np.where(has_value, 0, NO_DATA) | np.where((is_covered & ~accepted).any(axis=0), COSMIC_RAY, 0)
    reduced = ReducedImage(mean.astype(np.float32), weight.astype(np.float32), flags.astype(np.uint8))
    return Stack(reduced, (share**2 * variance).sum(axis=0).astype(np.float32))


def outliers(light: Float, sigma: Float, is_covered: Bool) -> Bool:
    """Find pixels of single images that differ from the median of all images of the same sky.

    Neighbours of such pixels are also outliers if they differ by more than 2 instead of 5 standard deviations.

    Parameters
    ----------
    light : float array, shape (n, ny, nx)
        Pixels of n images on the same grid.
    sigma : float array, shape (n, ny, nx)
        Standard deviation of the noise of each pixel.
    is_covered : bool array, shape (n, ny, nx)
        True for pixels with data; others are ignored.

    Returns
    -------
    bool array, shape (n, ny, nx)
        True for outliers.

    Notes
    -----
    In addition to the noise, a difference of a tenth of the median is allowed, plus the range (maximum minus
    minimum) that the median has in the 3 x 3 pixels around. The range is first reduced by the difference that noise
    explains. With two images, the fainter value is taken as correct. A pixel with data in one image only is never an
    outlier.
    """
    count = is_covered.sum(axis=0)
    inside = np.where(is_covered, light, np.inf)
    ordered = np.sort(inside, axis=0)
    # Take the median of the images with data; for an even number of values, the lower of the two central values.
    middle = np.take_along_axis(ordered, np.maximum(count - 1, 0)[None] // 2, axis=0)[0]
    middle = np.where(count > 0, middle, 0.0)
    noise = np.where(is_covered, sigma, 0.0).max(axis=0)
    step = ndimage.maximum_filter(middle, 3) - ndimage.minimum_filter(middle, 3)
    allowed = _PART * np.abs(middle) + _STEP * np.maximum(step - _SIGMAS * noise, 0.0)
    off = np.where(is_covered & (count > 1), np.abs(light - middle) - allowed, 0.0)
    worst = off > _SIGMAS * sigma
    neighbours = np.stack([ndimage.binary_dilation(mask, np.ones((3, 3), bool)) for mask in worst])
    return np.asarray(worst | (neighbours & (off > _NEIGHBOUR_FACTOR * _SIGMAS * sigma)))


def noise_correlation(stack: Stack) -> float:
    """Measure how strongly the noise of neighbouring pixels of a stack is correlated.

    Parameters
    ----------
    stack : Stack
        The stack.

    Returns
    -------
    float
        Variance of sums over blocks of 8 x 8 pixels without sources, divided by 64 times the variance of single pixels.
        It is 1 for independent pixels, and NaN if there are fewer than 50 pairs of blocks without sources.
    """
    image, good = stack.reduced.image.astype(float), stack.reduced.flags == 0
    weight = stack.reduced.weight.astype(float)
    if not good.any():
        return float("nan")
    # Exclude pixels at the edges of the stack, which few images cover, because the sky is uncertain there.
    good &= weight >= _MIN_DEPTH * np.median(weight[good])
    floor = float(np.median(1.0 / weight[good]))
    above = np.where(good, image - calibration.sky_level(image, good), 0.0)
    source = np.zeros(image.shape, bool)
    for width in _WIDTHS:
        # Standard deviation of the noise after smoothing with a Gaussian of this width.
        noise = np.sqrt(floor / (4.0 * np.pi)) / width
        bright = ndimage.gaussian_filter(above, width) > 4.0 * noise
        source |= ndimage.binary_dilation(bright, iterations=round(2 * width))
    ny, nx = (n // BLOCK * BLOCK for n in image.shape)
    empty = np.where(good & ~source, above * np.sqrt(weight), np.nan)[:ny, :nx]
    blocks = empty.reshape(ny // BLOCK, BLOCK, nx // BLOCK, BLOCK)
    # Subtract the next block but one: its noise is independent, and the remaining sky level nearly cancels.
    sums, pixels = (
        _lagged_differences(values, 2) for values in (blocks.sum(axis=(1, 3)), blocks.transpose(0, 2, 1, 3))
    )
    if len(sums) < 50:
        return float("nan")
    return _clipped_variance(sums) / (BLOCK**2 * _clipped_variance(pixels))


def _lagged_differences(values: Float, lag: int) -> Float:
    """Return differences between elements `lag` apart along the first and along the second axis, as a flat array.

    Differences that are not finite are left out.
    """
    differences = np.concatenate([(values[lag:] - values[:-lag]).ravel(), (values[:, lag:] - values[:, :-lag]).ravel()])
    return np.asarray(differences[np.isfinite(differences)])


def _clipped_variance(values: Float) -> float:
    """Return the variance of the values that are within 4 sigma of their median; sigma is 1.4826 times the MAD."""
    off = values - np.median(values)
    return float(np.var(off[np.abs(off) < 4.0 * 1.4826 * np.median(np.abs(off))]))


@dataclass(frozen=True, slots=True)
class Contribution:
    """Image of a stack, with the properties on which the effective PSF of the stack depends.

    Attributes
    ----------
    wcs : WCS
        WCS of the image.
    shape : tuple of int
        Shape (ny, nx) of the image.
    profile : galsim object
        PSF of the image along the axes of the detector, in arcsec, not convolved with the pixel.
    pixel_scale : float
        Pixel scale of the image in arcsec.
    weight : float
        Weight of the image in the stack.
    """

    wcs: WCS
    shape: tuple[int, ...]
    profile: Any
    pixel_scale: float
    weight: float


def effective_psf(images: Sequence[Contribution], grid: Grid, x: float, y: float) -> Float:
    """Compute the effective PSF of a stack at a position: PSF, pixel response and resampling of all images together.

    Parameters
    ----------
    images : sequence of Contribution
        Images of the stack. Images that do not cover the position are ignored.
    grid : Grid
        Pixels of the stack.
    x, y : float
        Position in pixels of the stack, from 0; it is rounded to the nearest pixel.

    Returns
    -------
    float array, shape (123, 123)
        PSF of 41 x 41 pixels of the stack with 3 samples per pixel along each axis. The source is at the central
        sample. Each value is the light in a pixel of the stack at this offset from a source of flux 1. Every third
        sample along both axes adds up to 1, less the light outside the array. The array is 0 if no image covers the
        position.

    Notes
    -----
    For each image, the PSF at the centre of its detector is used everywhere.
    """
    n, half = PSF_SAMPLES, PSF_SIDE // 2
    out = np.zeros((PSF_SIDE * n, PSF_SIDE * n))
    first = round(x) - half, round(y) - half
    window = grid.window(*first, (PSF_SIDE, PSF_SIDE))
    steps = (np.arange(n) - n // 2) / n
    total = 0.0
    for image in images:
        for j, up in enumerate(steps):
            for i, across in enumerate(steps):
                position = half - across, half - up
                stamp = _draw_point_source(image, window, *position)
                if stamp is None:
                    break
                out[j::n, i::n] += image.weight * stamp
        total += image.weight if _covers(image, window, half) else 0.0
    return out / total if total > 0.0 else out


def _covers(image: Contribution, window: Grid, half: int) -> bool:
    sky = astrometry.sky_of_pixel(window.wcs, [float(half)], [float(half)])
    column, row = (float(v[0]) for v in astrometry.pixel_of_sky(image.wcs, *sky))
    ny, nx = image.shape
    return 0.0 <= column <= nx - 1.0 and 0.0 <= row <= ny - 1.0


def _draw_point_source(image: Contribution, window: Grid, x: float, y: float) -> Float | None:
    """Draw a point source at pixel (x, y) of `window` on the pixels of an image, and resample it to the window.

    Returns None if the image does not cover the centre of the window.
    """
    if not _covers(image, window, PSF_SIDE // 2):
        return None
    sky = astrometry.sky_of_pixel(window.wcs, [x], [y])
    column, row = (float(v[0]) for v in astrometry.pixel_of_sky(image.wcs, *sky))
    # Draw an area 1.5 times as wide as the window, because the detector may be rotated relative to the window.
    side = 2 * (3 * PSF_SIDE // 4) + 1
    first_column, first_row = round(column) - side // 2, round(row) - side // 2
    offset = column - first_column - (side - 1) / 2, row - first_row - (side - 1) / 2
    pixels = image.profile.drawImage(nx=side, ny=side, scale=image.pixel_scale, offset=offset).array.astype(float)
    stamp = ReducedImage(pixels, np.ones(pixels.shape, np.float32), np.zeros(pixels.shape, np.uint8))
    pixmap, area = pixel_map(astrometry.shift_pixels(image.wcs, -first_column, -first_row), pixels.shape, window)
    return resample(stamp, pixmap, area, window.shape).image.astype(float)
