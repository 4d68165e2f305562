"""A PSF as the renderer knows it: planes in Fourier space, or a table of its profile.

spectrum_of           the Fourier transform of a PSF without planes
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import galsim
import numpy as np
from scipy.ndimage import maximum, uniform_filter

from lake_schema.arrays import Array, Float, Float32
from lake_schema.errors import BadInput
from truesky.render.psf.spikes import Edges

# Samples a pixel of VIS, of files and of profiles: the finest optical detail (lambda / D at 540 nm) is 2.8 samples
# wide; cycles a sample that are more.
SAMPLES, DETAIL = 3, 0.4
# Largest side of a plane, pixels, and of the largest stamp of a point; what lies outside (VIS: 0.2 %) is drawn for
# bright stars alone (drawing/far_light.py).
SIDE = 512
# Side of the drawing that tells the width, and its samples a pixel: as many as let it hold what is broad.
_CORE, _FINE = 243, (9, 3, 1)
_WITHIN = slice(_CORE // 6, -(_CORE // 6))


@dataclass(frozen=True, slots=True)
class Planes:
    """A PSF by wavelength and place, centred on the middle sample.

    PSF(source) = sum_w photons_w images_w + sum_j x^a_j y^b_j redder^c_j drift_j, (a, b, c) = powers, redder the mean
    wavelength of its photons above that of the planes, A.

    wavelength : float64[w] A;  images : float32[w, s, s] of unit flux over the whole sky, at the detector's centre
    drift      : float32[d, t, t]; d = 0 for one PSF a detector
    powers     : [d] of x, y and redder
    half       : (columns, rows) half the detector: the unit of x and y
    samples    : a pixel
    """

    wavelength: Float
    images: Float32
    drift: Float32
    half: tuple[float, float]
    powers: tuple[tuple[int, int, int], ...] = ()
    samples: int = SAMPLES

    @property
    def max_frequency(self) -> float:
        """Beyond it nothing is looked at, radian / pixel: a quarter of a cycle a pixel before the samples' last."""
        return (self.samples - 0.5) * np.pi


@dataclass(frozen=True, slots=True)
class Psf:
    """A point-spread function with what the choice of a stamp's size needs.

    profile     : galsim object, arcsec, detector axes, without the pixel, for flat f_nu at the detector's centre; its
                  flux is what the model keeps of 1
    pixel_scale : arcsec
    surface     : float64[side / 2] fraction of the flux in a pixel at a distance of r pixels (azimuthal mean)
    rim         : float64[side / 2] the largest fraction in a pixel at r pixels or more along columns or rows: spikes of
                  the pupil's bars rise above the mean
    outside     : float64[side / 2] fraction of the flux beyond r pixels
    fwhm        : arcsec, pixel included
    planes      : by wavelength and place; None where `profile` is all
    intra_pixel : how much less a pixel's edges see than its centre (effects/intra_pixel), 0 = nothing; None: the PSF
                  has the pixel in it already
    edges       : what shines beyond the planes; None: nothing does
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
        """Of its planes, pixels."""
        return 2 * len(self.surface)


def reduce_colours(psf: Psf, colours: int) -> Psf:
    """The same PSF of so many wavelengths at most: each the mean of neighbours, which are of as many photons."""
    planes = psf.planes
    if planes is None or len(planes.wavelength) <= colours:
        return psf
    if len(planes.wavelength) % colours:
        raise BadInput(f"{len(planes.wavelength)} wavelengths of a PSF are not a multiple of {colours}")
    wavelength = planes.wavelength.reshape(colours, -1).mean(axis=1)
    images = planes.images.reshape(colours, -1, *planes.images.shape[1:]).mean(axis=1)
    return replace(psf, planes=replace(planes, wavelength=wavelength, images=images))


def galsim_profile(image: Array, sampling: float, exact: bool = False) -> galsim.GSObject:
    """A plane as a galsim object, arcsec.

    sampling : arcsec between its samples
    exact : for the reference, between samples all but their Fourier series: what galsim's quintic makes of them is
            1e-4 wrong in the middle of steep bulges
    """
    sampled = galsim.Image(np.asarray(image, float), scale=sampling)
    # A plane that is empty at its border needs little padding; its extent in real and Fourier space is known.
    return galsim.InterpolatedImage(
        sampled,
        x_interpolant=galsim.Lanczos(31) if exact else None,
        pad_factor=2.0,
        flux=float(image.sum(dtype=float)),
        _force_stepk=2 * np.pi / (len(image) * sampled.scale),
        _force_maxk=np.pi / sampled.scale,
    )


def from_planes(planes: Planes, pixel_scale: float, has_pixel: bool, side: int = SIDE) -> Psf:
    """A PSF of planes.

    pixel_scale : arcsec;  has_pixel : the detector's pixel is in them
    side        : of a point's largest stamp through them, pixels
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
    """With azimuthal means, and the largest values, of the profile sampled on pixels.

    profile     : of the PSF;  pixel_scale : arcsec;  planes : to draw through, None: the profile
    has_pixel   : whether the profile is averaged over a pixel already
    side        : pixels as far as which it is tabulated, twice
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
    """FWHM with the pixel, arcsec.

    profile, pixel_scale, has_pixel : as of `tabulated`
    """
    for samples in _FINE:
        core = profile.drawImage(nx=_CORE, ny=_CORE, scale=pixel_scale / samples, method="no_pixel", dtype=float)
        with_pixel = core.array if has_pixel else uniform_filter(core.array, samples)
        bright = with_pixel > 0.5 * with_pixel.max()
        # What ends well within the drawing needs no coarser one.
        if bright[_WITHIN, _WITHIN].sum() == bright.sum():
            break
    # About the middle of the core: a user's PSF may lie off the source's place.
    y, x = (float(at[bright].mean()) + 1.0 for at in np.indices(with_pixel.shape))
    return float(galsim.Image(with_pixel, scale=pixel_scale / samples).calculateFWHM(center=galsim.PositionD(x, y)))


def profile_spectrum(psf: Psf, size: int, reach: int) -> Array:
    """Fourier transform of `profile` on the grid of a stamp of `size` pixels, without the pixel.

    returns : complex[2 reach + 1, reach + 1], [iy, ix] at (ix, iy) times 2 pi / size radian / pixel
    """
    profile = psf.profile.dilate(1.0 / psf.pixel_scale)
    image = galsim.ImageCD(galsim.BoundsI(0, reach, -reach, reach), scale=2 * np.pi / size)
    # The half plane is all that a real image needs; galsim's public call draws both halves.
    profile._drawKImage(image)
    return np.asarray(np.roll(image.array, -reach, axis=0))
