"""Draw a source with galsim's drawImage, as a reference to which the result of `stamps.draw` is compared."""

from __future__ import annotations

import galsim
import numpy as np

from lake_schema.arrays import Float, Float32
from truesky.render.drawing import transfer
from truesky.render.psf.model import Psf
from truesky.render.sources import galaxy_shapes
from truesky.render.sources.lensed_arcs import Picture
from truesky.render.sources.source_list import Sources

# A bulge or disc with a half-light radius below this is drawn as a point source, arcsec.
_POINT = 1e-6


def draw_reference(
    sources: Sources, i: int, psf: Psf, size: int, folding: float = 1e-4, highest: float = 1e-4
) -> Float:
    """Draw one source with galsim.Convolve and drawImage with tight thresholds, independently of `stamps.draw`.

    Parameters
    ----------
    sources : Sources
        Sources at rest; a displacement during the exposure is ignored.
    i : int
        Index of the source in `sources`, from 0.
    psf : Psf
        PSF of the detector.
    size : int
        Side of the image, pixels.
    folding : float
        galsim's folding_threshold: fraction of the flux that may be aliased.
    highest : float
        galsim's maxk_threshold: the transform is cut where it falls below this fraction of the flux. A value of 1e-4
        changes the middle of bright discs by 3e-3 of the noise.

    Returns
    -------
    float array, shape (size, size)
        Expected electrons. The first pixel is at column and row round(position) - size // 2 of the detector.
    """
    settings = galsim.GSParams(
        folding_threshold=folding, maxk_threshold=highest, kvalue_accuracy=1e-7, maximum_fft_size=16384
    )
    weights = transfer.basis_weights(psf, sources.photons, sources.column, sources.row)[i]
    pixel = [] if psf.intra_pixel is None else [galsim.Pixel(1.0)]
    parts = [transfer.profile_of(psf, weights).dilate(1.0 / psf.pixel_scale), *pixel]
    picture = sources.picture_of(i)
    if sources.shape[i] >= 0 or picture is not None:
        profile = _profile(sources, i)
        # Convert the profile from sky coordinates in arcsec to pixels. The flux does not change.
        parts.append(galsim.JacobianWCS(*sources.jacobian[i].ravel()).toImage(profile))
    convolved = galsim.Convolve(parts, gsparams=settings) * float(sources.electrons[i])
    x0, y0 = (int(np.rint(position[i])) - size // 2 for position in (sources.column, sources.row))
    centre = galsim.PositionD(sources.column[i] - x0, sources.row[i] - y0)
    image = galsim.ImageD(galsim.BoundsI(0, size - 1, 0, size - 1), scale=1.0)
    convolved.drawImage(image, center=centre, method="no_pixel")
    return np.asarray(image.array)


def _profile(sources: Sources, i: int) -> galsim.GSObject:
    """Return the galsim profile of a galaxy or picture with flux 1, in sky coordinates in arcsec.

    The spiral arms and knots of a disc are treated as thin.
    """
    picture = sources.picture_of(i)
    if sources.shape[i] < 0 and picture is not None:
        return _galsim_image(picture, picture.image)
    shape, galaxy = sources.shapes, int(sources.shape[i])
    smooth = galaxy_shapes.profile(shape, galaxy, _POINT)
    if picture is None:
        return smooth
    # The picture of a disc's spiral arms and knots has the total flux 0, which galsim does not allow for an image.
    # Therefore positive and negative pixels are separate images.
    positive, negative = (_galsim_image(picture, np.maximum(sign * picture.image, 0.0)) for sign in (1.0, -1.0))
    return smooth + (positive - negative) * (1.0 - float(shape.bulge_fraction[galaxy]))


def _galsim_image(picture: Picture, pixels: Float32) -> galsim.GSObject:
    """Convert `pixels`, an image on the grid of `picture`, to a galsim object in arcsec to the west and north.

    The flux is the sum of the pixels.
    """
    image = galsim.Image(np.ascontiguousarray(pixels, float), scale=1.0)
    # With more padding than galsim's default, the Fourier transform of the image is accurate enough for a reference.
    plain = galsim.InterpolatedImage(image, x_interpolant="quintic", pad_factor=8.0)
    return plain.transform(*picture.matrix.ravel()).withFlux(float(pixels.sum(dtype=float)))
