"""Images of sources at a few wavelengths, as spline coefficients, from which slitless spectra are drawn.

The PSF at the wavelength lambda is sum_b l_b(lambda) PSF_b. Here PSF_b is the PSF at the b-th of a few wavelengths
(nodes), and l_b the Lagrange polynomial of this node. A stamp is a periodic square image of N x N pixels around a
source. On it, the image through PSF_b at the position r = (x, y), in pixels from the source, is::

    I_b(x, y) = 1 / N^2 sum_k profile(k) PSF_b(k) pixel(k) exp(i k r)

The sum is over the frequencies k = (kx, ky) in radian per pixel. profile(k), PSF_b(k) and pixel(k) are the Fourier
transforms of the source's light profile, of PSF_b and of a detector pixel.

The image is needed at any position, not only at pixels. It is stored with ox samples per pixel along x (columns) and oy
along y (rows), without aliasing (all |kx| <= pi ox, |ky| <= pi oy). The stored values are coefficients C of the
B-splines B5 and B3, of degrees 5 and 3::

    I(x, y) = sum_ij C_ij B5(ox x - i) B3(oy y - j)
    C(k) = ox oy I(k) / (sinc(f / ox)^6 sinc(fy / oy)^4),   (fx, fy) = k / (2 pi),   sinc(a) = sin(pi a) / (pi a)

The division by the transforms of the splines cancels their smoothing. The quintic spline lies along the trace of a
spectrum, whose slope is s rows per column. Therefore its frequency is f = fx + s fy.

For straight traces the image is stored in the coordinates u = x and v = y - s x, in which the traces are rows. With
frequencies ku and kv along u and v, kx = ku - s kv, ky = kv and f = ku / (2 pi). The light of all wavelengths is first
summed along u. Then each column is moved to the row at which the trace crosses it.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import lru_cache

import numpy as np
import scipy

from lake_schema.arrays import Array, Bool, Float, Float32, Int
from truesky.numerics import matrices
from truesky.render.dispersing import kernels
from truesky.render.drawing import arcs, transfer
from truesky.render.psf.model import Psf
from truesky.render.sources import galaxy_shapes, sersic
from truesky.render.sources.source_list import Sources

# Degree of the spline along the trace of a spectrum.
ALONG = 5
# Degree of the spline across the trace of a spectrum.
ACROSS = 3
# Spatial frequency along the trace, cycles per sample of the image, beyond which the PSF passes little light. The
# transform of the image is divided by the transform of the spline. Beyond this frequency it is divided by the value at
# this frequency instead, to avoid a division by small numbers.
_FARTHEST = 0.6


def nodes(first: float, last: float, count: int) -> Float:
    """Return the wavelengths (Chebyshev nodes) at which the PSF is computed; at all others it is interpolated.

    Parameters
    ----------
    first, last : float
        Range of wavelengths, Angstrom.
    count : int
        Number of nodes.

    Returns
    -------
    float array, shape (count,)
        Wavelengths in increasing order, Angstrom. Lagrange interpolation between these nodes has nearly the smallest
        possible maximum error.
    """
    angle = np.pi * (2 * np.arange(count)[::-1] + 1) / (2 * count)
    return np.asarray(0.5 * (first + last) + 0.5 * (last - first) * np.cos(angle))


def shares(wavelength: Float, at: Float) -> Float:
    """Return the weights [n, b] that interpolate a function from b nodes to n wavelengths by a polynomial.

    `wavelength` are the n wavelengths, and `at` the b nodes in the same unit. The weights in column j are
    the Lagrange polynomial of the node `at[j]`. The sum of each row is 1. All nodes must differ, which is not checked.
    """
    out = np.ones((len(wavelength), len(at)))
    for b in range(len(at)):
        for other in range(len(at)):
            if other != b:
                out[:, b] *= (wavelength - at[other]) / (at[b] - at[other])
    return out


@dataclass(frozen=True, slots=True)
class Sampling:
    """Size and sampling of a stamp, the periodic square image of a source from which its spectrum is drawn.

    Attributes
    ----------
    n : int
        Side of the stamp, pixels; even.
    along, across : int
        Samples per pixel along and across the trace of the spectrum.
    slope : float
        Slope of the trace, rows per column.
    straight : bool
        True if the image is stored in sheared coordinates, in which the trace is a row.
    step : int
        Width of a pixel of the stamp in detector pixels. If it is above 1, the spectrum drawn with these coarse pixels
        is not the light in them, but coefficients of a cubic spline, which is evaluated at the detector's pixels.
    split : float
        Rms, in detector pixels, of the Gaussian filter that separates the image of a large galaxy into a smooth part
        and the sharp rest. If it is positive, a stamp with a `step` above 1 contains the smooth part, and a stamp with
        a `step` of 1 the rest. With 0 a stamp contains the whole image.
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
        """Slope of the stamp's rows relative to the detector's rows, in rows per column; 0 unless `straight`."""
        return self.slope if self.straight else 0.0

    @property
    def rows(self) -> tuple[float, float]:
        """Slopes of the trace (`slope`) and of the stamp's rows (`shear`) on the detector, in rows per column."""
        return self.slope, self.shear

    @property
    def shape(self) -> tuple[int, int, int]:
        """Side of the stamp in pixels, and samples per pixel along and across the trace (`n`, `along`, `across`)."""
        return self.n, self.along, self.across


