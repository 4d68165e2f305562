"""Images of sources at a few wavelengths, as spline coefficients that can be spread along a trace.

The PSF at a wavelength is sum_b l_b(lambda) PSF_b, where l_b is the Lagrange polynomial of a few nodes. On a periodic
stamp of N pixels, the image through each PSF_b is::

    I_b(x, y) = 1 / N^2 sum_k profile(k) PSF_b(k) pixel(k) exp(i k r)

It is needed at any position, not only at pixels. It is stored with ox samples per pixel along the columns and oy
across, without aliasing (all |kx| <= pi ox, |ky| <= pi oy), as coefficients of splines::

    I = sum_j C_j B5(ox x - j) B3(oy y - j)
    C(k) = ox oy I(k) / (sinc(f / ox)^6 sinc(fy / oy)^4),   f = k / 2 pi

so that the splines do not reduce the resolution. The quintic spline lies along the trace, of slope s: f = fx + s fy.

For straight traces the image is stored in the coordinates u = x and v = y - s x, in which the traces are rows. Then
kx = ku - s kv, ky = kv and f = fu. Sums along u are moved to their position across the trace column by column.
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

# Degrees of the splines along and across the trace.
ALONG, ACROSS = 5, 3
# Frequency, in cycles per sample, beyond which the PSF passes little light. The spline's transform is constant beyond
# it, to avoid a division by small numbers.
_FARTHEST = 0.6


def nodes(first: float, last: float, count: int) -> Float:
    """Chebyshev nodes [count] between two wavelengths, for the smallest maximum error of Lagrange interpolation.

    Parameters
    ----------
    first, last : float
        Range of wavelengths, Angstrom.
    count : int
        Number of nodes.

    Returns
    -------
    float array, shape (count,)
        Wavelengths in increasing order, Angstrom.
    """
    angle = np.pi * (2 * np.arange(count)[::-1] + 1) / (2 * count)
    return np.asarray(0.5 * (first + last) + 0.5 * (last - first) * np.cos(angle))


def shares(wavelength: Float, at: Float) -> Float:
    """Lagrange polynomials [n, b] of nodes `at` [b] at wavelengths [n]; each row sums to 1."""
    out = np.ones((len(wavelength), len(at)))
    for b in range(len(at)):
        for other in range(len(at)):
            if other != b:
                out[:, b] *= (wavelength - at[other]) / (at[b] - at[other])
    return out


@dataclass(frozen=True, slots=True)
class Sampling:
    """Sampling of a stamp.

    Attributes
    ----------
    n : int
        Side of the stamp, pixels; even.
    along, across : int
        Samples per pixel, along and across the trace.
    slope : float
        Slope of the trace, rows per column.
    straight : bool
        True for coordinates in which the trace is a row.
    step : int
        Detector pixels per pixel of the stamp. If it is above 1, the pixels contain coefficients of a cubic spline.
    split : float
        Scale that separates the smooth part of an image from the rest, pixels. A step above 1 selects the smooth part,
        a step of 1 the rest; 0 selects the whole image.
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
        """Rise of a row of the image, in rows per column of the detector."""
        return self.slope if self.straight else 0.0

    @property
    def rows(self) -> tuple[float, float]:
        """Slope and shear."""
        return self.slope, self.shear

    @property
    def shape(self) -> tuple[int, int, int]:
        """Values of n, along and across."""
        return self.n, self.along, self.across


@dataclass(frozen=True, slots=True)
class Planes:
    """PSF times pixel divided by the splines, on a stamp's Fourier grid.

    Attributes
    ----------
    sampling : Sampling
        Sampling of the stamp.
    ku, kv : float32 array, shape (rows,) and (columns,)
        Frequencies, radian / pixel.
    planes : complex64 array, shape (p, rows, columns)
        All planes of the PSF.
    """

    sampling: Sampling
    ku: Float32
    kv: Float32
    planes: Array


