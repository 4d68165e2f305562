"""Data model of a PSF: images that depend on wavelength and position (planes), or one analytic profile."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import scipy

from lake_schema.arrays import Array, Float, Float32
from lake_schema.errors import BadInput
from truesky.render.psf.spikes import Edges

if TYPE_CHECKING:
    # Imported in the functions that use it, because its import takes half a second.
    import galsim

_T = TypeVar("_T")

# Number of samples of a PSF image per detector pixel: for VIS, for PSFs from files, and for analytic profiles. The
# finest optical detail of VIS (lambda / D at 540 nm) is 2.8 samples wide.
SAMPLES = 3
# Upper limit of the spatial frequencies that the optics transmit, cycles per sample of a PSF image. The kernels with
# which PSF images are blurred are accurate only up to this frequency.
DETAIL = 0.4
# Largest side of a PSF image, pixels. It is also the largest side of the stamp (square image) of a star at rest that is
# drawn with PSF images. Light outside it (0.2 % for VIS) is drawn only for bright stars (drawing/far_light.py).
SIDE = 512
# Side of the image on which the FWHM of a PSF is measured, samples.
_CORE = 243
# Numbers of samples per pixel for the image on which the FWHM of a PSF is measured. They are tried in this order until
# the core of the PSF (above half of the maximum) fits into the image.
_FINE = (9, 3, 1)
# Range of rows and columns, the middle two thirds, of the image on which the FWHM of a PSF is measured. The core of the
# PSF (above half of the maximum) must lie inside it; otherwise a wider image is used.
_WITHIN = slice(_CORE // 6, -(_CORE // 6))


@dataclass(frozen=True, slots=True)
class Planes:
    """Images (planes) whose weighted sum is the PSF of a source with a given spectrum and position on the detector.

    Attributes
    ----------
    wavelength : float array, shape (w,)
        Wavelengths of `images`, Angstrom.
    images : float32 array, shape (w, s, s)
        PSF at the detector's centre by wavelength, centred on the middle sample. The sum of an image is the fraction of
        the light inside it. For a ground telescope through turbulent air and for PSFEx, images are normalised to the
        sum 1 instead.
    drift : float32 array, shape (d, t, t)
        Changes of the PSF with position and colour, centred like `images`; d = 0 if the PSF does not depend on
        position.
    half : (float, float)
        Column and row of the detector's centre, (nx - 1) / 2 and (ny - 1) / 2.
    powers : tuple of (int, int, int)
        For each image in `drift`, the powers (a, b, c) of x, y and colour in the term that multiplies it; see the
        notes.
    samples : int
        Samples per pixel of the detector.
    origin : (int, int)
        Column and row of the detector at which the drawn image begins, (0, 0) if the whole detector is drawn.

    Notes
    -----
    The PSF of a source is::

        sum_w photons_w images_w + sum_j x^a_j y^b_j redder^c_j drift_j,   (a_j, b_j, c_j) = powers_j

    The first sum is over the wavelengths, and the second over the images in `drift`. photons_w is the fraction of the
    source's photons at each wavelength. x and y are its position on the detector, from -1 to 1 between the edges.
    redder is the mean wavelength of the source's photons minus the mean of `wavelength`, Angstrom.
    """

    wavelength: Float
    images: Float32
    drift: Float32
    half: tuple[float, float]
    powers: tuple[tuple[int, int, int], ...] = ()
    samples: int = SAMPLES
    origin: tuple[int, int] = (0, 0)

    @property
    def max_frequency(self) -> float:
        """Highest spatial frequency of the images that is used, radian / pixel.

        It is 0.5 pi below the Nyquist frequency of the samples.
        """
        return (self.samples - 0.5) * np.pi


@dataclass(frozen=True, slots=True)
class Psf:
    """A point-spread function, with tables from which the sizes of the stamps (square images of sources) are chosen.

    Attributes
    ----------
    profile : galsim.GSObject
        PSF in arcsec in the axes of the detector, for a source with constant f_nu at the detector's centre. It does not
        include the pixel unless `intra_pixel` is None. Its flux is the fraction of the light that the model contains.
    pixel_scale : float
        Arcsec per pixel.
    surface : float array, shape (side / 2,)
        Element r is the azimuthal mean of the fraction of the flux in a pixel at a distance of r pixels.
    rim : float array, shape (side / 2,)
        Element r is the largest fraction of the flux in a pixel at r pixels or more along columns or rows. Diffraction
        spikes make it larger than `surface`.
    outside : float array, shape (side / 2,)
        Element r is the fraction of the flux farther than r pixels away, within the flux of `profile`.
    fwhm : float
        FWHM including the pixel, arcsec.
    planes : Planes or None
        Images by wavelength and position, with which sources are drawn; None if `profile` is the whole model.
    intra_pixel : float or None
        Loss of response at a pixel's edges relative to its centre (effects/light/intra_pixel.py), 0 for a uniform
        response. None if the PSF already includes the pixel.
    edges : Edges or None
        Edges of the pupil and aureole, which cause light beyond the border of `planes`; None if there is no such light.
    derived : dict or None
        Quantities that have been computed from this PSF, such as Fourier transforms, so that many small images with the
        same PSF share them; None to keep none. See `keep`.
    window : float or None
        Rms of the Gaussian window in which positions of stars are centroids, arcsec; None for the window that
        SourceExtractor would choose, whose FWHM is the half-light diameter (see `centroids.window_rms`).
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
    derived: dict[Any, Any] | None = None
    window: float | None = None

    @property
    def side(self) -> int:
        """Side of the PSF images, pixels; for an analytic PSF, twice the largest radius in the table `surface`."""
        return 2 * len(self.surface)

    def keep(self, key: tuple[Hashable, ...], compute: Callable[[], _T]) -> _T:
        """Return the result of `compute`, a function of this PSF without arguments, from `derived` if it is there.

        The key identifies the quantity and everything on which it depends besides the PSF.
        """
        if self.derived is None:
            return compute()
        # The copies of a PSF with another response inside the pixel share the dictionary. A copy with another image
        # must not find the results for this one.
        full_key = (*key, self.intra_pixel)
        image = self.profile if self.planes is None else self.planes.images
        if full_key not in self.derived or self.derived[full_key][0] is not image:
            self.derived[full_key] = image, compute()
        result: _T = self.derived[full_key][1]
        return result


