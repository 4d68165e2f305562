"""Read a PSF from a user's file: a cube of PSF images (planes), or a file written by PSFEx.

A cube is the first image of a FITS file with two axes, or with three axes and wavelengths along the third. The sum of
each plane is the fraction of the light that it contains. The header cards are:

- PSFFRAME: axes of the planes. It has no default.

  - 'PIXELS': x along the columns of the detector and y along its rows.
  - 'SKY': x to the west and y to the north, as in GalSim.
  - 'CAMERA': the x and y axes of the focal plane, on the sky. They are the axes of 'SKY' if the position angle is 0.

- CDELT1 = CDELT2 and CUNIT1: spacing of the samples, in pixels (pixel) for 'PIXELS', otherwise on the sky (arcsec, mas
  or deg).
- CRPIX1 and CRPIX2: position of the chief ray (light through the centre of the pupil), 1-based; by default the middle.
- CRVAL3, CDELT3 and CRPIX3, or WAVE1 to WAVEn: wavelengths in CUNIT3 (Angstrom, nm, um or m).
- PIXEL: T if the PSF images are already averaged over the detector's pixel; by default F.

Planes on the sky are drawn through the WCS of the detector: its rotation, and the scale and shear of its distortion at
each position. A file of PSFEx has the axes and pixels of the detector, includes the average over a pixel, and contains
polynomials of the position on the detector. Its optional card PSFLIGHT is the fraction of a star's light that
its images contain, like the sum of a plane in a cube; by default 1. truesky writes this card, PSFEx does not.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import comb
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy

from lake_schema.arrays import Float
from lake_schema.errors import BadInput
from lake_schema.fits import external
from truesky.fluxes.passbands import Passband
from truesky.numerics import matrices
from truesky.render.camera import astrometry
from truesky.render.camera.detectors import Detector
from truesky.render.psf.model import SAMPLES, SIDE, Planes, Psf, from_planes
from truesky.render.psf.sub_bands import sub_bands

if TYPE_CHECKING:
    # Imported in the functions that use it, because its import takes a second.
    from astropy.wcs import WCS

# Values of the header card PSFFRAME, and the axes for which they stand.
_FRAMES = {
    "PIXELS": "columns and rows of the detector",
    "SKY": "x west, y north",
    "CAMERA": "axes of the focal plane, on the sky",
}
# Units that the header card CUNIT1 may have for the spacing of samples on the sky, and their size in arcsec.
_ARCSEC = {"arcsec": 1.0, "mas": 1e-3, "deg": 3600.0}
# Units that the header card CUNIT1 may have for the spacing of samples in the axes of the detector, in pixels.
_PIXEL = {"pixel": 1.0, "pix": 1.0}
# Units that the header card CUNIT3 may have for wavelengths, and their size in Angstrom.
_ANGSTROM = {"Angstrom": 1.0, "nm": 10.0, "um": 1e4, "m": 1e10}
# Smallest sum of a PSF image (fraction of the light that it contains) that is accepted.
_LEAST_SUM = 0.5
# Largest sum of a PSF image (fraction of the light that it contains) that is accepted; above 1 for rounding errors.
_MOST_SUM = 1.001
# Smallest and largest spacing of the samples in a user's file that is accepted, detector pixels.
_SPACING = (0.02, 2.0)
# The absolute value of a number in a header card must be below this; larger numbers, NaN and infinities raise BadInput.
_LARGEST = 1e300
# Largest degree of the polynomials in a file of PSFEx that is accepted.
_MOST_DEGREE = 20
# Smallest side of the PSF images after resampling, pixels. Smaller images are extended by zeros.
_LEAST_SIDE = 66
# Number of lobes of the Lanczos kernel with which images in a file of PSFEx are resampled. PSFEx fits its models with
# this kernel.
_OF_PSFEX = 3
# Highest spatial frequency of a PSFEx model without its interpolation kernel that matters for a star, cycles per pixel.
_DETAIL_OF_PSFEX = 1.75
# Largest number of samples per detector pixel to which the images of a PSFEx file are resampled.
_MOST_SAMPLES = 15
# Largest number of samples of all resampled images of a PSFEx file (256 MB in double precision). If there would be
# more, the images are resampled to fewer samples per pixel.
_MOST_RESAMPLED = 1 << 25
# Smallest side of a PSF that is read from a PSFEx file, pixels.
_LEAST_PSFEX_SIDE = 64
# Number of lobes of the Lanczos kernel with which the PSF images in a user's cube are resampled. With more lobes, the
# interpolation is more accurate.
_OF_CUBES = 15
# Smallest number of samples per detector pixel to which a plane on the sky is resampled before splines interpolate
# between its samples.
_FINE_SAMPLES = 6
# Degree of these splines.
_SPLINE = 5
# Positions along each axis of a detector, from -1 to 1 between its edges, at which a plane on the sky is drawn.
_PLACES = (-0.9, 0.0, 0.9)
# Degree of the polynomial of the position on the detector that is fitted to the changes of these images.
_DEGREE = 2


def path_for_detector(name: str, detector: str) -> Path:
    """Return the path of the PSF file for a detector: `name`, in which the text {detector} is replaced by `detector`.

    Without {detector} in `name`, all detectors have the same file.
    """
    return Path(name.replace("{detector}", detector))


def read(path: Path, detector: Detector, band: Passband | None, system: WCS) -> Psf:
    """Read the PSF of a detector in a band from a user's file, and resample it to three or more samples per pixel.

    Parameters
    ----------
    path : Path
        FITS file with a cube of PSF images, or file of PSFEx.
    detector : Detector
        The detector.
    band : Passband or None
        The passband. It is divided into sub-bands. A cube with several wavelengths must reach from the mean wavelength
        of the first sub-band, or below, to that of the last sub-band, or above. None if the passband is unknown; a cube
        must then have one plane.
    system : astropy.wcs.WCS
        World coordinate system of the detector in the exposure, for planes in the axes of the sky.

    Returns
    -------
    Psf
        The PSF in the axes of the detector.

    Raises
    ------
    BadInput
        If the file does not exist, is too large or not FITS, a header card is missing or invalid, a sample is not
        finite, the sum of an image or the spacing of its samples is out of range, the wavelengths do not cover the
        band, or a PSFEx model has other variables than x and y; the message contains the path.

    Notes
    -----
    For a cube, the interpolation has an error of 5e-5 of the peak if the spacing of its samples is less than half the
    width of the PSF. Planes on the sky are drawn through the derivative of the WCS at nine positions on the detector,
    between which a polynomial of second degree interpolates. The ellipticity of a star has an error below 1e-4.

    For PSFEx, a star differs from `galsim.des.DES_PSFEx` by at most 1e-3 of its peak. Between the samples, a PSFEx
    model is defined by a Lanczos kernel with three lobes. The kernel adds light at spatial frequencies near one cycle
    per sample of the file. The images are therefore resampled to more than twice as many samples per pixel as the file
    has. If the file has more than six samples per pixel, or its images are too large, there are fewer; the difference
    is then up to 7e-3.
    """
    data, header = _read_planes(path)
    try:
        if "POLNAXIS" in header:
            planes = _psfex(data, header, detector)
            side = 2 * int(np.ceil(_psfex_width(data.shape, _card(header, "PSF_SAMP")) / 2.0))
            return from_planes(planes, detector.pixel_scale, has_pixel=True, side=side)
        cube = _check_cube(data, header, detector, band)
        return from_planes(_draw_cube(cube, detector, system), detector.pixel_scale, cube.has_pixel)
    except BadInput as error:
        raise BadInput(f"{path}: {error}") from None


def check(path: Path, detector: Detector, band: Passband | None) -> None:
    """Check that `read` can read the PSF of a detector in a band from a user's file, without resampling a cube.

    Parameters
    ----------
    path : Path
        FITS file with a cube of PSF images, or file of PSFEx.
    detector : Detector
        The detector.
    band : Passband or None
        The passband, or None if it is unknown.

    Raises
    ------
    BadInput
        If `read` would raise it.
    """
    data, header = _read_planes(path)
    try:
        if "POLNAXIS" in header:
            _psfex(data, header, detector)
        else:
            _check_cube(data, header, detector, band)
    except BadInput as error:
        raise BadInput(f"{path}: {error}") from None


def _read_planes(path: Path) -> tuple[Float, Mapping[str, Any]]:
    """Return the PSF images in a file and its header. BadInput is raised if a sample is not finite."""
    data, header = external.read_planes(path, "PSF_MASK")
    if not np.isfinite(data).all():
        raise BadInput(f"{path}: contains values that are not finite numbers")
    return data, header


@dataclass(frozen=True, slots=True)
class _Cube:
    """PSF images of sub-bands from a user's cube, with the meaning of their axes.

    Attributes
    ----------
    wavelength : float array, shape (w,)
        Wavelengths, Angstrom.
    images : float array, shape (w, rows, columns)
        PSF at these wavelengths.
    frame : str
        Axes of the images, a key of _FRAMES.
    step : float
        Spacing of the samples: pixels for the frame PIXELS, otherwise arcsec.
    middle : list of float
        Row and column of the chief ray in the images, from 0.
    has_pixel : bool
        True if the images are already averaged over the detector's pixel.
    """

    wavelength: Float
    images: Float
    frame: str
    step: float
    middle: list[float]
    has_pixel: bool


def _check_cube(data: Float, header: Mapping[str, Any], detector: Detector, band: Passband | None) -> _Cube:
    """Return the PSF images of the sub-bands of a band, after checking the sums of the planes and all header cards."""
    planes = data if data.ndim == 3 else data[None]
    for number, total in enumerate(planes.sum(axis=(1, 2)), start=1):
        if not _LEAST_SUM <= total <= _MOST_SUM:
            raise BadInput(f"plane {number} sums to {total:.4g}, but {_LEAST_SUM:g} to {_MOST_SUM:g} is allowed")
    frame = _frame(header)
    step = _card(header, "CDELT1") * _unit(header, "CUNIT1", _PIXEL if frame == "PIXELS" else _ARCSEC)
    if step <= 0.0 or _card(header, "CDELT2") != _card(header, "CDELT1"):
        raise BadInput("CDELT1 and CDELT2 must be equal and positive")
    _check_spacing(step if frame == "PIXELS" else step / detector.pixel_scale)
    middle = [
        _number(header, f"CRPIX{axis}", (n + 1) / 2) - 1 for axis, n in ((2, data.shape[-2]), (1, data.shape[-1]))
    ]
    waves, weights = _colours(header, len(planes), band)
    images = matrices.matmul(weights, planes.reshape(len(planes), -1)).reshape(-1, *planes.shape[1:])
    return _Cube(waves, images, frame, step, middle, _has_pixel(header))


def _frame(header: Mapping[str, Any]) -> str:
    """Return the value of the header card PSFFRAME of a cube. BadInput is raised if it is not a key of _FRAMES."""
    frame = header.get("PSFFRAME")
    if frame not in _FRAMES:
        problem = "has no card PSFFRAME" if frame is None else f"PSFFRAME = {frame!r} is not known"
        allowed = ", ".join(f"{name!r} ({axes})" for name, axes in _FRAMES.items())
        raise BadInput(f"{problem}: set it to the axes of its planes, one of {allowed}")
    return str(frame)


def _draw_cube(cube: _Cube, detector: Detector, system: WCS) -> Planes:
    """Resample PSF images to samples of the detector, through its WCS unless they have the axes of the detector."""
    half = _half(detector)
    if cube.frame == "PIXELS":
        images = np.stack([_resample(image, cube.step, cube.middle, _OF_CUBES) for image in cube.images])
        return Planes(cube.wavelength, images.astype(np.float32), np.zeros((0, *images.shape[1:]), np.float32), half)
    if cube.frame == "CAMERA":
        system = astrometry.wcs(detector, 0.0, 0.0, 0.0)
    powers, basis, derivatives = _wcs_derivatives(system, half)
    middle = derivatives[len(derivatives) // 2] / cube.step
    images = np.stack([_draw_through(_fine(image, middle, cube.middle), middle) for image in cube.images])
    # The PSF changes with the position as its mean over all colours does.
    mean = _fine(cube.images.mean(axis=0), middle, cube.middle)
    centre = images.mean(axis=0)
    changes = [_draw_through(mean, matrix / cube.step, len(centre)) - centre for matrix in derivatives]
    drift = matrices.least_squares(basis, np.stack(changes).reshape(len(basis), -1)).reshape(-1, *centre.shape)
    kinds = tuple((i, j, 0) for i, j in powers)
    return Planes(cube.wavelength, images.astype(np.float32), drift.astype(np.float32), half, kinds)


def _wcs_derivatives(system: WCS, half: tuple[float, float]) -> tuple[list[tuple[int, int]], Float, Float]:
    """Return the derivatives of sky positions with respect to pixels at positions on a detector.

    Parameters
    ----------
    system : WCS
        World coordinate system of the detector.
    half : (float, float)
        Column and row of the detector's centre.

    Returns
    -------
    powers : list of (int, int)
        Powers of x and y in the terms of a polynomial without constant, where x and y are positions on the detector
        from -1 to 1 between its edges.
    basis : float array, shape (n, terms)
        These terms at the n positions.
    derivatives : float array, shape (n, 2, 2)
        Derivatives to the west and north by column and row, arcsec per pixel. The element in the middle, n // 2, is
        that of the detector's centre.
    """
    x, y = (at.ravel() for at in np.meshgrid(_PLACES, _PLACES))
    powers = [(i, j) for j in range(_DEGREE + 1) for i in range(_DEGREE + 1 - j) if i + j > 0]
    places = (middle + at * (middle + 0.5) for middle, at in zip(half, (x, y), strict=True))
    return powers, np.stack([x**i * y**j for i, j in powers], axis=1), astrometry.jacobian(system, *places)


@dataclass(frozen=True, slots=True)
class _Fine:
    """PSF image on the sky whose samples are so fine that splines interpolate accurately between them.

    Attributes
    ----------
    coefficients : float array, shape (s, s)
        Spline coefficients. The middle sample is the chief ray.
    factor : int
        Number of samples per sample of the file along each axis.
    reach : float
        Largest distance of samples with light from the chief ray along each axis, samples of the file.
    """

    coefficients: Float
    factor: int
    reach: float


def _fine(plane: Float, matrix: Float, middle: list[float]) -> _Fine:
    """Resample a PSF image to at least _FINE_SAMPLES samples per detector pixel, with a Lanczos kernel.

    `matrix`, shape (2, 2), converts pixels to samples of `plane`. `middle` is the row and column of the chief ray in
    `plane`, from 0.
    """
    factor = max(int(np.ceil(_FINE_SAMPLES / np.sqrt(np.abs(matrices.determinant(matrix))))), 1)
    reach = max(max(m, n - 1 - m) for m, n in zip(middle, plane.shape, strict=True)) + _OF_CUBES
    # Samples outside the largest PSF image are not required. The margin is for the splines and for the changes of
    # `matrix` within a detector.
    largest_reach = float(np.abs(matrix).sum(axis=1).max()) * (0.55 * SIDE + _OF_CUBES)
    half = int(np.ceil(min(reach, largest_reach) * factor))
    at = np.arange(-half, half + 1) / factor
    fine = _interpolate(plane, at + middle[0], at + middle[1], _OF_CUBES)
    return _Fine(scipy.ndimage.spline_filter(fine, _SPLINE), factor, reach)


def _draw_through(fine: _Fine, matrix: Float, side: int | None = None) -> Float:
    """Draw a PSF image on the sky in the axes of the detector, with SAMPLES samples per pixel.

    Parameters
    ----------
    fine : _Fine
        The PSF image.
    matrix : float array, shape (2, 2)
        Matrix that converts pixels (column, row) to samples of the file (column, row).
    side : int, optional
        Odd number of rows and columns of the result. By default, all light in a square of SIDE (512) pixels is inside.

    Returns
    -------
    float array, shape (side, side)
        The image, in which the chief ray is the middle sample. Its sum is that of the plane in the file, except for
        light outside.
    """
    if side is None:
        pixels = fine.reach * float(np.abs(matrices.inverse(matrix)).sum(axis=1).max())
        side = 2 * max(min(int(pixels * SAMPLES), SIDE * SAMPLES // 2), _LEAST_SIDE * SAMPLES // 2) + 1
    # The axes of the arrays are (row, column).
    step = matrix[::-1, ::-1] * (fine.factor / SAMPLES)
    offset = len(fine.coefficients) // 2 - step.sum(axis=1) * (side // 2)
    image = scipy.ndimage.affine_transform(
        fine.coefficients, step, offset, (side, side), order=_SPLINE, mode="constant", prefilter=False
    )
    return np.asarray(image * (float(np.abs(matrices.determinant(matrix))) / SAMPLES**2))


def _has_pixel(header: Mapping[str, Any]) -> bool:
    value = header.get("PIXEL", False)
    if not isinstance(value, bool):
        raise BadInput(f"PIXEL = {value!r} is not T or F")
    return value


def _colours(header: Mapping[str, Any], count: int, band: Passband | None) -> tuple[Float, Float]:
    """Return the wavelengths (Angstrom) of PSF images of sub-bands, and weights [images, count] of the cube's planes.

    The cube has `count` planes, images of the PSF at one wavelength each. The PSF image of a sub-band of the passband
    is a weighted sum of these planes: the PSF interpolated linearly in wavelength and averaged over the sub-band's
    photons. A cube with one plane gives one image, and the wavelength in its header is ignored. Raises BadInput for a
    cube with several planes if the passband is unknown (None).
    """
    if band is None:
        if count > 1:
            raise BadInput(f"has {count} planes (NAXIS3), but must have one for a frame whose passband is unknown")
        return np.zeros(1), np.ones((1, 1))
    parts = sub_bands(band)
    means: Float = np.array([np.average(p.wavelength, weights=p.response / p.wavelength) for p in parts])
    if count == 1:
        return means[:1], np.ones((1, 1))
    unit = _unit(header, "CUNIT3", _ANGSTROM)
    if "WAVE1" in header:
        waves: Float = unit * np.array([_card(header, f"WAVE{i}") for i in range(1, count + 1)])
    else:
        number: Float = np.arange(1.0, count + 1) - _number(header, "CRPIX3", 1.0)
        waves = np.asarray(unit * (_card(header, "CRVAL3") + number * _card(header, "CDELT3")))
    if (np.diff(waves) <= 0).any():
        raise BadInput("its wavelengths must increase")
    if waves[0] > means[0] or waves[-1] < means[-1]:
        reach = f"{waves[0]:.0f} to {waves[-1]:.0f} A, but band {band.name} requires {means[0]:.0f} to {means[-1]:.0f}"
        raise BadInput(f"its planes reach from {reach}")
    hats = [np.stack([np.interp(p.wavelength, waves, row) for row in np.eye(count)]) for p in parts]
    return means, np.stack(
        [np.average(hat, axis=1, weights=p.response / p.wavelength) for hat, p in zip(hats, parts, strict=True)]
    )


def _psfex(data: Float, header: Mapping[str, Any], detector: Detector) -> Planes:
    """Convert a PSFEx model to PSF images, with polynomials of the position relative to the detector's centre.

    The images are normalised so that the sum of the PSF is the same everywhere on the detector: the header card
    PSFLIGHT, or 1 for files without it. The sum of a PSFEx model may change with position. The shape of the normalised
    PSF is exact at the centre, and elsewhere correct to first order in this change.

    References
    ----------
    Bertin 2011, ASPC 442, 435; galsim.des.DES_PSFEx (the order of terms).
    """
    degree, groups = (int(_card(header, key)) for key in ("POLDEG1", "POLNGRP"))
    names = [str(header.get(f"POLNAME{i}", "")).strip() for i in (1, 2)]
    places = all(n.startswith(axis) and n.endswith("IMAGE") for n, axis in zip(names, "XY", strict=True))
    if int(_card(header, "POLNAXIS")) != 2 or groups != 1 or not places:
        variables = f"{', '.join(names)} in {groups} groups"
        raise BadInput(f"its polynomials are of {variables}, but must be of X and Y of the image in one group")
    if not 0 <= degree <= _MOST_DEGREE:
        raise BadInput(f"its polynomials are of degree {degree}, but 0 to {_MOST_DEGREE} is allowed")
    powers = [(i, j) for j in range(degree + 1) for i in range(degree + 1 - j)]
    if data.ndim != 3 or len(data) != len(powers):
        raise BadInput(f"PSF_MASK has {list(data.shape)} samples, but degree {degree} requires {len(powers)} planes")
    half = _half(detector)
    # A PSFEx model has polynomials of (x - zero) / scale, and the same for y, where x is the 1-based pixel. This equals
    # shift + stretch * t, where t is the position from -1 to 1 between the edges of the detector. The polynomials are
    # expanded in powers of t.
    zero, scale = ([_card(header, f"POL{kind}{axis}") for axis in (1, 2)] for kind in ("ZERO", "SCAL"))
    if not all(scale):
        raise BadInput("POLSCAL1 and POLSCAL2 must not be 0")
    shift = [(half[k] + 1.0 - zero[k]) / scale[k] for k in (0, 1)]
    stretch = [(half[k] + 0.5) / scale[k] for k in (0, 1)]
    middle = [(n - 1) / 2 for n in data.shape[1:]]
    planes = np.zeros_like(data)
    for number, (p, q) in enumerate(powers):
        for (i, j), term in zip(powers, data, strict=True):
            if i >= p and j >= q:
                along = comb(i, p) * shift[0] ** (i - p) * stretch[0] ** p
                planes[number] += along * comb(j, q) * shift[1] ** (j - q) * stretch[1] ** q * term
    spacing = _card(header, "PSF_SAMP")
    samples = _psfex_samples(spacing, data.shape)
    drawn = np.stack([_resample(plane, spacing, middle, _OF_PSFEX, samples) for plane in planes])
    totals = drawn.sum(axis=(1, 2))
    if not totals[0] > 0.0:
        raise BadInput(f"its PSF in the middle of the detector must have a positive sum, got {totals[0]:.4g}")
    light = _number(header, "PSFLIGHT", 1.0)
    if not _LEAST_SUM <= light <= _MOST_SUM:
        raise BadInput(f"PSFLIGHT = {light:.4g}, but {_LEAST_SUM:g} to {_MOST_SUM:g} is allowed")
    image = drawn[0] * (light / totals[0])
    drift = (drawn[1:] - (totals[1:] / totals[0])[:, None, None] * drawn[0]) * (light / totals[0])
    return Planes(
        np.zeros(1),
        image[None].astype(np.float32),
        drift.astype(np.float32),
        half,
        tuple((i, j, 0) for i, j in powers[1:]),
        samples,
    )


def _psfex_samples(spacing: float, shape: tuple[int, ...]) -> int:
    """Return the number of samples per detector pixel to which the images of a PSFEx file are resampled.

    `spacing` is the spacing of the file's samples in detector pixels, and `shape` the shape (n, rows, columns) of the
    images. BadInput is raised if `spacing` is out of range.
    """
    _check_spacing(spacing)
    # A star contains the PSF once more at frequencies around 1 / spacing, because of the interpolation kernel. The
    # samples must reach these frequencies (cycles per pixel); `Planes.max_frequency` is 1/4 below their limit.
    accurate = int(np.ceil(2.0 * (1.0 / spacing + _DETAIL_OF_PSFEX) + 0.5))
    width = max(_psfex_width(shape, spacing), _LEAST_SIDE)
    affordable = int(np.sqrt(_MOST_RESAMPLED / shape[0]) / width)
    return max(min(accurate, _MOST_SAMPLES, affordable), SAMPLES)


def _psfex_width(shape: tuple[int, ...], spacing: float) -> float:
    """Return the width of the resampled images of a PSFEx file, 64 to SIDE (512) pixels.

    `shape` is the shape (n, rows, columns) of the images in the file, and `spacing` the spacing of their samples in
    pixels.
    """
    return min(max((max(shape[1:]) + 2 * _OF_PSFEX) * spacing, _LEAST_PSFEX_SIDE), SIDE)


def _check_spacing(spacing: float) -> None:
    if not _SPACING[0] <= spacing <= _SPACING[1]:
        raise BadInput(f"its samples are {spacing:.4g} pixels apart, but {_SPACING[0]:g} to {_SPACING[1]:g} is allowed")


def _resample(plane: Float, spacing: float, middle: list[float], lobes: int, samples: int = SAMPLES) -> Float:
    """Resample a PSF image to `samples` samples per detector pixel, with a Lanczos kernel of `lobes` lobes.

    `spacing` is the spacing of the samples of `plane` in detector pixels; BadInput is raised if it is out of range.
    `middle` is the position (row, column, from 0) of the PSF in `plane`, which becomes the middle sample of the result.
    The sum of the image is preserved, except for light outside a square of SIDE (512) pixels, which is cut off.
    """
    _check_spacing(spacing)
    reach = max(max(m, n - 1 - m) for m, n in zip(middle, plane.shape, strict=True)) + lobes
    half = max(min(int(reach * spacing * samples), SIDE * samples // 2), _LEAST_SIDE * samples // 2)
    at = np.arange(-half, half + 1) / (samples * spacing)
    return _interpolate(plane, at + middle[0], at + middle[1], lobes) / (samples * spacing) ** 2


def _interpolate(plane: Float, rows: Float, columns: Float, lobes: int) -> Float:
    """Interpolate an image at fractional rows [n] and columns [m] by a Lanczos kernel of `lobes` lobes, float64[n, m].

    Pixels outside the image are treated as 0.
    """
    return _interpolate_rows(_interpolate_rows(plane.T, columns, lobes).T, rows, lobes)


def _interpolate_rows(plane: Float, at: Float, lobes: int) -> Float:
    """Interpolate an image [rows, columns] at fractional rows `at` [n] by a Lanczos kernel, float64[n, columns].

    The weights are normalised so that equal rows give the same row between them. Rows outside the image are 0.
    """
    count, first = len(plane), np.floor(at).astype(np.int64)
    steps = np.arange(1 - lobes, lobes + 1)
    distance = (at - first)[:, None] - steps
    kernel = np.sinc(distance) * np.sinc(distance / lobes)
    kernel /= kernel.sum(axis=1, keepdims=True)
    out = np.zeros((len(at), plane.shape[1]))
    for step, weight in zip(steps, kernel.T, strict=True):
        row = first + step
        inside = np.where((row >= 0) & (row < count), weight, 0.0)
        out += inside[:, None] * plane[np.clip(row, 0, count - 1)]
    return out


def _half(detector: Detector) -> tuple[float, float]:
    return (detector.nx - 1) / 2, (detector.ny - 1) / 2


def _card(header: Mapping[str, Any], key: str) -> float:
    if key not in header:
        raise BadInput(f"has no card {key}")
    return _number(header, key, 0.0)


def _number(header: Mapping[str, Any], key: str, default: float) -> float:
    value = header.get(key, default)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < _LARGEST:
        raise BadInput(f"{key} = {value!r} is not a number")
    return float(value)


def _unit(header: Mapping[str, Any], key: str, units: Mapping[str, float]) -> float:
    name = str(header.get(key, "")).strip()
    if name not in units:
        raise BadInput(f"{key} = {name!r} is not one of {', '.join(units)}")
    return units[name]
