"""Offset between the measured centroid of a point source and the position at which its PSF is drawn.

The centroid is the windowed one that programs for astrometry measure: the position about which the light in a Gaussian
window, centred on the same position, is balanced. Coma moves it with the width of the window and with the colour and
the position of the source. The cameras of Euclid have a fixed window (parameter <camera>.psf.window of the mission
database), in which the centroid of a source of constant f_nu lies at the position of the source. Other cameras have the
window that SourceExtractor would choose.

A program sums over pixels, which are not much smaller than the window. Its centroid therefore depends on the position
within the pixel, by 1 mas (rms) for VIS and 40 mas for NISP. Offsets are averages over positions within the pixel. For
NISP they differ by up to 0.5 mas from the balance of the light itself.

References
----------
Bertin & Arnouts 1996, and the manual of SourceExtractor (XWIN_IMAGE: window of the half-light diameter).
"""

from __future__ import annotations

import numpy as np
import scipy

from lake_schema.arrays import Array, Float
from truesky.numerics import matrices
from truesky.render.psf.model import SAMPLES, Psf

# FWHM of a Gaussian, which is also its half-light diameter, in units of its rms.
_FWHM = 2.0 * np.sqrt(2.0 * np.log(2.0))
# Half-light diameters are measured on the middle part of a PSF image, within this number of pixels along x and y. Only
# the light of this part counts.
_HALF = 32
# Pixels at more than this multiple of the window's rms from the source, along x or y, have a weight below 2e-8.
_REACH = 6.0
# Below this rms of the window (pixels), the centroid depends on the position within the pixel up to high harmonics, and
# is averaged over twice as many positions as the image has samples per pixel.
_NARROW = 0.9
# Weights of samples for a value half-way between two samples: a sinc function, which fades out within this number of
# samples on both sides.
_INTERPOLATION = 6
# A centroid has converged if it moves by less than this number of pixels in one iteration.
_CONVERGED, _ITERATIONS = 1e-9, 100


def window_rms(psf: Psf) -> float:
    """Return the rms of the Gaussian window in which centroids of point sources are measured, arcsec.

    It is that of the PSF (`Psf.window`) if it has one. Otherwise the FWHM of the window is the half-light diameter that
    aperture photometry measures, as for SourceExtractor.
    """
    return psf.keep(("centroids", "window"), lambda: _choose_window(psf))


def offsets(psf: Psf, weights: Float) -> tuple[Float, Float]:
    """Return the measured centroids of n point sources relative to the positions at which they are drawn.

    Parameters
    ----------
    psf : Psf
        PSF of the detector.
    weights : float array, shape (n, planes)
        Weights of the PSF's basis images for each source, from `drawing.transfer.basis_weights`.

    Returns
    -------
    (float array, float array), each of shape (n,)
        Measured minus drawn position, along x (columns) and y (rows), pixels. They are averages over the positions of a
        source within a pixel.

    Notes
    -----
    The windowed centroid is defined by an iteration. It is carried out for the mean colour at the detector's centre, at
    each position within a pixel. Other colours and places follow from one more step, with the same ratio of the slopes
    along x and y. For VIS and NISP the error is below 0.1 mas.
    """
    centre, steps = psf.keep(("centroids",), lambda: _linear_steps(psf))
    x, y, scale = matrices.matmul(weights, steps).T
    return centre[0] + x / scale, centre[1] + y / scale


def mean_centroid(image: Array, samples: int, window: float) -> Float:
    """Return the measured centroid (x, y) of an image of a point source, relative to its middle sample, pixels.

    Parameters
    ----------
    image : float array, shape (s, s)
        Image that is not averaged over pixels, with more than 7 rms of the window and two pixels around the middle.
    samples : int
        Samples per pixel.
    window : float
        Rms of the Gaussian window, pixels.

    Returns
    -------
    float array, shape (2,)
        Mean over positions within a pixel.
    """
    (plane,), count = _double_if_narrow([_average_over_pixels(image, samples)], samples, window)
    return np.asarray(_centres(_by_phase(plane, count), window).mean(axis=1))


def _choose_window(psf: Psf) -> float:
    if psf.window is not None:
        return psf.window
    planes, samples = _sample_planes(psf)
    # The detector averages the image over pixels once (unless the PSF already includes the pixel). The image is
    # averaged once more, because aperture photometry treats the light as uniform within a pixel.
    image = np.sum(planes[: _colour_count(psf)], axis=0)
    for _ in range(2 if psf.intra_pixel is not None else 1):
        image = _average_over_pixels(image, samples)
    return float(_half_light_diameter(image, samples) / _FWHM * psf.pixel_scale)


