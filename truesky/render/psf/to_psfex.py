"""Write the PSF of a detector in the format of PSFEx, including pixels and for flat f_nu."""

from __future__ import annotations

from pathlib import Path

import galsim
import numpy as np
import scipy.fft

from lake_schema.arrays import Array, Float, Float32
from lake_schema.fits import psfex
from truesky.render.camera.detectors import Detector
from truesky.render.psf.model import Planes, Psf

# Half the side of a model, in FWHM, and its largest value, in samples; samples per pixel of a PSF without planes.
_HALF, _MAX_HALF, _SAMPLES = 5.0, 63, 2


def write(psf: Psf, detector: Detector, path: Path) -> None:
    """Write the model of a detector, with flux 1 within its side of 10 FWHM or at most 127 samples.

    Parameters
    ----------
    psf : Psf
        PSF of the detector.
    detector : Detector
        The detector.
    path : Path
        File to write.

    Notes
    -----
    The dependence on the source's colour is neglected. Errors of size and ellipticity are 1e-3.
    """
    planes, step = psfex_planes(psf)
    middle = ((detector.nx + 1) / 2, (detector.ny + 1) / 2)
    psfex.write(path, planes, step, psf.fwhm / psf.pixel_scale, middle, (detector.nx / 2, detector.ny / 2))


def psfex_planes(psf: Psf) -> tuple[Float32, float]:
    """Planes [n, s, s] in the order of PSFEx and their spacing in pixels, for x, y = -1 to 1 across the detector."""
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
    """Middle of a plane, 2 half + 1 samples, averaged over pixels; 0 outside the plane."""
    # The average over pixels needs one pixel beyond the border.
    margin = half + planes.samples - len(plane) // 2
    image = np.pad(plane.astype(float), max(margin, 0))
    if not has_pixel:
        n = len(image)
        along, across = (np.sinc(planes.samples * f(n)) for f in (scipy.fft.fftfreq, scipy.fft.rfftfreq))
        image = scipy.fft.irfft2(scipy.fft.rfft2(image) * along[:, None] * across, (n, n))
    middle = len(image) // 2
    return np.asarray(image[middle - half : middle + half + 1, middle - half : middle + half + 1])
