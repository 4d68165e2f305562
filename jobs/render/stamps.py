"""Drawing sources: each on its own stamp, through one shared PSF, in Fourier space, summed onto a frame.

A stamp's image is the inverse transform of profile(k) PSF(k) pixel(k) on the stamp's own k grid.  Light that
belongs outside a stamp comes in at its opposite edge: nothing is lost, nothing is rescaled.  A stamp is large
enough that what wraps is below the noise at its edge, and below the flux budget in the source's aperture.

Sources         what is drawn: galaxies (with a shape) and points
stamp_sizes     pixels, from flux, shape, PSF, noise and accuracy
draw            sources -> frame
reference       one source by galsim's own drawImage: what `draw` is held against
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import galsim
import numpy as np
import numpy.typing as npt
import scipy.fft

from jobs.accuracy import Accuracy
from jobs.render import profiles
from jobs.render.profiles import Shapes
from jobs.render.psf import SIDE, Psf

Float = npt.NDArray[np.float64]
Int = npt.NDArray[np.int64]
Complex = npt.NDArray[np.complex128]

# Sides whose transforms are fast; the last bounds memory (its k plane has 134 MB).
SIZES = np.array([32, 48, 64, 96, 128, 192, 256, 384, 512, 768, 1024, 1536, 2048])
# The aperture in which wrapped light is held to the flux budget: this many PSF widths plus half-light radii.
_APERTURE_WIDTHS, _APERTURE_RADII = 2.0, 2.0
# A component smaller than this many pixels is a point: it changes second moments by less than 1e-3 of the
# PSF's.
_POINT_RADIUS = 0.02
# The k plane reaches twice the Nyquist frequency only where the PSF and pixel still pass more than this.
_BAND_LIMIT = 1e-4


@dataclass(frozen=True, slots=True)
class Sources:
    """n sources in the order in which they are drawn (ascending id).

    column, row : float64[n] 0-based pixel position
    jacobian    : float64[n, 2, 2] d(u, v) / d(column, row), arcsec
    electrons   : float64[n] expected
    shape       : row of `shapes`, -1 = a point
    """

    ids: Int
    column: Float
    row: Float
    jacobian: Float
    electrons: Float
    shape: Int
    shapes: Shapes

    def __len__(self) -> int:
        return len(self.ids)

    def take(self, chosen: npt.NDArray[np.bool_] | Int) -> Sources:
        """Some of the sources."""
        return Sources(
            self.ids[chosen],
            self.column[chosen],
            self.row[chosen],
            self.jacobian[chosen],
            self.electrons[chosen],
            self.shape[chosen],
            self.shapes,
        )


def stamp_sizes(electrons: Float, shape: Int, shapes: Shapes, psf: Psf, noise: float, accuracy: Accuracy) -> Int:
    """Side of each source's stamp, pixels.

    noise    : of a pixel, electrons
    accuracy : at the stamp's edge the surface brightness is below `background` of the noise, and of the light
               that wraps less than `flux` of the source falls into its aperture
    returns  : int64[n], one of SIZES
    """
    half = SIZES // 2
    radius = half * psf.pixel_scale
    inside = np.minimum(half, SIDE // 2 - 1)
    edge = np.where(half < SIDE // 2, psf.surface[inside], 0.0)
    beyond = psf.outside[inside]
    surface, lost = np.tile(edge, (len(shape), 1)), np.tile(beyond, (len(shape), 1))
    aperture = np.full(len(shape), _APERTURE_WIDTHS * psf.fwhm)
    is_galaxy = shape >= 0
    if is_galaxy.any():
        which = shape[is_galaxy]
        surface[is_galaxy] += profiles.surface(shapes, radius)[which] * psf.pixel_scale**2
        lost[is_galaxy] += profiles.outside(shapes, radius)[which]
        aperture[is_galaxy] += _APERTURE_RADII * profiles.half_light_radius(shapes)[which]
    covered = np.minimum(np.pi * aperture[:, None] ** 2 / (2 * radius) ** 2, 1.0)
    enough = (electrons[:, None] * surface < accuracy.background * noise) & (lost * covered < accuracy.flux)
    enough[:, -1] = True
    # A point has no light beyond the PSF's plane.
    enough[~is_galaxy, int(np.searchsorted(SIZES, SIDE)) :] = True
    return np.asarray(SIZES[np.argmax(enough, axis=1)])


def draw(
    sources: Sources,
    sizes: Int,
    psf: Psf,
    nx: int,
    ny: int,
    progress: Callable[[int], None] | None = None,
) -> Float:
    """Expected electrons of the sources alone.

    sizes    : int[n] from stamp_sizes
    progress : called now and then with the number of sources drawn
    returns  : float64[ny, nx]
    """
    frame = np.zeros((ny, nx))
    planes: dict[int, _Plane] = {}
    oversampling = _oversampling(psf)
    for i in range(len(sources)):
        size = int(sizes[i])
        if size not in planes:
            planes[size] = _plane(psf, size, oversampling)
        _draw_one(frame, sources, i, planes[size], psf.pixel_scale)
        if progress is not None and i % 100 == 0:
            progress(i)
    return frame


@dataclass(frozen=True, slots=True)
class _Plane:
    """The k grid of a stamp size and what PSF and pixel pass on it.

    kx, ky   : radian / pixel, [m / 2 + 1], [m], m = size * oversampling
    transfer : complex[m, m / 2 + 1]
    scratch  : a galsim image of the same grid
    """

    size: int
    kx: Float
    ky: Float
    transfer: Complex
    scratch: galsim.Image


def _plane(psf: Psf, size: int, oversampling: int) -> _Plane:
    half = size * oversampling // 2
    step = 2 * np.pi / size
    bounds = galsim.BoundsI(0, half, -half, half - 1)
    scratch = galsim.ImageCD(bounds, scale=step)
    _k_image(psf.profile.dilate(1.0 / psf.pixel_scale), scratch)
    kx, ky = np.arange(half + 1.0) * step, np.arange(-half, float(half)) * step
    pixel = np.sinc(ky / (2 * np.pi))[:, None] * np.sinc(kx / (2 * np.pi))[None, :]
    return _Plane(size, kx, ky, scratch.array * pixel, scratch)


def _k_image(profile: galsim.GSObject, image: galsim.Image) -> None:
    # The half plane is all that a real image needs; galsim's public call draws both halves.
    profile._drawKImage(image)


def _oversampling(psf: Psf) -> int:
    """1 where nothing passes beyond the Nyquist frequency, else 2."""
    profile = psf.profile.dilate(1.0 / psf.pixel_scale)
    beyond = max(abs(profile.kValue(k, 0.0)) for k in np.linspace(np.pi, 1.25 * np.pi, 4))
    beyond = max(beyond, max(abs(profile.kValue(0.0, k)) for k in np.linspace(np.pi, 1.25 * np.pi, 4)))
    return 2 if beyond > _BAND_LIMIT else 1


def _draw_one(frame: Float, sources: Sources, i: int, plane: _Plane, pixel_scale: float) -> None:
    x0 = int(np.rint(sources.column[i])) - plane.size // 2
    y0 = int(np.rint(sources.row[i])) - plane.size // 2
    phase_x = np.exp(-1j * plane.kx * (sources.column[i] - x0))
    phase_y = np.exp(-1j * plane.ky * (sources.row[i] - y0)) * sources.electrons[i]
    k_image = plane.transfer * phase_y[:, None]
    k_image *= phase_x
    if sources.shape[i] >= 0:
        smallest = _POINT_RADIUS * pixel_scale
        profile = profiles.profile(sources.shapes, int(sources.shape[i]), smallest)
        _k_image(_on_pixels(profile, sources.jacobian[i]), plane.scratch)
        k_image *= plane.scratch.array
    _add(frame, _image(k_image, plane.size), x0, y0)


def _on_pixels(profile: galsim.GSObject, jacobian: Float) -> galsim.GSObject:
    """World frame, arcsec -> pixels, the flux kept."""
    return galsim.JacobianWCS(*jacobian.ravel()).toImage(profile)


def _image(k_image: Complex, size: int) -> Float:
    """Inverse transform of a half plane (rows ky ascending), wrapped onto the pixels' own Nyquist zone."""
    half = size // 2
    if len(k_image) == size:
        zone = scipy.fft.ifftshift(k_image, axes=0)
    else:
        # Rows ky and ky + 2 pi land on one; so do columns kx and kx - 2 pi, the latter known from its mirror
        # image.
        folded = k_image[:size] + k_image[size:]
        mirrored = np.conj(np.roll(folded[::-1], 1, axis=0)[:, size : half - 1 : -1])
        zone = folded[:, : half + 1] + mirrored
    return np.asarray(scipy.fft.irfft2(zone, s=(size, size), overwrite_x=True))