def _linear_steps(psf: Psf) -> tuple[Float, Float]:
    """Return the mean centroid (x, y) of a source of the mean colour at the centre of the detector, and steps from it.

    The centroid is in pixels. The steps, shape (planes, 3), are contributions of the basis images to x and y, and to
    the number by which these sums are divided: the mean slope of the first moments, relative to the mean colour.
    """
    planes, samples = _sample_planes(psf)
    window = window_rms(psf) / psf.pixel_scale
    # A PSF without a fixed window may come from a user's file, with its light away from the middle.
    reach = samples * (_HALF if psf.window is None else int(np.ceil(_REACH * window)) + 2)
    planes = [_middle(plane, reach) for plane in planes]
    if psf.intra_pixel is not None:
        planes = [_average_over_pixels(plane, samples) for plane in planes]
    planes, samples = _double_if_narrow(planes, samples, window)
    mean = np.sum(planes[: _colour_count(psf)], axis=0, dtype=float)
    centres = _centres(_by_phase(mean, samples), window)
    slopes = _slopes(_pixel_moments(_by_phase(mean, samples), window, centres), window)
    total, steps = (slopes[0] + slopes[2]).sum(), []
    for plane in planes:
        moments = _pixel_moments(_by_phase(plane, samples), window, centres)
        along_x, _, along_y = _slopes(moments, window)
        steps.append([*_balance(moments, slopes).mean(axis=1), (along_x + along_y).sum() / total])
    return centres.mean(axis=1), np.array(steps)


def _double_if_narrow(planes: list[Array], samples: int, window: float) -> tuple[list[Array], int]:
    """Return images and their samples per pixel, with doubled sampling if the window (pixels) is narrow."""
    if window >= _NARROW:
        return planes, samples
    at = np.arange(-_INTERPOLATION, _INTERPOLATION) + 0.5
    weights = np.sinc(at) * np.cos(0.5 * np.pi * at / _INTERPOLATION) ** 2
    weights /= weights.sum()
    doubled = []
    for plane in planes:
        image = np.asarray(plane, float)
        for axis in (0, 1):
            # Element i of the correlation is the value half a sample after sample i.
            between = scipy.ndimage.correlate1d(image, weights, axis, mode="nearest", origin=-1)
            image = np.stack([image, between], axis=axis + 1).reshape(
                [n * (1 + (a == axis)) for a, n in enumerate(image.shape)]
            )
        # Remove the last half sample, so that the middle of the image remains a sample.
        doubled.append(image[:-1, :-1])
    return doubled, 2 * samples


def _by_phase(plane: Array, samples: int) -> tuple[Float, Float, Float]:
    """Return the values of pixels [p, n, n] for p positions of a source within a pixel, and their x and y [p, n].

    x and y are measured in pixels from the middle of the image, which has `samples` samples per pixel. p is the square
    of `samples`: the pixels lie on samples.
    """
    middle = len(plane) // 2
    reach = (middle - samples + 1) // samples
    first = np.arange(samples) - samples // 2
    index = middle + first[:, None] + samples * np.arange(-reach, reach + 1)
    along = (index - middle) / samples
    values = np.asarray(plane, float)[index[:, None, :, None], index[None, :, None, :]]
    return (
        values.reshape(-1, *values.shape[-2:]), np.tile(along, (samples, 1)), np.repeat(along, samples, axis=0),
    )  # fmt: skip


def _centres(pixels: tuple[Float, Float, Float], window: float) -> Float:
    """Return the windowed centroids (x, y) [2, p] of the pixels of `_by_phase`; (0, 0) without light in the window."""
    centres = np.zeros((2, len(pixels[0])))
    for _ in range(_ITERATIONS):
        moments = _pixel_moments(pixels, window, centres)
        zeroth, x, y = moments[:3]
        has_light = zeroth > 0.0
        safe = np.where(has_light, zeroth, 1.0)
        # Far from the light the first moments grow with the distance, and the step of SourceExtractor is used.
        a, b, c = _slopes(moments, window)
        is_near = (a > 0.0) & (c > 0.0) & (a * c > b * b)
        newton = _balance(moments, np.where(is_near, np.stack([a, b, c]), np.array([1.0, 0.0, 1.0])[:, None]))
        step = np.where(is_near, newton, 2.0 * np.stack([x, y]) / safe)
        centres = np.where(has_light, centres + np.clip(step, -window, window), 0.0)
        if np.abs(np.where(has_light, step, 0.0)).max() < _CONVERGED:
            break
    return centres


def _slopes(moments: Float, window: float) -> Float:
    """Return a, b and c [3, p]: first moments (x, y) fall by the matrix ((a, b), (b, c)) times a shift of the window.

    `moments` is a result of `_pixel_moments`, and `window` the rms in pixels.
    """
    zeroth, _, _, xx, xy, yy = moments
    return np.stack([zeroth - xx / window**2, -xy / window**2, zeroth - yy / window**2])


