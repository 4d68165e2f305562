"""Combine resampled images of the same sky, without cosmic rays and other outliers of single images.

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

# Smallest fraction of a pixel that an image must cover to be used there.
_MIN_COVER = 0.5
# Allowed difference from the median: standard deviations, fraction of the median, and fraction of its largest step to
# a neighbour. Pixels of undersampled stars differ between dithers (Gruen et al. 2014; the last one as in Fruchter &
# Hook 2002).
_SIGMAS, _PART, _STEP = 5.0, 0.1, 1.0
# Factor of the standard deviations for neighbours of rejected pixels.
_NEIGHBOUR_FACTOR = 0.4
# Noise is measured in pixels with at least this weight relative to the median. Sources are found with Gaussians of
# these widths in pixels.
_MIN_DEPTH, _WIDTHS = 0.7, (1.5, 6.0)
# Side of the blocks whose sums are compared with pixels.
BLOCK = 8
# Side of the effective PSF in pixels of the grid (odd), and its samples per pixel.
PSF_SIDE, PSF_SAMPLES = 41, 3


@dataclass(frozen=True, slots=True)
class Stack:
    """A combined image.

    Attributes
    ----------
    reduced : ReducedImage
        Electrons per second in each pixel of the grid, and flags. The weight is the inverse variance per pixel of sums
        over many pixels.
    variance : float32 array, shape (ny, nx)
        Variance of single pixels, which share noise with their neighbours.
    """

    reduced: ReducedImage
    variance: Float


def combine(images: Sequence[ResampledImage], weights: Sequence[float]) -> Stack:
    """Return the weighted mean of images on the same grid.

    Parameters
    ----------
    images : sequence of ResampledImage
        The images.
    weights : sequence of float
        Weight of each image. It is the same for all pixels of an image, so that bright and faint sources have the same
        PSF.

    Returns
    -------
    Stack
        The mean.
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
    """Find pixels that differ from the other images, and neighbours of such pixels with smaller differences.

    Parameters
    ----------
    light : float array, shape (n, ny, nx)
        Images.
    sigma : float array, shape (n, ny, nx)
        Noise of the images.
    is_covered : bool array, shape (n, ny, nx)
        True for pixels with data.

    Returns
    -------
    bool array, shape (n, ny, nx)
        True for outliers.

    Notes
    -----
    Of two images, the fainter is taken as correct. A single image has no outliers.
    """
    count = is_covered.sum(axis=0)
    inside = np.where(is_covered, light, np.inf)
    ordered = np.sort(inside, axis=0)
    # The median; for an even number of values, the lower of the two central ones.
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
    """Return the variance of sums over blocks of 8 x 8 pixels without sources, over 64 times the variance of pixels.

    Parameters
    ----------
    stack : Stack
        The stack.

    Returns
    -------
    float
        Ratio, 1 for independent pixels; NaN if there are too few blocks without sources.
    """
    image, good = stack.reduced.image.astype(float), stack.reduced.flags == 0
    weight = stack.reduced.weight.astype(float)
    if not good.any():
        return float("nan")
    # The sky is uncertain at the edges.
    good &= weight >= _MIN_DEPTH * np.median(weight[good])
    floor = float(np.median(1.0 / weight[good]))
    above = np.where(good, image - calibration.sky_level(image, good), 0.0)
    source = np.zeros(image.shape, bool)
    for width in _WIDTHS:
        # Noise of an average with Gaussian weights.
        noise = np.sqrt(floor / (4.0 * np.pi)) / width
        bright = ndimage.gaussian_filter(above, width) > 4.0 * noise
        source |= ndimage.binary_dilation(bright, iterations=round(2 * width))
    ny, nx = (n // BLOCK * BLOCK for n in image.shape)
    empty = np.where(good & ~source, above * np.sqrt(weight), np.nan)[:ny, :nx]
    blocks = empty.reshape(ny // BLOCK, BLOCK, nx // BLOCK, BLOCK)
    # Use differences between blocks two apart, which have independent noise and nearly the same sky.
    sums, pixels = (
        _lagged_differences(values, 2) for values in (blocks.sum(axis=(1, 3)), blocks.transpose(0, 2, 1, 3))
    )
    if len(sums) < 50:
        return float("nan")
    return _clipped_variance(sums) / (BLOCK**2 * _clipped_variance(pixels))


def _lagged_differences(values: Float, lag: int) -> Float:
    """Return finite differences of values at distance `lag` along the first two axes."""
    differences = np.concatenate([(values[lag:] - values[:-lag]).ravel(), (values[:, lag:] - values[:, :-lag]).ravel()])
    return np.asarray(differences[np.isfinite(differences)])


def _clipped_variance(values: Float) -> float:
    """Return the variance of values within four standard deviations (from the median deviation) of the median."""
    off = values - np.median(values)
    return float(np.var(off[np.abs(off) < 4.0 * 1.4826 * np.median(np.abs(off))]))


@dataclass(frozen=True, slots=True)
class Contribution:
    """Properties of an image that contribute to the PSF of a stack.

    Attributes
    ----------
    wcs : WCS
        WCS of the image.
    shape : tuple of int
        Shape of the image.
    profile : galsim object
        PSF in the detector's axes, without the pixel.
    pixel_scale : float
        Pixel scale in arcsec.
    weight : float
        Weight of the image in the stack.
    """

    wcs: WCS
    shape: tuple[int, ...]
    profile: Any
    pixel_scale: float
    weight: float


def effective_psf(images: Sequence[Contribution], grid: Grid, x: float, y: float) -> Float:
    """Return the effective PSF of a stack at a position.

    Parameters
    ----------
    images : sequence of Contribution
        Images of the stack.
    grid : Grid
        Grid of the stack.
    x, y : float
        Position on the grid in pixels.

    Returns
    -------
    float array, shape (PSF_SIDE PSF_SAMPLES, PSF_SIDE PSF_SAMPLES)
        PSF with `PSF_SAMPLES` samples per pixel, with the source at the central sample. It includes the pixel: each
        value is the value of a pixel at this offset from the source. The sum over samples at whole pixels is 1, less
        the light outside the array.

    Notes
    -----
    The PSF at the centre of each detector is used for the whole detector.
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
    """Draw a point source at (x, y) of a window on the image's pixels, and resample it; None if it is outside."""
    if not _covers(image, window, PSF_SIDE // 2):
        return None
    sky = astrometry.sky_of_pixel(window.wcs, [x], [y])
    column, row = (float(v[0]) for v in astrometry.pixel_of_sky(image.wcs, *sky))
    # Draw an area larger by half, since the detector may be rotated relative to the grid.
    side = 2 * (3 * PSF_SIDE // 4) + 1
    first_column, first_row = round(column) - side // 2, round(row) - side // 2
    offset = column - first_column - (side - 1) / 2, row - first_row - (side - 1) / 2
    pixels = image.profile.drawImage(nx=side, ny=side, scale=image.pixel_scale, offset=offset).array.astype(float)
    stamp = ReducedImage(pixels, np.ones(pixels.shape, np.float32), np.zeros(pixels.shape, np.uint8))
    pixmap, area = pixel_map(astrometry.shift_pixels(image.wcs, -first_column, -first_row), pixels.shape, window)
    return resample(stamp, pixmap, area, window.shape).image.astype(float)
