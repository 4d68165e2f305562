"""Write a PSF model in the file format of PSFEx.

The PSF at a position of a detector is a sum of images (planes), each multiplied by powers of the scaled position.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from lake_schema.arrays import Float32
from lake_schema.errors import BadInput
from lake_schema.fits import write as fits_file


def write(
    path: Path,
    planes: Float32,
    step: float,
    fwhm: float,
    centre: tuple[float, float],
    scale: tuple[float, float],
    light: float,
) -> None:
    """Write a PSF model to a PSFEx file, which is replaced in one rename.

    Parameters
    ----------
    path : Path
        The file.
    planes : float32 array, shape (n, s, s)
        Images whose sum, weighted by the powers 1, x, x^2 .. y, x y .., is the PSF at the scaled position (x, y). For a
        polynomial of degree d there are n = (d + 1) (d + 2) / 2 planes.
    step : float
        Distance between samples of a plane, in detector pixels.
    fwhm : float
        FWHM of a star, in detector pixels.
    centre : tuple of (float, float)
        Column and row of the detector at which x = y = 0, in pixels; the centre of the first pixel is 1.
    scale : tuple of (float, float)
        Number of columns that correspond to x = 1, and of rows that correspond to y = 1.
    light : float
        Fraction of a star's light that the PSF at x = y = 0 contains, for the header card PSFLIGHT. PSFEx has no such
        card, and programs that do not know it ignore it.

    Raises
    ------
    BadInput
        If no polynomial in two coordinates has n coefficients.
    """
    from astropy.io import fits

    degree = round((np.sqrt(8 * len(planes) + 1) - 3) / 2)
    if (degree + 1) * (degree + 2) // 2 != len(planes):
        raise BadInput(f"{path}: {len(planes)} planes do not fit a polynomial in two coordinates")
    side = planes.shape[1]
    column = fits.Column("PSF_MASK", f"{planes.size}E", dim=f"({side}, {side}, {len(planes)})", array=planes[None])
    table = fits.BinTableHDU.from_columns([column], name="PSF_DATA")
    table.header.update({"LOADED": 0, "ACCEPTED": 0, "CHI2": 0.0, "POLNAXIS": 2})
    for number, axis in enumerate("XY", start=1):
        table.header[f"POLGRP{number}"] = (1, "polynomial group of the coordinate")
        table.header[f"POLNAME{number}"] = (f"{axis}_IMAGE", "name of the coordinate")
        table.header[f"POLZERO{number}"] = (centre[number - 1], "[pix] zero of the scaled coordinate")
        table.header[f"POLSCAL{number}"] = (scale[number - 1], "[pix] unit of the scaled coordinate")
    table.header["POLNGRP"] = (1, "number of coordinate groups")
    table.header["POLDEG1"] = (degree, "degree of the polynomials")
    table.header["PSF_FWHM"] = (fwhm, "[pix] FWHM of a star")
    table.header["PSF_SAMP"] = (step, "[pix] sampling step of the PSF")
    table.header["PSFLIGHT"] = (light, "fraction of a star's light in PSF_MASK")
    table.header["PSFNAXIS"] = (3, "number of axes of PSF_MASK")
    for number, length in enumerate((side, side, len(planes)), start=1):
        table.header[f"PSFAXIS{number}"] = length
    # Swap the bytes here, because astropy treats the numbers of a table's cell one after the other in Python.
    table.data.byteswap(inplace=True)
    table.data.dtype = table.data.dtype.newbyteorder(">")
    fits_file.write_atomically(path, fits.HDUList([fits.PrimaryHDU(), table]))