def _balance(moments: Float, slopes: Float) -> Float:
    """Return the shift (x, y) of a window, in pixels, after which the light in it is balanced, to first order."""
    (a, b, c), (_, x, y, *_) = slopes, moments
    return np.asarray(np.stack([c * x - b * y, a * y - b * x]) / (a * c - b * b))


def _sample_planes(psf: Psf) -> tuple[list[Array], int]:
    """Return the middle parts (64 pixels wide) of the PSF's basis images, and their number of samples per pixel.

    The PSF of a source is a weighted sum of basis images. If the PSF is an analytic profile instead, an image of it is
    drawn and is the only one in the list.
    """
    if psf.planes is not None:
        samples = psf.planes.samples
        return [_middle(plane, _HALF * samples) for plane in (*psf.planes.images, *psf.planes.drift)], samples
    side, scale = 2 * _HALF * SAMPLES + 1, psf.pixel_scale / SAMPLES
    drawn = psf.profile.drawImage(nx=side, ny=side, scale=scale, method="no_pixel", dtype=float)
    return [drawn.array], SAMPLES


def _middle(plane: Array, reach: int) -> Array:
    middle = len(plane) // 2
    reach = min(reach, middle)
    return plane[middle - reach : middle + reach + 1, middle - reach : middle + reach + 1]


def _average_over_pixels(plane: Array, samples: int) -> Float:
    return _average_over_pixel(_average_over_pixel(plane, samples, 0), samples, 1)


def _average_over_pixel(plane: Array, samples: int, axis: int) -> Float:
    """Average an image along one axis over a width of one pixel, centred on each sample.

    `samples` is the number of samples per pixel. If it is even, samples + 1 samples are averaged, and the two outermost
    have half the weight of the others. Second differences are added, so that the variance of the weights is that of a
    pixel, 1/12.
    """
    weights = np.full(samples + 1 - samples % 2, 1.0 / samples)
    weights[[0, -1]] *= 1.0 if samples % 2 else 0.5
    at = (np.arange(len(weights)) - len(weights) // 2) / samples
    part = 0.5 * samples**2 * (1.0 / 12.0 - float((weights * at**2).sum()))
    padded = np.pad(weights, 2)
    weights = part * padded[:-2] + (1.0 - 2.0 * part) * padded[1:-1] + part * padded[2:]
    return np.asarray(scipy.ndimage.correlate1d(np.asarray(plane, float), weights, axis))


def _colour_count(psf: Psf) -> int:
    return 1 if psf.planes is None else len(psf.planes.images)


def _half_light_diameter(plane: Array, samples: int) -> float:
    """Return the diameter, in pixels, of the circle about the middle of an image that contains half of its light.

    `samples` is the number of samples per pixel. With five samples per pixel the error is 0.5 %, with three 1.4 %. A
    sample that the circle crosses is counted with the fraction of its width, along the radius, that lies inside.
    """
    axis = (np.arange(len(plane)) - len(plane) // 2) / samples
    radius, light = np.hypot(axis, axis[:, None]).ravel(), np.asarray(plane, float).ravel()
    order = np.argsort(radius, kind="stable")
    grown = np.cumsum(light[order])
    half, half_radius = 0.5 * grown[-1], float(radius[order][np.searchsorted(grown, 0.5 * grown[-1])])
    # The radius of the circle (pixels) lies between `low` and `high`, and is found by bisection. Only samples near
    # these radii must be tested in each step, because all others are certainly inside or outside the circle.
    low, high = max(half_radius - 1.0 / samples, 0.0), half_radius + 1.0 / samples
    edge = (radius > low - 1.0 / samples) & (radius < high + 1.0 / samples)
    inside, radius, light = float(light[radius <= low - 1.0 / samples].sum()), radius[edge], light[edge]
    for _ in range(40):
        middle = 0.5 * (low + high)
        enclosed = inside + float((light * np.clip((middle - radius) * samples + 0.5, 0.0, 1.0)).sum())
        low, high = (middle, high) if enclosed < half else (low, middle)
    return low + high


def _pixel_moments(pixels: tuple[Float, Float, Float], window: float, centres: Float) -> Float:
    """Return sums over pixels of light times window times 1, x, y, x^2, x y and y^2: [6, p] for p sets of pixels.

    `pixels` is a result of `_by_phase`. x and y are measured in pixels from `centres`, shape (2, p). The window is a
    Gaussian about the centre with an rms of `window` pixels.
    """
    values, *axes = pixels
    across, up = (
        np.exp(-0.5 * (at / window) ** 2)[:, None] * at[:, None] ** np.arange(3)[:, None]
        for at in (axis - centre[:, None] for axis, centre in zip(axes, centres, strict=True))
    )
    # m[i, j] is the sum of light times window times y^i x^j.
    m = np.einsum("pki,ipj->kjp", up, np.einsum("pil,pjl->ipj", values, across))
    return np.stack([m[0, 0], m[0, 1], m[1, 0], m[0, 2], m[1, 1], m[2, 0]])
