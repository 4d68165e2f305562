"""Images of sources in the light of a few wavelengths, as spline coefficients: what is spread along a trace.

The PSF at a wavelength is sum_b l_b(lambda) PSF_b, l_b the Lagrange polynomials of a few nodes.  Of a stamp of N
pixels, periodic, the image through each PSF_b,

    I_b(x, y) = 1 / N^2 sum_k profile(k) PSF_b(k) pixel(k) exp(i k r),

is wanted at any place, not at the pixels alone.  It is held by ox samples a pixel along the rows and oy across,
unfolded (all |kx| <= pi ox, |ky| <= pi oy), as coefficients of splines: I = sum_j C_j B5(ox x - j) B3(oy y - j), so
that C(k) = ox oy I(k) / (sinc(f / ox)^6 sinc(fy / oy)^4), f = k / 2 pi, and no resolution is lost to the splines.
The quintic spline lies along the trace, of slope s: f = fx + s fy.

Nodes, nodes       wavelengths of the PSFs, and the share of each at any wavelength
Planes, planes     PSF times pixel over splines, for stamps of a size
coefficients       of sources
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.fft

from jobs.render.dispersing import kernels
from jobs.render.drawing import transfer
from jobs.render.psf.model import Psf
from jobs.render.sources import sersic
from jobs.render.sources.galaxy_shapes import Forms, Shapes
from lake_schema.arrays import Array, Float, Float32

# Degrees of the splines along and across.
ALONG, ACROSS = 5, 3
# Cycles a sample: beyond, next to nothing passes the PSF, and is not divided by next to nothing.
_FARTHEST = 0.6


def nodes(first: float, last: float, count: int) -> Float:
    """float64[count] A: Chebyshev's, where the largest error of Lagrange's polynomials between is least."""
    angle = np.pi * (2 * np.arange(count)[::-1] + 1) / (2 * count)
    return np.asarray(0.5 * (first + last) + 0.5 * (last - first) * np.cos(angle))


def shares(wavelength: Float, at: Float) -> Float:
    """float64[n, b]: Lagrange's polynomials of nodes `at` [b] at wavelengths [n]; each row sums to 1."""
    out = np.ones((len(wavelength), len(at)))
    for b in range(len(at)):
        for other in range(len(at)):
            if other != b:
                out[:, b] *= (wavelength - at[other]) / (at[b] - at[other])
    return out


@dataclass(frozen=True, slots=True)
class Sampling:
    """n pixels of a stamp's side, even; samples a pixel along and across; slope of the trace, rows a column."""

    n: int
    along: int
    across: int
    slope: float = 0.0


@dataclass(frozen=True, slots=True)
class Planes:
    """PSF times pixel over splines on a stamp's Fourier grid.

    kx, ky : float32[columns], float32[rows] radian / pixel
    planes : complex64[p, rows, columns], of all planes of the PSF
    """

    sampling: Sampling
    kx: Float32
    ky: Float32
    planes: Array


def planes(psf: Psf, sampling: Sampling) -> Planes:
    """Of a PSF with planes, whose wavelengths are the nodes."""
    assert psf.planes is not None
    n, columns = sampling.n, sampling.n * sampling.along // 2 + 1
    iy = scipy.fft.fftfreq(n * sampling.across, 1.0 / (n * sampling.across)).astype(int)
    fx, fy = np.arange(columns) / n, iy / n
    on_trace = np.clip(fx + sampling.slope * fy[:, None], -_FARTHEST * sampling.along, _FARTHEST * sampling.along)
    spline = np.sinc(on_trace / sampling.along) ** (ALONG + 1) * np.sinc(fy / sampling.across)[:, None] ** (ACROSS + 1)
    # The stamp's middle is at sample n / 2 of each axis.
    sign = (-1.0) ** np.arange(columns) * ((-1.0) ** iy)[:, None]
    factor = sampling.along * sampling.across * np.sinc(fx) * np.sinc(fy)[:, None] * sign / spline
    images = [*psf.planes.images, *psf.planes.drift]
    found = np.empty((len(images), len(fy), columns), np.complex64)
    for image, out in zip(images, found, strict=True):
        spectrum = transfer.spectrum(image, psf.planes.samples * n, columns)
        out[:] = spectrum[iy] * factor
    return Planes(sampling, (2 * np.pi * fx).astype(np.float32), (2 * np.pi * fy).astype(np.float32), found)


@lru_cache(maxsize=1)
def _sersic() -> Float32:
    return sersic.table()


def coefficients(
    some: Planes, weights: Float, shapes: Shapes, form: Forms, i: int, spread: Array | None = None
) -> Float32:
    """float32[b, along, n across, n] of kernels.disperse: of one source of one electron.

    weights : [b, p] of the planes, for each node;  shapes, form, i : of galaxies, and which it is, -1 = a point
    some    : the planes;  spread : [rows, columns] the transform of what a point is spread over; None: nothing
    """
    body = i >= 0
    row, row_weights = sersic.row_of(shapes.sersic_index[i : i + 1]) if body else (np.zeros(1, int), np.zeros((1, 4)))
    fraction, bulge, disk, thick = (
        (float(shapes.bulge_fraction[i]), form.bulge[i], form.disk[i], form.thick[i])
        if body
        else (0.0, np.zeros((2, 2)), np.zeros((2, 2)), np.zeros(2))
    )
    zones = np.empty((len(weights), *some.planes.shape[1:]), np.complex64)
    kernels.zones(
        some.planes, weights.astype(np.float32), some.kx, some.ky, body, fraction, bulge, disk, thick, _sersic(),
        int(row[0]), row_weights[0], zones,
    )  # fmt: skip
    if spread is not None:
        zones *= spread
    n, along, across = some.sampling.n, some.sampling.along, some.sampling.across
    images = scipy.fft.irfft2(zones, s=(n * across, n * along), overwrite_x=True)
    return np.ascontiguousarray(images.reshape(len(weights), n * across, n, along).transpose(0, 3, 1, 2))
