"""Offset between the measured centroid of a point source and the position at which its PSF is drawn.

The PSF of Euclid's camera VIS is drawn so that the chief ray (through the centre of the pupil) lies at the position of
the source. Coma moves the light by up to 12 mas from there, depending on the colour and the position of the source.
The centroid is the windowed one that programs for astrometry measure: the position about which the light in a Gaussian
window, centred on the same position, is balanced.

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
# The centroid is measured on the middle part of a PSF image, within this number of pixels along x and y. This part
# contains the Gaussian window of the centroid. Only its light counts for the half-light diameter.
_HALF = 32


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
        Measured minus drawn position, along x (columns) and y (rows), pixels.

    Notes
    -----
    The windowed centroid is defined by an iteration, of which a single step is used. The error is 3 % of the offset if
    the offset is a sixth of the window's rms. For VIS it is 0.5 mas. For comparison, a window that is wider by 10 %
    changes the measured position by 1.2 mas.
    """
    window, moments = psf.keep(("centroids",), lambda: _windowed_moments(psf))
    zeroth, x, y, xx, xy, yy = matrices.matmul(weights, moments).T
    # First moments (x, y) of the light in the window fall by the matrix ((a, b), (b, c)) times the shift of the window.
    # The offset is the shift for which they become 0, to first order.
    a, b, c = zeroth - xx / window**2, -xy / window**2, zeroth - yy / window**2
    scale = a * c - b * b
    return np.asarray((c * x - b * y) / scale), np.asarray((a * y - b * x) / scale)


def _windowed_moments(psf: Psf) -> tuple[float, Float]:
    """Return the rms of the centroid's window in pixels, and the moments [planes, 6] of all basis images in it."""
    planes, samples = _sample_planes(psf)
    # The FWHM of the window is the half-light diameter that aperture photometry measures. The detector averages the
    # image over pixels once (unless the PSF already includes the pixel). The image is averaged once more, because
    # aperture photometry treats the light as uniform within a pixel.
    inside = 0 if psf.intra_pixel is None else 1
    image = np.sum(planes[: _colour_count(psf)], axis=0)
    for _ in range(1 + inside):
        image = _average_over_pixel(_average_over_pixel(image, samples, 0), samples, 1)
    window = _half_light_diameter(image, samples) / _FWHM
    return window, np.stack([_moments(plane, samples, window, inside) for plane in planes])


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


def _average_over_pixel(plane: Array, samples: int, axis: int) -> Float:
    """Average an image along one axis over a width of one pixel, centred on each sample.

    `samples` is the number of samples per pixel. If it is even, samples + 1 samples are averaged, and the two outermost
    have half the weight of the others.
    """
    weights = np.full(samples + 1 - samples % 2, 1.0 / samples)
    weights[[0, -1]] *= 1.0 if samples % 2 else 0.5
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


def _moments(plane: Array, samples: int, window: float, inside: int) -> Float:
    """Return the sums over an image of light times window times 1, x, y, x^2, x y and y^2 (six numbers).

    x and y are measured in pixels from the middle of the image, with `samples` samples per pixel. The window is a
    Gaussian about the middle with an rms of `window` pixels. If `inside` is 1, the image is first averaged over
    pixels. Because this average is symmetric, it is applied to the window times powers instead, which is faster.
    """
    axis = (np.arange(len(plane)) - len(plane) // 2) / samples
    powers = np.exp(-0.5 * (axis / window) ** 2) * axis ** np.arange(3)[:, None]
    if inside:
        powers = _average_over_pixel(powers, samples, 1)
    # m[i, j] is the sum of light times window times y^i x^j.
    along_x = (np.asarray(plane, float) * powers[:, None]).sum(axis=2)
    m = (powers[:, None] * along_x).sum(axis=2)
    return np.array([m[0, 0], m[0, 1], m[1, 0], m[0, 2], m[1, 1], m[2, 0]])
