"""Data model of a PSF: planes by wavelength and position, or a profile."""

from __future__ import annotations

from dataclasses import dataclass, replace

import galsim
import numpy as np
from scipy.ndimage import maximum, uniform_filter

from lake_schema.arrays import Array, Float, Float32
from lake_schema.errors import BadInput
from truesky.render.psf.spikes import Edges

# Samples per pixel for VIS, for files and for profiles: the finest optical detail (lambda / D at 540 nm) is 2.8
# samples wide. The second value is an upper limit of its frequency in cycles per sample.
SAMPLES, DETAIL = 3, 0.4
# Largest side of a plane, and of the stamp of a point source, pixels. Light outside it (0.2 % for VIS) is drawn only
# for bright stars (drawing/far_light.py).
SIDE = 512
# Side of the image for measuring the width, samples, and its samples per pixel: the first that lets the core fit.
_CORE, _FINE = 243, (9, 3, 1)
_WITHIN = slice(_CORE // 6, -(_CORE // 6))


@dataclass(frozen=True, slots=True)
class Planes:
    """PSF by wavelength and position, centred on the middle sample.

    Attributes
    ----------
    wavelength : float array, shape (w,)
        Wavelengths, Angstrom.
    images : float32 array, shape (w, s, s)
        PSF at the detector's centre, of unit flux over the whole sky.
    drift : float32 array, shape (d, t, t)
        Changes with position and colour; d = 0 for one PSF per detector.
    half : (float, float)
        Half the columns and half the rows of the detector, the units of x and y.
    powers : tuple of (int, int, int)
        Powers of x, y and redder for each plane of the drift.
    samples : int
        Samples per pixel.

    Notes
    -----
    The PSF of a source is::

        sum_w photons_w images_w + sum_j x^a_j y^b_j redder^c_j drift_j,   (a, b, c) = powers

    where redder is the mean wavelength of its photons minus that of the planes, Angstrom.
    """

    wavelength: Float
    images: Float32
    drift: Float32
    half: tuple[float, float]
    powers: tuple[tuple[int, int, int], ...] = ()
    samples: int = SAMPLES

    @property
    def max_frequency(self) -> float:
        """Highest frequency used, radian / pixel: a quarter of a cycle per pixel below the Nyquist frequency."""
        return (self.samples - 0.5) * np.pi


@dataclass(frozen=True, slots=True)
class Psf:
    """A point-spread function, with the tables needed for the choice of stamp sizes.

    Attributes
    ----------
    profile : galsim.GSObject
        Profile in arcsec and detector axes, without the pixel, for flat f_nu at the detector's centre. Its flux is the
        fraction that the model contains.
    pixel_scale : float
        Arcsec per pixel.
    surface : float array, shape (side / 2,)
        Azimuthal mean of the fraction of the flux in a pixel at a distance of r pixels.
    rim : float array, shape (side / 2,)
        Largest fraction in a pixel at r pixels or more along columns or rows; spikes of the pupil's bars exceed the
        mean.
    outside : float array, shape (side / 2,)
        Fraction of the flux beyond r pixels.
    fwhm : float
        FWHM including the pixel, arcsec.
    planes : Planes or None
        Planes by wavelength and position; None if `profile` is the whole model.
    intra_pixel : float or None
        Loss of response at a pixel's edges relative to its centre (effects/light/intra_pixel.py), 0 for a uniform
        response. None if the PSF already includes the pixel.
    edges : Edges or None
        Sources of light beyond the planes; None if there is no such light.
    """

    profile: galsim.GSObject
    pixel_scale: float
    surface: Float
    rim: Float
    outside: Float
    fwhm: float
    planes: Planes | None = None
    intra_pixel: float | None = 0.0
    edges: Edges | None = None

    @property
    def side(self) -> int:
        """Side of its planes, pixels."""
        return 2 * len(self.surface)


def reduce_colours(psf: Psf, colours: int) -> Psf:
    """Return the PSF with at most `colours` wavelengths, each the mean of neighbours with equal numbers of photons.

    Raises
    ------
    BadInput
        If the number of wavelengths is not a multiple of `colours`.
    """
    planes = psf.planes
    if planes is None or len(planes.wavelength) <= colours:
        return psf
    if len(planes.wavelength) % colours:
        raise BadInput(f"{len(planes.wavelength)} wavelengths of a PSF are not a multiple of {colours}")
    wavelength = planes.wavelength.reshape(colours, -1).mean(axis=1)
    images = planes.images.reshape(colours, -1, *planes.images.shape[1:]).mean(axis=1)
    return replace(psf, planes=replace(planes, wavelength=wavelength, images=images))


def galsim_profile(image: Array, sampling: float, exact: bool = False) -> galsim.GSObject:
    """Convert a plane to a galsim object in arcsec.

    Parameters
    ----------
    image : float array
        The plane.
    sampling : float
        Spacing of its samples, arcsec.
    exact : bool
        True, for the reference, to interpolate almost like the Fourier series. galsim's quintic interpolant has errors
        of 1e-4 in the middle of steep bulges.

    Returns
    -------
    galsim.GSObject
        The profile.
    """
    sampled = galsim.Image(np.asarray(image, float), scale=sampling)
    # A plane that is empty at its border needs little padding, and its extent in real and Fourier space is known.
    return galsim.InterpolatedImage(
        sampled,
        x_interpolant=galsim.Lanczos(31) if exact else None,
        pad_factor=2.0,
        flux=float(image.sum(dtype=float)),
        _force_stepk=2 * np.pi / (len(image) * sampled.scale),
        _force_maxk=np.pi / sampled.scale,
    )


def from_planes(planes: Planes, pixel_scale: float, has_pixel: bool, side: int = SIDE) -> Psf:
    """Build a PSF from planes.

    Parameters
    ----------
    planes : Planes
        The planes.
    pixel_scale : float
        Arcsec per pixel.
    has_pixel : bool
        True if the planes include the detector's pixel.
    side : int
        Side of the largest stamp of a point source, pixels.

    Returns
    -------
    Psf
        The PSF.
    """
    mean = planes.images.mean(axis=0, dtype=float)
    return from_profile(galsim_profile(mean, pixel_scale / planes.samples), pixel_scale, planes, has_pixel, side)


def from_profile(
    profile: galsim.GSObject,
    pixel_scale: float,
    planes: Planes | None = None,
    has_pixel: bool = False,
    side: int = SIDE,
) -> Psf:
    """Build a PSF from a profile, with azimuthal means and largest values on pixels.

    Parameters
    ----------
    profile : galsim.GSObject
        Profile of the PSF.
    pixel_scale : float
        Arcsec per pixel.
    planes : Planes, optional
        Planes for drawing; None to draw the profile.
    has_pixel : bool
        True if the profile is already averaged over a pixel.
    side : int
        Twice the radius of the tables, pixels.

    Returns
    -------
    Psf
        The PSF.
    """
    image = profile.drawImage(nx=side + 1, ny=side + 1, scale=pixel_scale, method="no_pixel", dtype=float).array
    grid = np.arange(side + 1) - side // 2
    ring = np.rint(np.hypot(*np.meshgrid(grid, grid))).astype(int)
    inside = ring < side // 2
    total = np.bincount(ring[inside], image[inside])
    surface = np.maximum(total / np.bincount(ring[inside]), 0.0)
    square = np.maximum(*np.meshgrid(np.abs(grid), np.abs(grid)))
    ring_max = np.asarray(maximum(image, square, np.arange(side // 2)))
    rim = np.maximum(np.maximum.accumulate(ring_max[::-1])[::-1], 0.0)
    outside = np.maximum(profile.flux - np.cumsum(total), 0.0)
    fwhm = _width(profile, pixel_scale, has_pixel)
    return Psf(profile, pixel_scale, surface, rim, outside, fwhm, planes, None if has_pixel else 0.0)


def _width(profile: galsim.GSObject, pixel_scale: float, has_pixel: bool) -> float:
    """FWHM including the pixel, arcsec."""
    for samples in _FINE:
        core = profile.drawImage(nx=_CORE, ny=_CORE, scale=pixel_scale / samples, method="no_pixel", dtype=float)
        with_pixel = core.array if has_pixel else uniform_filter(core.array, samples)
        bright = with_pixel > 0.5 * with_pixel.max()
        # A core that fits into the image needs no coarser sampling.
        if bright[_WITHIN, _WITHIN].sum() == bright.sum():
            break
    # The width is measured about the middle of the core, since a user's PSF may not be centred.
    y, x = (float(at[bright].mean()) + 1.0 for at in np.indices(with_pixel.shape))
    return float(galsim.Image(with_pixel, scale=pixel_scale / samples).calculateFWHM(center=galsim.PositionD(x, y)))


def profile_spectrum(psf: Psf, size: int, reach: int) -> Array:
    """Fourier transform of the profile on the grid of a stamp, without the pixel.

    Parameters
    ----------
    psf : Psf
        The PSF.
    size : int
        Side of the stamp, pixels.
    reach : int
        Largest index of the frequencies.

    Returns
    -------
    complex array, shape (2 reach + 1, reach + 1)
        Transform [iy, ix] at (ix, iy) times 2 pi / size radian / pixel.
    """
    profile = psf.profile.dilate(1.0 / psf.pixel_scale)
    image = galsim.ImageCD(galsim.BoundsI(0, reach, -reach, reach), scale=2 * np.pi / size)
    # A half plane is sufficient for a real image, but galsim's public method draws both halves.
    profile._drawKImage(image)
    return np.asarray(np.roll(image.array, -reach, axis=0))
