"""Write the PSF of a detector in the format of PSFEx, averaged over pixels and for a source with constant f_nu."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import scipy

from lake_schema.arrays import Array, Float, Float32
from lake_schema.fits import psfex
from truesky.render.camera.detectors import Detector
from truesky.render.psf import pixel_response
from truesky.render.psf.model import Planes, Psf

# Distance from the middle to the edge of the written PSF images, in units of the FWHM of the PSF.
_HALF = 5.0
# Largest distance from the middle to the edge of the written PSF images, samples. It limits their side to 127 samples.
_MAX_HALF = 63
# Number of samples per detector pixel in the written image of a PSF that is given as an analytic profile. Other PSFs
# keep the samples of their images, or some of them (see _DENSE).
_SAMPLES = 2
# PSF images with at least this number of samples per detector pixel, which come from files, are written with fewer:
# only every n-th sample is kept, so that three or more samples per pixel remain.
_DENSE = 6


def write(psf: Psf, detector: Detector, path: Path) -> None:
    """Write the PSF of a detector to a file of PSFEx.

    Its images have a side of 10 FWHM, but at most 127 samples. The sum of the image at the centre of the detector is 1.
    The header card PSFLIGHT is the fraction of a star's light that this image contains, 0.94 to 0.98.

    Parameters
    ----------
    psf : Psf
        PSF of the detector.
    detector : Detector
        The detector.
    path : Path
        File to write; an existing file is replaced.

    Notes
    -----
    The dependence of the PSF on the colour of the source is neglected. Errors of size and ellipticity are 1e-3.
    """
    planes, step, light = psfex_planes(psf)
    middle = ((detector.nx + 1) / 2, (detector.ny + 1) / 2)
    psfex.write(path, planes, step, psf.fwhm / psf.pixel_scale, middle, (detector.nx / 2, detector.ny / 2), light)


def psfex_planes(psf: Psf) -> tuple[Float32, float, float]:
    """Return the images of a PSFEx model, the spacing of their samples, and the fraction of light that they contain.

    The model is a polynomial of the position on the detector, with x and y from -1 to 1 between its edges.

    Parameters
    ----------
    psf : Psf
        PSF of the detector.

    Returns
    -------
    planes : float32 array, shape (n, s, s)
        Images by which the terms of the polynomial are multiplied, in the order of PSFEx: 1, x, x^2 ..., y, x y ....
        The sum of the first image is 1. n is 1 for a PSF that is the same on the whole detector.
    step : float
        Spacing of the samples, pixels.
    light : float
        Fraction of the light of a star, with constant f_nu and at the centre of the detector, inside the first image.
    """
    import galsim

    if psf.planes is None:
        half = _half(psf, _SAMPLES)
        with_pixel = galsim.Convolve(psf.profile, galsim.Pixel(psf.pixel_scale))
        side, scale = 2 * half + 1, psf.pixel_scale / _SAMPLES
        image = with_pixel.drawImage(nx=side, ny=side, scale=scale, method="no_pixel", dtype=float).array
        return (image / image.sum()).astype(np.float32)[None], 1.0 / _SAMPLES, float(image.sum())
    stride = max(psf.planes.samples // (_DENSE // 2), 1) if psf.planes.samples >= _DENSE else 1
    step = stride / psf.planes.samples
    half = stride * _half(psf, 1.0 / step)
    inner = _central_part(psf.planes.images, 2 * half + psf.planes.samples)
    terms = {(0, 0): inner.mean(axis=0, dtype=float)}
    terms |= {
        (i, j): drift for (i, j, colour), drift in zip(psf.planes.powers, psf.planes.drift, strict=True) if not colour
    }
    degree = max(i + j for i, j in terms)
    planes = []
    for power in ((i, j) for j in range(degree + 1) for i in range(degree + 1 - j)):
        plane = terms.get(power)
        full = (
            np.zeros((2 * half + 1,) * 2) if plane is None else _central_plane(plane, psf.planes, half, psf.intra_pixel)
        )
        planes.append(full[::stride, ::stride])
    total = float(planes[0].sum())
    return (np.stack(planes) / total).astype(np.float32), step, total * stride**2


def _half(psf: Psf, samples: float) -> int:
    """Return the distance from the middle to the edge of the written images, with `samples` samples per pixel."""
    return min(int(np.ceil(_HALF * psf.fwhm / psf.pixel_scale * samples)), _MAX_HALF)


def _central_plane(plane: Array, planes: Planes, half: int, strength: float | None) -> Float:
    """Return the middle of a PSF image, with sides of 2 * half + 1 samples, averaged over detector pixels.

    `planes` gives the number of samples per pixel, and `strength` the loss of response at a pixel's edges relative to
    its centre. If it is None, `plane` is already averaged and is not averaged again. Outside `plane`, the PSF is
    treated as 0.
    """
    # The average over a pixel is computed by FFT, for which the image is periodic. The image needs at least one pixel
    # more at the border than the result, so that light from the opposite border does not contribute. It is cut to twice
    # the size of the result, because the rest does not matter.
    plane = _central_part(plane, 2 * half + planes.samples)
    margin = half + planes.samples - len(plane) // 2
    image = np.pad(plane.astype(float), max(margin, 0))
    if strength is not None:
        n = len(image)
        along, across = (planes.samples * f(n) for f in (scipy.fft.fftfreq, scipy.fft.rfftfreq))
        pixel = pixel_response.transform(across, along[:, None], strength)
        image = scipy.fft.irfft2(scipy.fft.rfft2(image) * pixel, (n, n))
    return _central_part(image, half)


def _central_part(images: Array, half: int) -> Array:
    """Return the samples of square images at most `half` samples from the middle, along columns and rows."""
    margin = max(images.shape[-1] // 2 - half, 0)
    inner = slice(margin, images.shape[-1] - margin)
    return images[..., inner, inner]
