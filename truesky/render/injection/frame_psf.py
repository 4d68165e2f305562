"""PSFs of frames of other telescopes: a file of PSFEx, a FITS image of the PSF, or a Gaussian."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from lake_schema import arguments
from lake_schema.errors import BadInput
from lake_schema.fits import external
from truesky.render.camera.detectors import Detector
from truesky.render.drawing import transfer
from truesky.render.psf import from_file, model
from truesky.render.psf.model import Psf

if TYPE_CHECKING:
    # Imported in the functions that use it, because its import takes a second.
    from astropy.wcs import WCS

# Largest FWHM of a Gaussian PSF, pixels.
_WIDEST = 100.0
# Largest distance of the middle of the stars in a PSFEx file from the middle of the frame, relative to its side.
_MAX_OFF_CENTRE = 0.3
# Smallest and largest range of the positions in a PSFEx file, relative to the side of the frame. The largest range is
# that of a file whose polynomials are of positions from -1 to 1.
_RANGES = (0.2, 1.1)


def load_psf(psf: Path | float, nx: int, ny: int, pixel_scale: float, system: WCS) -> Psf:
    """Return the PSF of a frame.

    Parameters
    ----------
    psf : Path or float
        File of PSFEx, FITS file with one image of the PSF, or the FWHM in arcsec of a Gaussian. The Gaussian is the
        image of a star, which includes the average over a pixel.
    nx, ny : int
        Number of columns and rows of the frame.
    pixel_scale : float
        Arcsec per pixel.
    system : astropy.wcs.WCS
        World coordinate system of the frame, through which an image of the PSF on the sky is drawn.

    Returns
    -------
    Psf
        The PSF.

    Raises
    ------
    BadInput
        If the file cannot be read, has the axes of a camera, is for a frame of another size, or the PSF is narrower
        than a pixel.
    """
    if isinstance(psf, Path):
        detector = Detector("frame", "frame", nx, ny, 0.0, 0.0, 0.0, pixel_scale)
        _check_header(psf, nx, ny)
        result, place = from_file.read(psf, detector, None, system), str(psf)
        fwhm = result.fwhm
    else:
        fwhm, place = arguments.check_number("psf", psf, 1e-6, 1e6), "psf"
        if fwhm > _WIDEST * pixel_scale:
            raise BadInput(f"psf = {fwhm:g}: the FWHM is above {_WIDEST:g} pixels of {pixel_scale:.4g} arcsec")
        result = model.gaussian(max(fwhm, pixel_scale), pixel_scale)
    if fwhm < pixel_scale:
        raise BadInput(f"{place}: the FWHM of the PSF, {fwhm:.4g} arcsec, is below one pixel, {pixel_scale:.4g} arcsec")
    return result


def psf_at(psf: Psf, column: float, row: float) -> Psf:
    """Return the PSF at a position of the frame, as a PSF that does not depend on the position.

    Parameters
    ----------
    psf : Psf
        PSF of the frame.
    column, row : float
        Position, 0-based pixels.

    Returns
    -------
    Psf
        The PSF of a source at this position.
    """
    if psf.planes is None:
        return psf
    weights = transfer.basis_weights(psf, None, np.array([column]), np.array([row]))
    image = transfer.image_of(psf.planes, weights[0])
    planes = replace(psf.planes, images=image[None], drift=np.zeros((0, *image.shape), np.float32), powers=())
    return replace(psf, planes=planes)


def image_side(psf: Psf) -> int:
    """Return the number of pixels along a side of the PSF's images, 0 for an analytic PSF."""
    return 0 if psf.planes is None else int(np.ceil(psf.planes.images.shape[1] / psf.planes.samples))


def _check_header(path: Path, nx: int, ny: int) -> None:
    """Raise BadInput if the stars of a PSFEx file are on a frame of another size, or an image has axes of a camera."""
    _, header = external.read_planes(path, "PSF_MASK")
    if "POLNAXIS" not in header and header.get("PSFFRAME") == "CAMERA":
        raise BadInput(f"{path}: PSFFRAME = 'CAMERA': the focal plane of a given frame is not known, use SKY or PIXELS")
    if header.get("POLNAXIS") != 2 or not header.get("POLDEG1"):
        return
    for axis, side in ((1, nx), (2, ny)):
        zero, span = header.get(f"POLZERO{axis}"), header.get(f"POLSCAL{axis}")
        if not (isinstance(zero, int | float) and isinstance(span, int | float)):
            continue
        is_centred = abs(zero - (side + 1) / 2) <= _MAX_OFF_CENTRE * side
        if not (is_centred and _RANGES[0] * side <= abs(span) <= _RANGES[1] * side):
            stars = f"POLZERO{axis} = {zero:g} and POLSCAL{axis} = {span:g}"
            raise BadInput(f"{path}: {stars} are not those of a frame of {nx} x {ny} pixels")