@dataclass(frozen=True, slots=True)
class Planes:
    """Fourier transforms of the PSF's basis images (planes), with which the images of sources are computed.

    The PSF of a source is a weighted sum of the p basis images. Their transforms are multiplied by the transform of a
    detector pixel, and divided by that of the B-splines of which the images of sources consist.

    Attributes
    ----------
    sampling : Sampling
        Size and sampling of the stamps (square images of sources) for which the transforms were computed.
    ku, kv : float32 array, shape (rows,) and (columns,)
        Frequencies of the rows of `planes` (along the detector's columns axis x, or along the trace in sheared
        coordinates) and of its columns (along y), radian per detector pixel.
    planes : complex64 array, shape (p, rows, columns)
        Transforms of all basis images.
    """

    sampling: Sampling
    ku: Float32
    kv: Float32
    planes: Array


def planes(psf: Psf, sampling: Sampling) -> Planes:
    """Return the Fourier transforms of a PSF's basis images for stamps (images of sources) of one size and sampling.

    The PSF must consist of images (`psf.planes`) at the wavelengths that the function `nodes` returns.
    """
    assert psf.planes is not None
    n, count = sampling.n, sampling.n * sampling.along
    iu, iv = scipy.fft.fftfreq(count, 1.0 / count).astype(int), np.arange(n * sampling.across // 2 + 1)
    fu, fy = iu[:, None] / n, iv / n
    fx, step = fu - sampling.shear * fy, sampling.step
    on_trace = np.clip(fx + sampling.slope * fy, -_FARTHEST * sampling.along, _FARTHEST * sampling.along)
    spline = np.sinc(on_trace / sampling.along) ** (ALONG + 1) * np.sinc(fy / sampling.across) ** (ACROSS + 1)
    # In Fourier space, the factors (-1)^frequency index move the source from sample 0 to the middle sample of each
    # axis.
    sign = (-1.0) ** iu[:, None] * (-1.0) ** iv
    factor = sampling.along * sampling.across * np.sinc(fx / step) * np.sinc(fy / step) * sign / spline
    factor *= _split(sampling, fx / step, fy / step)
    if step > 1:
        factor /= _spline_transfer(fx) * _spline_transfer(fy)
    # A stamp whose pixels are wider than the detector's contains only the lowest frequencies. For these it is
    # sufficient to bin the PSF images from several samples per pixel to one, which saves time.
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
    """Bin an image [n, n] to pixels of `fold` x `fold` samples, centred on its middle sample; n and `fold` must be odd.

    The weights are triangular along each axis: samples up to one pixel from the middle of a pixel contribute to it.
    """
    middle = len(image) // 2
    count = -(-middle // fold)
    padded = np.pad(image, fold * count + fold // 2 - middle)
    for axis in (0, 1):
        padded = scipy.ndimage.uniform_filter1d(padded, fold, axis, mode="constant")
    return np.asarray(padded.reshape(2 * count + 1, fold, 2 * count + 1, fold).sum(axis=(1, 3)))


def _bin_transfer(f: Float, fold: int) -> Float:
    """Return by what factor `_bin_pixels` multiplies the Fourier transform of an image, along one axis.

    `f` are frequencies in cycles per binned pixel, and `fold` the number of samples that are binned. The factor is
    valid for low frequencies, because it neglects light that the binning aliases from higher ones.
    """
    return np.asarray((np.sinc(f) / np.sinc(f / fold)) ** 2)


def _spline_transfer(f: Float) -> Float:
    """Return the ratio of the Fourier transforms of a cubic spline's values at pixels and of its coefficients.

    The ratio is that of one axis. `f` are frequencies along this axis in cycles per pixel.
    """
    return np.asarray((2.0 + np.cos(2 * np.pi * f)) / 3.0)


def _split(sampling: Sampling, fx: Float, fy: Float) -> Float:
    """Return the factor by which a Fourier transform is multiplied to get the smooth or the sharp part of an image.

    `fx` and `fy` are frequencies in cycles per detector pixel. The factor of the smooth part is 2 g - g^2, where g is
    the transform of a Gaussian with an rms of `sampling.split` pixels. The factor of the sharp rest is (1 - g)^2. If
    the image is smooth on this scale, the rest is proportional to its fourth derivative. The rest is therefore
    negligible far from the middle of a galaxy. The smooth part is selected if `sampling.step` is above 1, otherwise the
    rest. If `sampling.split` is 0, the factor is 1.
    """
    if sampling.split == 0.0:
        return np.ones(())
    rest = np.expm1(-2.0 * (np.pi * sampling.split) ** 2 * (fx**2 + fy**2)) ** 2
    return np.asarray(rest if sampling.step == 1 else 1.0 - rest)


@dataclass(frozen=True, slots=True)
class Profiles:
    """Light profiles (Sersic bulge and exponential disc) of n sources; all numbers are 0 for point sources.

    Below, k is a wave vector in radian per pixel, and `@` a product of vector and matrix.

    Attributes
    ----------
    body : bool array, shape (n,)
        True for galaxies, False for point sources.
    fraction : float array, shape (n,)
        Fraction of the light in the bulge.
    bulge, disk : float array, shape (n, 2, 2)
        Matrices whose columns are vectors along the major and minor axis of the bulge and of the disc, pixels. Their
        lengths are the half-light radius of the bulge, or the scale length of the disc, along these axes. The Fourier
        transform of the bulge (disc) depends only on the length of k @ matrix.
    thick : float array, shape (n, 2)
        Vectors, pixels, that describe the thickness of inclined discs. With q = k @ vector, the transform of the disc
        has the factor q / sinh(q).
    row : int array, shape (n,)
        First of the four rows, in the table of Fourier transforms of Sersic profiles, from which the transform of the
        bulge is interpolated.
    row_weights : float array, shape (n, 4)
        Interpolation weights of these four rows.
    """

    body: Bool
    fraction: Float
    bulge: Float
    disk: Float
    thick: Float
    row: Int
    row_weights: Float

    def take(self, selected: Int) -> Profiles:
        """Return the profiles of the sources with the indices `selected`, in this order."""
        return Profiles(*(getattr(self, field.name)[selected] for field in fields(self)))


def source_profiles(sources: Sources, shear: float) -> Profiles:
    """Return the light profiles of sources in sheared coordinates u = x and v = y - `shear` * x.

    x and y are the columns and rows of the detector, in pixels. `shear` is the slope of traces in rows per column.
    """
    n, body = len(sources), sources.shape >= 0
    shapes = sources.shapes.take(sources.shape[body])
    form = galaxy_shapes.forms(shapes, shear_jacobian(sources.jacobian[body], shear))
    fraction, row, weights = np.zeros(n), np.zeros(n, np.int64), np.zeros((n, 4))
    bulge, disk, thick = np.zeros((n, 2, 2)), np.zeros((n, 2, 2)), np.zeros((n, 2))
    fraction[body], bulge[body], disk[body], thick[body] = shapes.bulge_fraction, form.bulge, form.disk, form.thick
    row[body], weights[body] = sersic.interpolation_weights(shapes.sersic_index)
    return Profiles(body, fraction, bulge, disk, thick, row, weights)


def shear_jacobian(jacobian: Float, shear: float) -> Float:
    """Return the Jacobian [..., 2, 2] from sheared pixel coordinates to the sky, in arcsec per pixel.

    The sheared coordinates are u = x and v = y - `shear` * x, where x is the column and y the row. `jacobian` is the
    Jacobian for (x, y): arcsec to the west and north (rows) for a step of one column and one row (columns).
    """
    return np.asarray(matrices.matmul(jacobian, np.array([[1.0, 0.0], [shear, 1.0]])), float)


def spread_transform(stamp_planes: Planes, sources: Sources, i: int) -> Array | None:
    """Return the Fourier transform of a source's picture (given image) or of the trail of a moving source.

    The caller multiplies the Fourier transform of the PSF by it, to get the image of the source.

    Parameters
    ----------
    stamp_planes : Planes
        Transforms of the PSF; their frequencies are used.
    sources : Sources
        List of sources.
    i : int
        Index of the source in the list.

    Returns
    -------
    array, shape (rows, columns), or None
        Transform of the picture (complex64), or of the trail of a moving source (float32). None for a source at rest
        without a picture.
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
def sersic_table() -> Float32:
    """Return the Fourier transforms of Sersic profiles, one row per Sersic index, from `sersic.table`."""
    return sersic.table()


def coefficients(stamp_planes: Planes, weights: Float, profiles: Profiles, transforms: list[Array | None]) -> Float32:
    """Return the images of m sources, each of one electron, as spline coefficients.

    `spreading.spread` draws slitless spectra with these images.

    Parameters
    ----------
    stamp_planes : Planes
        Fourier transforms of the PSF's p basis images, for stamps (square images of sources) of one size.
    weights : float array, shape (m, b, p)
        Weights of the p basis images in the PSF of each source, at each of b wavelengths (nodes).
    profiles : Profiles
        Bulge and disc profiles of the sources.
    transforms : list of array or None
        For each source, the transform of its picture (of a lensed galaxy) or trail (of a moving body), which
        `spread_transform` computes, or None.

    Returns
    -------
    float32 array, shape (m, b, n s_a, n s_c)
        Coefficients for each source and node. The stamp has n pixels per side, with s_a samples per pixel along the
        trace and s_c across it (`stamp_planes.sampling`).
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
        sersic_table(),
        profiles.row,
        profiles.row_weights,
        zones,
    )
    for part, transform in zip(zones, transforms, strict=True):
        if transform is not None:
            part *= transform
    n, along, across = stamp_planes.sampling.n, stamp_planes.sampling.along, stamp_planes.sampling.across
    return np.asarray(scipy.fft.irfft2(zones, s=(n * along, n * across), overwrite_x=True))
