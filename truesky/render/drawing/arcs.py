"""Fourier transforms of sources that are given as pictures (images): lensed arcs, and spiral arms and knots of discs.

Between its pixels, a picture is interpolated by the quintic interpolant. The transform of the picture is therefore the
transform of the pixels multiplied by that of the interpolant.

References
----------
Bernstein & Gruen 2014, PASP 126, 287 (the interpolant).
"""

from __future__ import annotations

import numpy as np
import scipy

from lake_schema.arrays import Array, Float
from truesky.numerics import matrices
from truesky.render.drawing.kernels import fourier
from truesky.render.drawing.transfer import Grid, Transfer
from truesky.render.sources.lensed_arcs import Picture

# Number of samples per direction from which the transform of a picture is interpolated between the frequencies of the
# FFT. The picture is first padded to twice its side. The error is 1e-7 of the flux. Barnett, Magland & af Klinteberg
# 2019, SIAM J. Sci. Comput. 41, C479.
_WIDTH = 8
# Parameter of the window with which the Fourier transform of a picture is interpolated between frequencies of the FFT:
# exp(_SLOPE (sqrt(1 - z^2) - 1)), with z from -1 to 1 over _WIDTH samples.
_SLOPE = 2.30 * _WIDTH
# Smallest value of q in the factor q / sinh q, by which the thickness of an inclined disc changes its Fourier
# transform. Smaller values of q are replaced by it, to avoid 0 / 0; the factor is 1 there.
_THIN = 1e-9
# Number of Gauss-Legendre nodes for the Fourier integral of the interpolation window.
_NODES = 64


def quintic(frequency: Array) -> Array:
    """Return the Fourier transform of the quintic interpolant at frequencies in radian per pixel; 1 at 0.

    References
    ----------
    Bernstein & Gruen 2014, appendix.
    """
    half = 0.5 * frequency
    s, c = np.sinc(half / np.pi), np.cos(half)
    return np.asarray(s**5 * (s * (55.0 - 19.0 * half**2) + 2.0 * c * (half**2 - 27.0)))


def transform(picture: Picture, jacobian: Float, kx: Array, ky: Array) -> Array:
    """Return the Fourier transform of a picture about its middle, at frequencies on the detector.

    Parameters
    ----------
    picture : Picture
        The picture: an image with its position and scale on the sky.
    jacobian : float array, shape (2, 2)
        d(u, v) / d(column, row) at the source, arcsec per detector pixel, with u to the west and v to the north.
    kx, ky : float array, shape (s,)
        Frequencies along columns and rows, radian per detector pixel.

    Returns
    -------
    complex array, shape (s,)
        The transform for the flux of the picture (1, or 0 for spiral arms), with an error of 1e-6 of the flux.
    """
    on_sky = matrices.matmul(matrices.inverse(jacobian).T, np.stack([kx, ky]).astype(float))
    across, up = matrices.matmul(picture.matrix.T, on_sky)
    rows, columns = picture.image.shape
    values = np.empty(len(kx), complex)
    fourier.interpolate_spectrum(_spectrum(picture.image), across, up, _WIDTH, _SLOPE, values)
    if rows % 2 == 0 or columns % 2 == 0:
        # With an even number of pixels, the middle of the picture lies half a pixel before the pixel that the FFT uses.
        values *= np.exp(-0.5j * (across * (columns % 2 == 0) + up * (rows % 2 == 0)))
    values = values * quintic(across) * quintic(up)
    if picture.thick is not None:
        # Spiral arms and knots are as thick as their disc. Their transform is therefore multiplied by the same factor
        # q / sinh q as that of the smooth disc. q is the product of the frequency and `picture.thick`, the vector that
        # describes the thickness of the inclined disc.
        q = np.maximum(np.abs(matrices.matmul(picture.thick, on_sky)), _THIN)
        values = values * (2.0 * q * np.exp(-q) / -np.expm1(-2.0 * q))
    return np.asarray(values)


def apply_picture(psf_transfer: Transfer, picture: Picture, jacobian: Float) -> Transfer:
    """Multiply the Fourier transform of the PSF by that of a picture.

    Parameters
    ----------
    psf_transfer : Transfer
        Transform of PSF and pixel for the source, in its first plane. Further planes (basis images) are ignored.
    picture : Picture
        The picture: an image that is drawn instead of a profile.
    jacobian : float array, shape (2, 2)
        d(u, v) / d(column, row) at the source, arcsec per detector pixel, with u to the west and v to the north.

    Returns
    -------
    Transfer
        The product, as one plane on the same frequencies and with the same data type.
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
    """Return the FFT of an image about its middle pixel, prepared for interpolation between its frequencies.

    The image is padded to about twice its sides. It is divided by the transform of the interpolation window, which
    cancels the effect of the window.
    """
    middle = [n // 2 for n in image.shape]
    period = [2 * scipy.fft.next_fast_len(max(n, _WIDTH)) for n in image.shape]
    rows, columns = (_window_transform(np.arange(n) - n // 2, p) for n, p in zip(image.shape, period, strict=True))
    padded = np.zeros(period)
    padded[: image.shape[0], : image.shape[1]] = image / (rows[:, None] * columns)
    return np.asarray(scipy.fft.fft2(np.roll(padded, [-n for n in middle], (0, 1))))


def _window_transform(place: Array, period: int) -> Array:
    """Return the Fourier transform of the window that interpolates between frequencies, at pixels of an image.

    `place` [n] are the positions of the pixels from the middle of the image, along one axis. `period` is the number of
    pixels of the padded image along this axis.
    """
    z, weights = matrices.gauss_legendre(_NODES)
    window = weights * np.exp(_SLOPE * (np.sqrt((1 - z) * (1 + z)) - 1.0))
    half = 0.5 * _WIDTH
    return np.asarray(matrices.matmul(half * np.cos(np.outer(2 * np.pi * place / period, half * z)), window))
