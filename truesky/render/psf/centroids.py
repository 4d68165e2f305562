"""Where the light of a point lies by its centroid, beside the place that the PSF is held about.

Coma puts the light of VIS up to 12 mas from the chief ray, more or less with colour and place. What is told is the
windowed centroid, which positions are measured by: that about which the light in a Gaussian window is even.

offsets    a point's centroid minus its place

Ref : Bertin & Arnouts 1996, and the manual of SourceExtractor (XWIN_IMAGE: window of the half-light diameter)
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import correlate1d

from lake_schema.arrays import Array, Float
from truesky.numerics import matrices
from truesky.render.psf.model import SAMPLES, Psf

# Of a Gaussian's rms, its FWHM, which is also its half-light diameter.
_FWHM = 2.0 * np.sqrt(2.0 * np.log(2.0))
# Half the side of what is looked at of a plane, pixels: all of the windows, and the light whose half is taken.
_HALF = 32


def offsets(psf: Psf, weights: Float) -> tuple[Float, Float]:
    """Along columns and rows [n], pixels, of points whose light is this mixture of the PSF's planes.

    weights : [n, planes], of drawing.transfer.basis_weights;  psf : of the detector
    Error   : 3 % of the offset where it is a sixth of the window's rms (one step towards the even place); VIS, 0.5 mas,
              as a tenth more of a window moves the centroid by 1.2 mas
    """
    planes, samples = _sample_planes(psf)
    # With the pixel, which all that is measured has in it; apertures take its light as even in it.
    inside = 0 if psf.intra_pixel is None else 1
    image = np.sum(planes[: _colour_count(psf)], axis=0)
    for _ in range(1 + inside):
        image = _average_over_pixel(_average_over_pixel(image, samples, 0), samples, 1)
    window = _half_light_diameter(image, samples) / _FWHM
    moments = np.stack([_moments(plane, samples, window, inside) for plane in planes])
    zeroth, x, y, xx, xy, yy = matrices.matmul(weights, moments).T
    # How fast the window's first moments fall where it is moved.
    a, b, c = zeroth - xx / window**2, -xy / window**2, zeroth - yy / window**2
    scale = a * c - b * b
    return np.asarray((c * x - b * y) / scale), np.asarray((a * y - b * x) / scale)


def _sample_planes(psf: Psf) -> tuple[list[Array], int]:
    """The middle of the planes, and samples a pixel."""
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
    """Over a pixel about each sample; of an even number of samples the outermost count half."""
    weights = np.full(samples + 1 - samples % 2, 1.0 / samples)
    weights[[0, -1]] *= 1.0 if samples % 2 else 0.5
    return np.asarray(correlate1d(np.asarray(plane, float), weights, axis))


def _colour_count(psf: Psf) -> int:
    return 1 if psf.planes is None else len(psf.planes.images)


def _half_light_diameter(plane: Array, samples: int) -> float:
    """Pixels, of the light of a plane.

    Error : 0.5 % with five samples a pixel, 1.4 % with three: one at the edge counts as far as it is inside, along the
            radius
    """
    axis = (np.arange(len(plane)) - len(plane) // 2) / samples
    radius, light = np.hypot(axis, axis[:, None]).ravel(), np.asarray(plane, float).ravel()
    order = np.argsort(radius, kind="stable")
    grown = np.cumsum(light[order])
    half, half_radius = 0.5 * grown[-1], float(radius[order][np.searchsorted(grown, 0.5 * grown[-1])])
    # What is farther from the edge is inside or outside, however far the edge is moved.
    low, high = max(half_radius - 1.0 / samples, 0.0), half_radius + 1.0 / samples
    edge = (radius > low - 1.0 / samples) & (radius < high + 1.0 / samples)
    inside, radius, light = float(light[radius <= low - 1.0 / samples].sum()), radius[edge], light[edge]
    for _ in range(40):
        middle = 0.5 * (low + high)
        enclosed = inside + float((light * np.clip((middle - radius) * samples + 0.5, 0.0, 1.0)).sum())
        low, high = (middle, high) if enclosed < half else (low, middle)
    return low + high


def _moments(plane: Array, samples: int, window: float, inside: int) -> Float:
    """In a Gaussian window about the middle: 0th, along x and y, along xx, xy and yy; pixels.

    inside : 1 where the plane is averaged over pixels first. The average is even, so that the window may be averaged
             instead, which is a product of one axis' and the other's.
    """
    axis = (np.arange(len(plane)) - len(plane) // 2) / samples
    powers = np.exp(-0.5 * (axis / window) ** 2) * axis ** np.arange(3)[:, None]
    if inside:
        powers = _average_over_pixel(powers, samples, 1)
    # [3, 3] along y, along x.
    along_x = (np.asarray(plane, float) * powers[:, None]).sum(axis=2)
    m = (powers[:, None] * along_x).sum(axis=2)
    return np.array([m[0, 0], m[0, 1], m[1, 0], m[0, 2], m[1, 1], m[2, 0]])