def _add(frame: Float, stamp: Float, x0: int, y0: int) -> None:
    ny, nx = frame.shape
    left, right = max(x0, 0), min(x0 + stamp.shape[1], nx)
    bottom, top = max(y0, 0), min(y0 + stamp.shape[0], ny)
    if left < right and bottom < top:
        frame[bottom:top, left:right] += stamp[bottom - y0 : top - y0, left - x0 : right - x0]


def reference(sources: Sources, i: int, psf: Psf, size: int, accuracy: float = 1e-4) -> Float:
    """Source i by galsim.Convolve and drawImage, tight thresholds: slow, with none of `draw`'s transforms.

    returns : float64[size, size], lower left pixel at round(position) - size / 2
    """
    settings = galsim.GSParams(
        folding_threshold=accuracy, maxk_threshold=accuracy, kvalue_accuracy=1e-7, maximum_fft_size=16384
    )
    parts = [psf.profile.dilate(1.0 / psf.pixel_scale), galsim.Pixel(1.0)]
    if sources.shape[i] >= 0:
        profile = profiles.profile(sources.shapes, int(sources.shape[i]), _POINT_RADIUS * psf.pixel_scale)
        parts.append(_on_pixels(profile, sources.jacobian[i]))
    whole = galsim.Convolve(parts, gsparams=settings) * float(sources.electrons[i])
    x0, y0 = (int(np.rint(position[i])) - size // 2 for position in (sources.column, sources.row))
    centre = galsim.PositionD(sources.column[i] - x0, sources.row[i] - y0)
    image = galsim.ImageD(galsim.BoundsI(0, size - 1, 0, size - 1), scale=1.0)
    whole.drawImage(image, center=centre, method="no_pixel")
    return np.asarray(image.array)
