"""Images of sources in the light of a few wavelengths, as spline coefficients: what is spread along a trace.

The PSF at a wavelength is sum_b l_b(lambda) PSF_b, l_b the Lagrange polynomials of a few nodes.  Of a stamp of N
pixels, periodic, the image through each PSF_b,

    I_b(x, y) = 1 / N^2 sum_k profile(k) PSF_b(k) pixel(k) exp(i k r),

is wanted at any place, not at the pixels alone.  It is held by ox samples a pixel along the columns and oy across,
unfolded (all |kx| <= pi ox, |ky| <= pi oy), as coefficients of splines: I = sum_j C_j B5(ox x - j) B3(oy y - j), so
that C(k) = ox oy I(k) / (sinc(f / ox)^6 sinc(fy / oy)^4), f = k / 2 pi, and no resolution is lost to the splines.
The quintic spline lies along the trace, of slope s: f = fx + s fy.

Where traces are straight the image is held in coordinates in which they are rows, u = x and v = y - s x: then
kx = ku - s kv, ky = kv, and f = fu.  What is summed along u is put in its place across at once, column by column.

Nodes, nodes       wavelengths of the PSFs, and the share of each at any wavelength
Planes, planes     PSF times pixel over splines, for stamps of a size
Bodies, bodies     profiles of sources, in such coordinates
coefficients       of sources
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import lru_cache

import numpy as np
import scipy.fft
from scipy.ndimage import uniform_filter1d

from lake_schema.arrays import Array, Bool, Float, Float32, Int
from truesky.numerics import matrices
from truesky.render.dispersing import kernels
from truesky.render.drawing import arcs, transfer
from truesky.render.psf.model import Psf
from truesky.render.sources import galaxy_shapes, sersic
from truesky.render.sources.source_list import Sources

# Degrees of the splines along and across.
ALONG, ACROSS = 5, 3
# Cycles a sample: beyond, next to nothing passes the PSF, and is not divided by next to nothing.
_FARTHEST = 0.6


def nodes(first: float, last: float, count: int) -> Float:
    """float64[count] A: Chebyshev's, where the largest error of Lagrange's polynomials between is least."""
    angle = np.pi * (2 * np.arange(count)[::-1] + 1) / (2 * count)
    return np.asarray(0.5 * (first + last) + 0.5 * (last - first) * np.cos(angle))


def shares(wavelength: Float, at: Float) -> Float:
    """float64[n, b]: Lagrange's polynomials of nodes `at` [b] at wavelengths [n]; each row sums to 1."""
    out = np.ones((len(wavelength), len(at)))
    for b in range(len(at)):
        for other in range(len(at)):
            if other != b:
                out[:, b] *= (wavelength - at[other]) / (at[b] - at[other])
    return out


@dataclass(frozen=True, slots=True)
class Sampling:
    """n pixels of a stamp's side, even; samples a pixel along and across; slope of the trace, rows a column.

    straight : in coordinates in which the trace is a row
    step     : of the detector's pixels in a pixel of the stamp, which then has a cubic spline's coefficient
    split    : pixels; of the smooth part of an image and of the rest, of which the smooth part is drawn with a step
               above 1; 0 = of the whole image
    """

    n: int
    along: int
    across: int
    slope: float = 0.0
    straight: bool = False
    step: int = 1
    split: float = 0.0

    @property
    def shear(self) -> float:
        """Rows by which a row of the image rises in a column of the detector."""
        return self.slope if self.straight else 0.0

    @property
    def rows(self) -> tuple[float, float]:
        """(slope, shear)."""
        return self.slope, self.shear

    @property
    def shape(self) -> tuple[int, int, int]:
        """(n, along, across)."""
        return self.n, self.along, self.across


@dataclass(frozen=True, slots=True)
class Planes:
    """PSF times pixel over splines on a stamp's Fourier grid.

    ku, kv : float32[rows], float32[columns] radian / pixel
    planes : complex64[p, rows, columns], of all planes of the PSF
    """

    sampling: Sampling
    ku: Float32
    kv: Float32
    planes: Array


