"""Write the PSF of a detector in the format of PSFEx, averaged over pixels and for a source with constant f_nu."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import scipy

from lake_schema.arrays import Array, Float, Float32
from lake_schema.fits import psfex
from truesky.render.camera.detectors import Detector
from truesky.render.psf.model import Planes, Psf

# Distance from the middle to the edge of the written PSF images, in units of the FWHM of the PSF.
_HALF = 5.0
# Largest distance from the middle to the edge of the written PSF images, samples. It limits their side to 127 samples.
_MAX_HALF = 63
# Number of samples per detector pixel in the written image of a PSF that is given as an analytic profile. Other PSFs
# keep the samples of their images.
_SAMPLES = 2


def write(psf: Psf, detector: Detector, path: Path) -> None:
    """Write the PSF of a detector to a file of PSFEx.

    Its images have a side of 10 FWHM, but at most 127 samples. The sum of the image at the centre of the detector is 1.

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
    planes, step = psfex_planes(psf)
    middle = ((detector.nx + 1) / 2, (detector.ny + 1) / 2)
    psfex.write(path, planes, step, psf.fwhm / psf.pixel_scale, middle, (detector.nx / 2, detector.ny / 2))


def psfex_planes(psf: Psf) -> tuple[Float32, float]:
    """Return the images [n, s, s] of a PSFEx model, and the spacing of their samples in pixels.

    The model is a polynomial of the position on the detector, with x and y from -1 to 1 between its edges. There is one
    image per term, by which the term is multiplied, in the order of PSFEx: 1, x, x^2 ..., y, x y .... The sum of the
    first image is 1. n is 1 for a PSF that is the same on the whole detector.
    """
    import galsim

    samples = psf.planes.samples if psf.planes else _SAMPLES
    half = min(int(np.ceil(_HALF * psf.fwhm / psf.pixel_scale * samples)), _MAX_HALF)
    if psf.planes is None:
        with_pixel = galsim.Convolve(psf.profile, galsim.Pixel(psf.pixel_scale))
        side, scale = 2 * half + 1, psf.pixel_scale / samples
        image = with_pixel.drawImage(nx=side, ny=side, scale=scale, method="no_pixel", dtype=float).array
        return (image / image.sum()).astype(np.float32)[None], 1.0 / samples
    has_pixel = psf.intra_pixel is None
    terms = {(0, 0): psf.planes.images.mean(axis=0, dtype=float)}
    terms |= {
        (i, j): drift for (i, j, colour), drift in zip(psf.planes.powers, psf.planes.drift, strict=True) if not colour
    }
    degree = max(i + j for i, j in terms)
    planes = []
    for power in ((i, j) for j in range(degree + 1) for i in range(degree + 1 - j)):
        plane = terms.get(power)
        planes.append(
            np.zeros((2 * half + 1,) * 2) if plane is None else _central_plane(plane, psf.planes, half, has_pixel)
        )
    return (np.stack(planes) / planes[0].sum()).astype(np.float32), 1.0 / samples


def _central_plane(plane: Array, planes: Planes, half: int, has_pixel: bool) -> Float:
    """Return the middle of a PSF image, with sides of 2 * half + 1 samples, averaged over detector pixels.

    If `has_pixel` is True, `plane` is already averaged and is not averaged again. `planes` gives the number of samples
    per pixel. Outside `plane`, the PSF is treated as 0.
    """
    # The average over a pixel is computed by FFT, for which the image is periodic. The image needs at least one pixel
    # more at the border than the result, so that light from the opposite border does not contribute.
    margin = half + planes.samples - len(plane) // 2
    image = np.pad(plane.astype(float), max(margin, 0))
    if not has_pixel:
        n = len(image)
        along, across = (np.sinc(planes.samples * f(n)) for f in (scipy.fft.fftfreq, scipy.fft.rfftfreq))
        image = scipy.fft.irfft2(scipy.fft.rfft2(image) * along[:, None] * across, (n, n))
    middle = len(image) // 2
    return np.asarray(image[middle - half : middle + half + 1, middle - half : middle + half + 1])