def planes(psf: Psf, sampling: Sampling) -> Planes:
    """Planes for stamps of one sampling, for a PSF with planes whose wavelengths are the nodes."""
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
    # For the lowest frequencies, the PSF may be binned to pixels.
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
    """Bin an image [n, n] to pixels of fold x fold samples with triangular weights; n and fold are odd."""
    middle = len(image) // 2
    count = -(-middle // fold)
    padded = np.pad(image, fold * count + fold // 2 - middle)
    for axis in (0, 1):
        padded = uniform_filter1d(padded, fold, axis, mode="constant")
    return np.asarray(padded.reshape(2 * count + 1, fold, 2 * count + 1, fold).sum(axis=(1, 3)))


def _bin_transfer(f: Float, fold: int) -> Float:
    """Transfer function of this binning at f cycles per pixel; aliasing onto the lowest frequencies is small."""
    return np.asarray((np.sinc(f) / np.sinc(f / fold)) ** 2)


def _spline_transfer(f: Float) -> Float:
    """Transfer function, at f cycles per pixel, from the coefficients of a cubic spline to its values at the pixels."""
    return np.asarray((2.0 + np.cos(2 * np.pi * f)) / 3.0)


def _split(sampling: Sampling, fx: Float, fy: Float) -> Float:
    """Transfer function of the smooth part of an image or of the rest, by cycles per pixel.

    The smooth part is the image convolved with 2 g - g^2, where g is a Gaussian of `split` pixels. The rest, convolved
    with (1 - g)^2, is proportional to the fourth derivative of an image that is smooth on this scale, and is negligible
    far from the middle.
    """
    if sampling.split == 0.0:
        return np.ones(())
    rest = np.expm1(-2.0 * (np.pi * sampling.split) ** 2 * (fx**2 + fy**2)) ** 2
    return np.asarray(rest if sampling.step == 1 else 1.0 - rest)


@dataclass(frozen=True, slots=True)
class Profiles:
    """Profiles of n sources, as arguments of `kernels.zones`.

    Attributes
    ----------
    body : bool array, shape (n,)
        False for point sources.
    fraction : float array, shape (n,)
        Fraction of the light in the bulge.
    bulge, disk, thick : float array, shape (n, 2, 2), (n, 2, 2) and (n, 2)
        Matrices and vectors of `galaxy_shapes.Forms`.
    row, row_weights : array, shape (n,) and (n, 4)
        First row and weights from `sersic.interpolation_weights`.
    """

    body: Bool
    fraction: Float
    bulge: Float
    disk: Float
    thick: Float
    row: Int
    row_weights: Float

    def take(self, selected: Int) -> Profiles:
        """Return the selected profiles."""
        return Profiles(*(getattr(self, field.name)[selected] for field in fields(self)))


def source_profiles(sources: Sources, shear: float) -> Profiles:
    """Profiles of sources in coordinates whose rows rise by `shear` rows per column."""
    n, body = len(sources), sources.shape >= 0
    shapes = sources.shapes.take(sources.shape[body])
    form = galaxy_shapes.forms(shapes, shear_jacobian(sources.jacobian[body], shear))
    fraction, row, weights = np.zeros(n), np.zeros(n, np.int64), np.zeros((n, 4))
    bulge, disk, thick = np.zeros((n, 2, 2)), np.zeros((n, 2, 2)), np.zeros((n, 2))
    fraction[body], bulge[body], disk[body], thick[body] = shapes.bulge_fraction, form.bulge, form.disk, form.thick
    row[body], weights[body] = sersic.interpolation_weights(shapes.sersic_index)
    return Profiles(body, fraction, bulge, disk, thick, row, weights)


def shear_jacobian(jacobian: Float, shear: float) -> Float:
    """Convert a Jacobian [.., 2, 2] in arcsec per pixel to the sheared coordinates (u, v)."""
    return np.asarray(matrices.matmul(jacobian, np.array([[1.0, 0.0], [shear, 1.0]])), float)


def spread_transform(stamp_planes: Planes, sources: Sources, i: int) -> Array | None:
    """Transform [rows, columns] of the picture or trail of source `i`, or None for other sources.

    Parameters
    ----------
    stamp_planes : Planes
        Planes of the stamp.
    sources : Sources
        List of sources.
    i : int
        Number of the source.

    Returns
    -------
    array, shape (rows, columns), or None
        The transform.
    """
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
    """Spline coefficients of the images of m sources of one electron, for `spreading.spread`.

    Parameters
    ----------
    stamp_planes : Planes
        Planes of the stamps.
    weights : float array, shape (m, b, p)
        Weights of the planes for each node.
    profiles : Profiles
        Profiles of the sources.
    transforms : list of array or None
        Result of `spread_transform` for each source.

    Returns
    -------
    float32 array, shape (m, b, n along, n across)
        The coefficients.
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