def planes(psf: Psf, sampling: Sampling) -> Planes:
    """Of a PSF with planes, whose wavelengths are the nodes."""
    assert psf.planes is not None
    n, count = sampling.n, sampling.n * sampling.along
    iu, iv = scipy.fft.fftfreq(count, 1.0 / count).astype(int), np.arange(n * sampling.across // 2 + 1)
    fu, fy = iu[:, None] / n, iv / n
    fx, step = fu - sampling.shear * fy, sampling.step
    on_trace = np.clip(fx + sampling.slope * fy, -_FARTHEST * sampling.along, _FARTHEST * sampling.along)
    spline = np.sinc(on_trace / sampling.along) ** (ALONG + 1) * np.sinc(fy / sampling.across) ** (ACROSS + 1)
    # The stamp's middle is at sample n / 2 of each axis.
    sign = (-1.0) ** iu[:, None] * (-1.0) ** iv
    factor = sampling.along * sampling.across * np.sinc(fx / step) * np.sinc(fy / step) * sign / spline
    factor *= _split(sampling, fx / step, fy / step)
    if step > 1:
        factor /= _spline_transfer(fx) * _spline_transfer(fy)
    # Of the lowest frequencies alone the PSF's pixels tell as much as its samples.
    fold = psf.planes.samples if step > 1 and psf.planes.samples % 2 else 1
    factor /= _bin_transfer(fx / step, fold) * _bin_transfer(fy / step, fold)
    images = [*psf.planes.images, *psf.planes.drift]
    images = [_bin_pixels(image, fold) for image in images] if fold > 1 else images
    spectra = np.empty((len(images), count, len(iv)), np.complex64)
    for image, out in zip(images, spectra, strict=True):
        passed = transfer.sheared_spectrum(image, psf.planes.samples // fold * n * step, len(iv), sampling.shear)
        out[:] = passed[iu] * factor
    ku, kv = ((2 * np.pi * f / step).astype(np.float32) for f in (fu[:, 0], fy))
    return Planes(sampling, ku, kv, spectra)


def _bin_pixels(image: Float32, fold: int) -> Float32:
    """An image [n, n], n odd, on pixels of fold x fold samples, odd, one of them about its middle: triangles' sums."""
    middle = len(image) // 2
    count = -(-middle // fold)
    padded = np.pad(image, fold * count + fold // 2 - middle)
    for axis in (0, 1):
        padded = uniform_filter1d(padded, fold, axis, mode="constant")
    return np.asarray(padded.reshape(2 * count + 1, fold, 2 * count + 1, fold).sum(axis=(1, 3)))


def _bin_transfer(f: Float, fold: int) -> Float:
    """What such sums leave of f cycles a pixel: of what is beyond half a cycle little folds onto the lowest."""
    return np.asarray((np.sinc(f) / np.sinc(f / fold)) ** 2)


def _spline_transfer(f: Float) -> Float:
    """Of f cycles a pixel: what a cubic spline is at the pixels, of its coefficients there."""
    return np.asarray((2.0 + np.cos(2 * np.pi * f)) / 3.0)


def _split(sampling: Sampling, fx: Float, fy: Float) -> Float:
    """The share of the smooth part, or of the rest, by cycles a pixel.

    The smooth part is the image behind 2 g - g^2, g a Gaussian of `split` pixels. The rest, behind (1 - g)^2, is the
    fourth derivative of the image where that is smooth on this scale: next to nothing far from the middle.
    """
    if sampling.split == 0.0:
        return np.ones(())
    rest = np.expm1(-2.0 * (np.pi * sampling.split) ** 2 * (fx**2 + fy**2)) ** 2
    return np.asarray(rest if sampling.step == 1 else 1.0 - rest)


@dataclass(frozen=True, slots=True)
class Profiles:
    """Profiles of n sources, as kernels.zones takes them.

    body     : bool[n] False for a point;  fraction : float64[n] of the light in the bulge
    bulge, disk, thick : [n, 2, 2], [n, 2, 2], [n, 2] of galaxy_shapes.Forms
    row, row_weights   : int64[n], float64[n, 4] of sersic.row_of
    """

    body: Bool
    fraction: Float
    bulge: Float
    disk: Float
    thick: Float
    row: Int
    row_weights: Float

    def take(self, selected: Int) -> Profiles:
        """Some of them."""
        return Profiles(*(getattr(self, field.name)[selected] for field in fields(self)))


def source_profiles(sources: Sources, shear: float) -> Profiles:
    """Of sources, in coordinates whose rows rise by `shear` rows a column."""
    n, body = len(sources), sources.shape >= 0
    shapes = sources.shapes.take(sources.shape[body])
    form = galaxy_shapes.forms(shapes, shear_jacobian(sources.jacobian[body], shear))
    fraction, row, weights = np.zeros(n), np.zeros(n, np.int64), np.zeros((n, 4))
    bulge, disk, thick = np.zeros((n, 2, 2)), np.zeros((n, 2, 2)), np.zeros((n, 2))
    fraction[body], bulge[body], disk[body], thick[body] = shapes.bulge_fraction, form.bulge, form.disk, form.thick
    row[body], weights[body] = sersic.interpolation_weights(shapes.sersic_index)
    return Profiles(body, fraction, bulge, disk, thick, row, weights)


def shear_jacobian(jacobian: Float, shear: float) -> Float:
    """[.., 2, 2] arcsec by (u, v) of arcsec by pixels."""
    return np.asarray(matrices.matmul(jacobian, np.array([[1.0, 0.0], [shear, 1.0]])), float)


def spread_transform(stamp_planes: Planes, sources: Sources, i: int) -> Array | None:
    """[rows, columns] transform of a picture, or of a trail, over which source i's light is spread; None: nothing."""
    picture, trail, shear = sources.picture_of(i), sources.trail, stamp_planes.sampling.shear
    if picture is None and (trail is None or not trail[i].any()):
        return None
    ku, kv = np.broadcast_arrays(stamp_planes.ku[:, None], stamp_planes.kv)
    if picture is not None:
        picture_transform = arcs.transform(picture, shear_jacobian(sources.jacobian[i], shear), ku.ravel(), kv.ravel())
        return np.asarray(picture_transform.reshape(ku.shape).astype(np.complex64))
    assert trail is not None
    across, up = float(trail[i, 0]), float(trail[i, 1] - shear * trail[i, 0])
    return np.asarray(np.sinc((ku * across + kv * up) / (2 * np.pi)).astype(np.float32))


@lru_cache(maxsize=1)
def _sersic() -> Float32:
    return sersic.table()


def coefficients(stamp_planes: Planes, weights: Float, profiles: Profiles, transforms: list[Array | None]) -> Float32:
    """float32[m, b, n along, n across] of kernels.spread: of m sources of one electron.

    some : the planes;  weights : [m, b, p] of them, for each node;  of : the sources
    over : what each is spread over, of `spread_over`
    """
    zones = np.empty((*weights.shape[:2], *stamp_planes.planes.shape[1:]), np.complex64)
    kernels.zones(
        stamp_planes.planes,
        weights.astype(np.float32),
        stamp_planes.ku,
        stamp_planes.kv,
        profiles.body,
        profiles.fraction,
        profiles.bulge,
        profiles.disk,
        profiles.thick,
        _sersic(),
        profiles.row,
        profiles.row_weights,
        zones,
    )
    for part, transform in zip(zones, transforms, strict=True):
        if transform is not None:
            part *= transform
    n, along, across = stamp_planes.sampling.n, stamp_planes.sampling.along, stamp_planes.sampling.across
    return np.asarray(scipy.fft.irfft2(zones, s=(n * along, n * across), overwrite_x=True))
