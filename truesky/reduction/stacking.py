"""Resampled images of the same sky combined into one, without cosmic rays and whatever else is in one of them alone.

combined             images on a grid -> their weighted mean, its weight and flags
noise_correlation    how much more the noise of sums is than their pixels tell
effective_psf        what a point source is in the stack

Ref : Gruen, Seitz & Bernstein 2014, PASP 126, 158: the clipped mean of SWarp
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

# Part of a pixel that an image covers, to count there.
_MIN_COVER = 0.5
# From the median: standard deviations, part of it, and part of its largest step to a neighbour: pixels of undersampled
# stars differ from dither to dither (Gruen et al. 2014; the last as Fruchter & Hook 2002).
_SIGMAS, _PART, _STEP = 5.0, 0.1, 1.0
# The same for the neighbours of what is rejected.
_NEIGHBOUR_FACTOR = 0.4
# Where noise is measured: weight over the median one; widths of the Gaussians, pixels, with which sources are found.
_MIN_DEPTH, _WIDTHS = 0.7, (1.5, 6.0)
# Side of the blocks whose sums are compared with pixels.
BLOCK = 8
# Side of the effective PSF, grid pixels (odd), and samples of it a pixel.
PSF_SIDE, PSF_SAMPLES = 41, 3


@dataclass(frozen=True, slots=True)
class Stack:
    """A combined image.

    reduced  : e-/s in a pixel of the grid; weight: inverse variance a pixel of sums over many pixels; flags
    variance : float32[ny, nx] of the pixels alone, which share their noise with their neighbours
    """

    reduced: ReducedImage
    variance: Float


def combine(images: Sequence[ResampledImage], weights: Sequence[float]) -> Stack:
    """The mean of images [ny, nx] on the same grid, each with one weight for all of its pixels.

    weights : of the images; the same all over an image, or a star would have another PSF than a faint galaxy
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
    """Pixels [n, ny, nx] that are unlike those of the other images, and what is a little so beside them.

    Of two images the fainter one is believed; one alone is.
    """
    count = is_covered.sum(axis=0)
    inside = np.where(is_covered, light, np.inf)
    ordered = np.sort(inside, axis=0)
    # The median; of two, and between two, the lower.
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
    """Variance of sums of blocks of 8 x 8 pixels over 64 times that of the pixels, where there are no sources.

    returns : 1 where pixels share no noise; NaN where too few blocks are empty
    """
    image, good = stack.reduced.image.astype(float), stack.reduced.flags == 0
    weight = stack.reduced.weight.astype(float)
    if not good.any():
        return float("nan")
    # At the edges the sky is badly known.
    good &= weight >= _MIN_DEPTH * np.median(weight[good])
    floor = float(np.median(1.0 / weight[good]))
    above = np.where(good, image - calibration.sky_level(image, good), 0.0)
    source = np.zeros(image.shape, bool)
    for width in _WIDTHS:
        # Noise of a mean over a Gaussian.
        noise = np.sqrt(floor / (4.0 * np.pi)) / width
        bright = ndimage.gaussian_filter(above, width) > 4.0 * noise
        source |= ndimage.binary_dilation(bright, iterations=round(2 * width))
    ny, nx = (n // BLOCK * BLOCK for n in image.shape)
    empty = np.where(good & ~source, above * np.sqrt(weight), np.nan)[:ny, :nx]
    blocks = empty.reshape(ny // BLOCK, BLOCK, nx // BLOCK, BLOCK)
    # Of differences from the next block but one: they share no noise, and next to all of the sky.
    sums, pixels = (
        _lagged_differences(values, 2) for values in (blocks.sum(axis=(1, 3)), blocks.transpose(0, 2, 1, 3))
    )
    if len(sums) < 50:
        return float("nan")
    return _clipped_variance(sums) / (BLOCK**2 * _clipped_variance(pixels))


def _lagged_differences(values: Float, lag: int) -> Float:
    """Differences of values so far apart along the first two axes, those that are numbers."""
    differences = np.concatenate([(values[lag:] - values[:-lag]).ravel(), (values[:, lag:] - values[:, :-lag]).ravel()])
    return np.asarray(differences[np.isfinite(differences)])


def _clipped_variance(values: Float) -> float:
    """Without what is four standard deviations, of the median's, from the median."""
    off = values - np.median(values)
    return float(np.var(off[np.abs(off) < 4.0 * 1.4826 * np.median(np.abs(off))]))


@dataclass(frozen=True, slots=True)
class Contribution:
    """What of an image makes the PSF of a stack; profile : galsim object in its detector's axes, without the pixel."""

    wcs: WCS
    shape: tuple[int, ...]
    profile: Any
    pixel_scale: float
    weight: float


def effective_psf(images: Sequence[Contribution], grid: Grid, x: float, y: float) -> Float:
    """What a source at (x, y) of the grid is in the stack: float64[side, side], of sum 1 but for what lies beyond.

    images  : of the stack
    returns : PSF_SAMPLES samples a pixel, the pixel in it (an effective PSF: its values are those of pixels at such
              offsets from the source); its middle sample is the source's place
    Error   : the PSF is that of the middle of each detector
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
    """A point source at (x, y) of a window, drawn on the image's pixels about it and resampled like the image."""
    if not _covers(image, window, PSF_SIDE // 2):
        return None
    sky = astrometry.sky_of_pixel(window.wcs, [x], [y])
    column, row = (float(v[0]) for v in astrometry.pixel_of_sky(image.wcs, *sky))
    # A quarter more on every side: the detector may be turned against the grid.
    side = 2 * (3 * PSF_SIDE // 4) + 1
    first_column, first_row = round(column) - side // 2, round(row) - side // 2
    offset = column - first_column - (side - 1) / 2, row - first_row - (side - 1) / 2
    pixels = image.profile.drawImage(nx=side, ny=side, scale=image.pixel_scale, offset=offset).array.astype(float)
    stamp = ReducedImage(pixels, np.ones(pixels.shape, np.float32), np.zeros(pixels.shape, np.uint8))
    pixmap, area = pixel_map(astrometry.shift_pixels(image.wcs, -first_column, -first_row), pixels.shape, window)
    return resample(stamp, pixmap, area, window.shape).image.astype(float)
