"""Fourier transforms of sources that are pictures: arcs of strong lenses and the structure of discs.

Between its pixels, a picture is interpolated by the quintic interpolant. Its transform is the transform of the pixels
multiplied by that of the interpolant.

References
----------
Bernstein & Gruen 2014, PASP 126, 287 (the interpolant).
"""

from __future__ import annotations

import numpy as np
import scipy.fft

from lake_schema.arrays import Array, Float
from truesky.numerics import matrices
from truesky.render.drawing.kernels import fourier
from truesky.render.drawing.transfer import Grid, Transfer
from truesky.render.sources.lensed_arcs import Picture

# The picture is padded to twice its side. Between the frequencies of the padded picture, the transform is interpolated
# from _WIDTH samples per direction with the window exp(_SLOPE (sqrt(1 - z^2) - 1)). The error is 1e-7 of the flux.
# Barnett, Magland & af Klinteberg 2019, SIAM J. Sci. Comput. 41, C479.
_WIDTH = 8
_SLOPE = 2.30 * _WIDTH
# Smallest q for q / sinh q, which is 1 there.
_THIN = 1e-9
# Nodes of the integral for the window's transform.
_NODES = 64


def quintic(frequency: Array) -> Array:
    """Transform of the quintic interpolant at a frequency in radian / pixel.

    References
    ----------
    Bernstein & Gruen 2014, appendix.
    """
    half = 0.5 * frequency
    s, c = np.sinc(half / np.pi), np.cos(half)
    return np.asarray(s**5 * (s * (55.0 - 19.0 * half**2) + 2.0 * c * (half**2 - 27.0)))


def transform(picture: Picture, jacobian: Float, kx: Array, ky: Array) -> Array:
    """Fourier transform of a picture about its middle, at frequencies of the detector.

    Parameters
    ----------
    picture : Picture
        The picture.
    jacobian : float array, shape (2, 2)
        d(u, v) / d(column, row), arcsec per pixel, with u to the west.
    kx, ky : float array, shape (s,)
        Frequencies, radian per pixel of the detector.

    Returns
    -------
    complex array, shape (s,)
        The transform, with an error of 1e-6 of the flux.
    """
    on_sky = matrices.matmul(matrices.inverse(jacobian).T, np.stack([kx, ky]).astype(float))
    across, up = matrices.matmul(picture.matrix.T, on_sky)
    rows, columns = picture.image.shape
    values = np.empty(len(kx), complex)
    fourier.interpolate_spectrum(_spectrum(picture.image), across, up, _WIDTH, _SLOPE, values)
    if rows % 2 == 0 or columns % 2 == 0:
        # With an even number of pixels, the middle lies between pixels.
        values *= np.exp(-0.5j * (across * (columns % 2 == 0) + up * (rows % 2 == 0)))
    values = values * quintic(across) * quintic(up)
    if picture.thick is not None:
        # The factor q / sinh q is the same as for the smooth light of the disc.
        q = np.maximum(np.abs(matrices.matmul(picture.thick, on_sky)), _THIN)
        values = values * (2.0 * q * np.exp(-q) / -np.expm1(-2.0 * q))
    return np.asarray(values)


def apply_picture(psf_transfer: Transfer, picture: Picture, jacobian: Float) -> Transfer:
    """Convert the transfer function of a point source (one plane) to that of a picture.

    Parameters
    ----------
    psf_transfer : Transfer
        One plane of the PSF and the pixel.
    picture : Picture
        The picture.
    jacobian : float array, shape (2, 2)
        d(u, v) / d(column, row), arcsec per pixel, with u to the west.

    Returns
    -------
    Transfer
        The plane, multiplied by the transform of the picture.
    """
    grid: Grid = psf_transfer.grid
    picture_transform = transform(picture, jacobian, grid.kx, grid.ky)
    re, im = psf_transfer.planes[0].astype(float)
    product = np.stack(
        [
            re * picture_transform.real - im * picture_transform.imag,
            re * picture_transform.imag + im * picture_transform.real,
        ]
    )
    return Transfer(grid, product[None].astype(psf_transfer.planes.dtype))


def _spectrum(image: Array) -> Array:
    """Transform of the picture about its middle pixel, padded to twice its side and divided by that of the window."""
    middle = [n // 2 for n in image.shape]
    period = [2 * scipy.fft.next_fast_len(max(n, _WIDTH)) for n in image.shape]
    rows, columns = (_window_transform(np.arange(n) - n // 2, p) for n, p in zip(image.shape, period, strict=True))
    padded = np.zeros(period)
    padded[: image.shape[0], : image.shape[1]] = image / (rows[:, None] * columns)
    return np.asarray(scipy.fft.fft2(np.roll(padded, [-n for n in middle], (0, 1))))


def _window_transform(place: Array, period: int) -> Array:
    """Transform of the frequency window at the pixel `place`."""
    z, weights = matrices.gauss_legendre(_NODES)
    window = weights * np.exp(_SLOPE * (np.sqrt((1 - z) * (1 + z)) - 1.0))
    half = 0.5 * _WIDTH
    return np.asarray(matrices.matmul(half * np.cos(np.outer(2 * np.pi * place / period, half * z)), window))
