"""Accurate reference images of single sources, drawn with galsim at its tightest parameters.

They take long to draw, and are therefore stored in the disc cache.
"""

from __future__ import annotations

from dataclasses import fields

import galsim
import numpy as np

from lake_schema.arrays import Float
from truesky.numerics import cache
from truesky.render.drawing import reference
from truesky.render.psf import model
from truesky.render.sources import galaxy_shapes
from truesky.render.sources.source_list import Sources

# Value of galsim's parameters folding_threshold (light that may be aliased because an image is periodic) and
# maxk_threshold (amplitude at the largest frequency, relative to frequency 0).
ACCURACY = 1e-4


def reference_image(
    source: Sources, psf: model.Psf, side: int, maxk_threshold: float = ACCURACY, folding_threshold: float = ACCURACY
) -> Float | None:
    """Draw a single source with galsim, or return the image from the cache.

    Parameters
    ----------
    source : Sources
        List of one source, a star or a galaxy.
    psf : Psf
        PSF of this source, the same at all positions and wavelengths.
    side : int
        Width and height of the image in pixels.
    maxk_threshold, folding_threshold : float, optional
        Parameters of galsim for the accuracy: amplitude at the largest frequency, and light that may be aliased.

    Returns
    -------
    float array, shape (side, side), or None
        Expected electrons per pixel; None if galsim fails or has not enough memory.
    """
    # The index `source.shape` is -1 for a star, which has no entry in `source.shapes`.
    shapes = source.shapes.take(source.shape[source.shape >= 0])
    source_values = [
        source.column,
        source.row,
        source.jacobian,
        source.electrons,
        *(getattr(shapes, field.name) for field in fields(shapes)),
    ]
    psf_values = [repr(psf.profile)] if psf.planes is None else ["Lanczos 31", psf.planes.images]
    key = cache.content_key(
        galsim.__version__,
        maxk_threshold,
        folding_threshold,
        side,
        psf.pixel_scale,
        psf.intra_pixel,
        *source_values,
        *psf_values,
    )

    def make() -> dict[str, Float]:
        try:
            return {"image": reference.draw_reference(source, 0, psf, side, folding_threshold, maxk_threshold)}
        except (MemoryError, RuntimeError):
            return {"image": np.zeros((0, 0))}

    cached_image = cache.cached_arrays("reference", key, make)["image"]
    return cached_image if cached_image.size else None


def image_by_series(source: Sources, psf: model.Psf, side: int) -> Float:
    """Draw a single source with the Fourier series of its sampled PSF, which is exact for stars.

    The transform of the PSF is multiplied by the transforms of the galaxy (from galsim) and of a square pixel. The
    product is shifted to the position of the source and transformed back.

    Parameters
    ----------
    source : Sources
        List of one source, a star or a galaxy.
    psf : Psf
        PSF of this source as an image (`psf.planes`), the same at all positions and wavelengths.
    side : int
        Width and height of the image in pixels.

    Returns
    -------
    float array, shape (side, side)
        Expected electrons per pixel.

    Notes
    -----
    `reference_image` uses galsim also for the PSF, which it interpolates between samples by a Lanczos kernel of 31
    samples. Ten pixels from a star this leaves an error of 6e-7 of its flux, which is 1 sigma of the noise for a star
    of 15 mag, and changes its R2 by 4e-5. The image here is periodic, so a galaxy that is not small compared with it is
    aliased; `reference_image` is better for such galaxies.
    """
    assert psf.planes is not None
    plane, samples = psf.planes.images[0].astype(float), psf.planes.samples
    wide = samples * 2 * -(-(len(plane) + samples * side) // (2 * samples))
    padded = np.zeros((wide, wide))
    padded[: len(plane), : len(plane)] = plane
    middle, frequency = len(plane) // 2, np.fft.fftfreq(wide)
    out = np.fft.fft2(padded)
    for axis, position in ((1, source.column[0]), (0, source.row[0])):
        moved = np.exp(-2j * np.pi * frequency * (samples * position - middle)) * np.sinc(samples * frequency)
        out *= np.expand_dims(moved, 1 - axis)
    if source.shape[0] >= 0:
        body = galsim.JacobianWCS(*source.jacobian[0].ravel()).toImage(
            galaxy_shapes.profile(source.shapes, int(source.shape[0]), 1e-6)
        )
        tight = body.withGSParams(folding_threshold=ACCURACY, maxk_threshold=1e-6, kvalue_accuracy=1e-8)
        drawn = tight.drawKImage(nx=wide, ny=wide, scale=2 * np.pi * samples / wide).array
        out *= np.fft.ifftshift(drawn) / tight.flux
    image = np.fft.ifft2(out).real[::samples, ::samples][:side, :side]
    return np.asarray(source.electrons[0] * samples**2 * image)