def reduce_colours(psf: Psf, colours: int) -> Psf:
    """Return the PSF with at most `colours` wavelengths, to save drawing time.

    Neighbouring wavelengths and their images are averaged in groups of equal size. A PSF that has at most `colours`
    wavelengths, or no planes, is returned unchanged.

    Raises
    ------
    BadInput
        If the number of wavelengths is larger than `colours` and not a multiple of it.
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
    """Convert a PSF image to a galsim object in arcsec.

    Parameters
    ----------
    image : float array, shape (s, s)
        Image of the PSF, centred on the middle sample.
    sampling : float
        Spacing of the samples, arcsec.
    exact : bool
        True to interpolate between samples with a wide Lanczos kernel, as reference images require. By default galsim's
        quintic interpolant is used, which has errors of 1e-4 in the middle of steep bulges.

    Returns
    -------
    galsim.GSObject
        The PSF; its flux is the sum of the image.
    """
    import galsim

    sampled = galsim.Image(np.asarray(image, float), scale=sampling)
    # A PSF is nearly 0 at the border of its image, so galsim need pad it only to twice its side. The step and the
    # largest frequency in Fourier space are given, since galsim would spend time on finding them.
    return galsim.InterpolatedImage(
        sampled,
        x_interpolant=galsim.Lanczos(31) if exact else None,
        pad_factor=2.0,
        flux=float(image.sum(dtype=float)),
        _force_stepk=2 * np.pi / (len(image) * sampled.scale),
        _force_maxk=np.pi / sampled.scale,
    )


def from_planes(planes: Planes, pixel_scale: float, has_pixel: bool, side: int = SIDE) -> Psf:
    """Build a PSF from images, and compute its FWHM and the tables of its light by radius.

    Parameters
    ----------
    planes : Planes
        Images by wavelength and position.
    pixel_scale : float
        Arcsec per pixel.
    has_pixel : bool
        True if the images are already averaged over the detector's pixel.
    side : int
        Side of the largest stamp of a point source, pixels.

    Returns
    -------
    Psf
        The PSF.
    """
    mean = planes.images.mean(axis=0, dtype=float)
    return from_profile(galsim_profile(mean, pixel_scale / planes.samples), pixel_scale, planes, has_pixel, side)


def gaussian(fwhm: float, pixel_scale: float) -> Psf:
    """Return a round Gaussian PSF that already includes the average over a pixel.

    `fwhm` is its FWHM in arcsec, and `pixel_scale` is in arcsec per pixel.
    """
    import galsim

    return from_profile(galsim.Gaussian(fwhm=fwhm), pixel_scale, has_pixel=True)


def from_profile(
    profile: galsim.GSObject,
    pixel_scale: float,
    planes: Planes | None = None,
    has_pixel: bool = False,
    side: int = SIDE,
) -> Psf:
    """Build a PSF from a galsim profile, and compute its FWHM and the tables of its light by radius.

    Parameters
    ----------
    profile : galsim.GSObject
        Profile of the PSF in arcsec, centred on 0.
    pixel_scale : float
        Arcsec per pixel.
    planes : Planes, optional
        Images with which sources are drawn; by default the profile is drawn.
    has_pixel : bool
        True if the profile is already averaged over a pixel.
    side : int
        Twice the radius up to which the tables are computed, pixels.

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
    ring_max = np.asarray(scipy.ndimage.maximum(image, square, np.arange(side // 2)))
    rim = np.maximum(np.maximum.accumulate(ring_max[::-1])[::-1], 0.0)
    outside = np.maximum(profile.flux - np.cumsum(total), 0.0)
    fwhm = _width(profile, pixel_scale, has_pixel)
    return Psf(profile, pixel_scale, surface, rim, outside, fwhm, planes, None if has_pixel else 0.0)


def _width(profile: galsim.GSObject, pixel_scale: float, has_pixel: bool) -> float:
    """Return the FWHM of a PSF averaged over pixels, arcsec; `has_pixel` is True if `profile` is already averaged."""
    import galsim

    for samples in _FINE:
        core = profile.drawImage(nx=_CORE, ny=_CORE, scale=pixel_scale / samples, method="no_pixel", dtype=float)
        with_pixel = core.array if has_pixel else scipy.ndimage.uniform_filter(core.array, samples)
        bright = with_pixel > 0.5 * with_pixel.max()
        # If the core (all samples above half of the maximum) lies in the middle of the image, coarser samples, which
        # cover a wider area, are not necessary.
        if bright[_WITHIN, _WITHIN].sum() == bright.sum():
            break
    # The FWHM is measured about the middle of the samples above half of the maximum, since a PSF from a user's file may
    # not be centred on the image.
    y, x = (float(at[bright].mean()) + 1.0 for at in np.indices(with_pixel.shape))
    return float(galsim.Image(with_pixel, scale=pixel_scale / samples).calculateFWHM(center=galsim.PositionD(x, y)))


def profile_spectrum(psf: Psf, size: int, reach: int) -> Array:
    """Return the Fourier transform of `psf.profile`, without the pixel, at the frequencies of a stamp.

    Parameters
    ----------
    psf : Psf
        The PSF.
    size : int
        Side of the stamp (square image around a source), pixels.
    reach : int
        Largest index of the frequencies along columns and rows.

    Returns
    -------
    complex array, shape (2 reach + 1, reach + 1)
        The element [iy, ix] is the transform at the frequencies ix and iy along x and y, in units of 2 pi / size radian
        per pixel. Rows are in the order of the FFT: iy from 0 to `reach`, then from -`reach` to -1.
    """
    import galsim

    profile = psf.profile.dilate(1.0 / psf.pixel_scale)
    image = galsim.ImageCD(galsim.BoundsI(0, reach, -reach, reach), scale=2 * np.pi / size)
    # The transform of a real image is determined by a half plane. galsim's public method drawKImage would compute the
    # other half too, so its private method is used.
    profile._drawKImage(image)
    return np.asarray(np.roll(image.array, -reach, axis=0))
