"""Fourier transforms of the PSF and the pixel (transfer functions) on the frequency grids of stamps.

A stamp is a square image around one source. A PSF is given either as planes, which are images, or as one profile. The
PSF of a source is a weighted sum of the planes, with weights that depend on its colour and its position.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import scipy

from lake_schema.arrays import Array, Float, Float32, Int
from truesky.numerics import matrices
from truesky.render.drawing import far_light
from truesky.render.drawing.kernels import fourier
from truesky.render.psf import pixel_response
from truesky.render.psf.model import SIDE, Planes, Psf, galsim_profile, profile_spectrum

# Width in radian / pixel of the intervals of |k| in which `max_transfer` finds the largest value of the PSF's Fourier
# transform. It is the spacing of the frequencies of a stamp of 32 pixels.
STEP = 2 * np.pi / 32
# Transfer functions (Fourier transforms of the PSF and the pixel) below this value are negligible in single precision.
NEGLIGIBLE = 1e-7
# Transfer functions (Fourier transforms of the PSF and the pixel) below this value are negligible in double precision.
NEGLIGIBLE_DOUBLE = 1e-14
# Largest |k| for a PSF that is given as a profile, radian / pixel: 2.5 times the Nyquist frequency. A PSF given as
# sampled images has a last frequency, but a profile has none.
HIGHEST = 2.5 * np.pi
# Largest |k| for bright sources if the PSF is given as a profile, radian / pixel: 4 times the Nyquist frequency.
_HIGHEST_BRIGHT = 4.0 * np.pi
# Approximate number of Fourier samples of a stamp that are processed together, so that they stay in the cache of the
# processor.
_PIECE_SAMPLES = 1024
# Pixels are coarse if the FWHM of the PSF, including the pixel, is below this number of pixels. Fourier samples above
# the Nyquist frequency are then aliased onto the frequencies that determine the sizes and shapes of sources.
_COARSE = 1.3
# With coarse pixels (PSF narrower than 1.3 pixels), the limit below which Fourier samples of a source are neglected is
# multiplied by this factor. The value was chosen for 144 sources with NISP's PSF in Y and H. Relative errors of the
# size R2 are at most 1.2e-4, and errors of the ellipticity at most 3.7e-5 (3.2e-4 and 1.7e-4 with the usual limit),
# without more CPU time.
_FOLDING = 0.1
# Side, in pixels, of the stamp on which the Fourier transform of the PSF is computed to find the |k| beyond which it is
# negligible (`max_transfer`).
_PROBE = 64
# Largest size of the transforms for one size of stamps that are kept for other images with the same PSF, bytes. It
# suffices for all stamps of VIS.
_KEPT_BYTES = 1e8


def basis_weights(psf: Psf, photons: Float | None, column: Float, row: Float) -> Float:
    """Return the weights of the PSF's planes (basis images) for n sources, from their colours and positions.

    Parameters
    ----------
    psf : Psf
        PSF of the detector.
    photons : float array, shape (n, w), or None
        Fraction of the source's photons in each of w sub-bands of the passband. w must be a multiple of the number of
        wavelengths of the PSF. None for equal fractions, as for a source with constant f_nu.
    column, row : float array, shape (n,)
        Positions on the drawn image, 0-based pixels. Positions outside the detector are treated as on its border.

    Returns
    -------
    float array, shape (n, planes)
        Weights in the order of the planes of `transfer`; 1 for a PSF without planes.
    """
    planes, n = psf.planes, len(column)
    if planes is None:
        return np.ones((n, 1))
    waves = planes.wavelength
    if photons is None:
        photons = np.full((n, len(waves)), 1.0 / len(waves))
    # The PSF may have fewer wavelengths than there are sub-bands. The photons of neighbouring sub-bands that share one
    # image of the PSF are added.
    photons = photons.reshape(n, len(waves), photons.shape[1] // len(waves)).sum(axis=2)
    # The PSF varies as a polynomial of the position. Outside the detector it is kept at its value on the border.
    x, y = (
        np.clip((position + first - half) / (half + 0.5), -1.0, 1.0)
        for position, first, half in zip((column, row), planes.origin, planes.half, strict=True)
    )
    redder = matrices.matmul(photons, waves) - waves.mean()
    drift = [x**i * y**j * redder**colour for i, j, colour in planes.powers]
    return np.column_stack([photons, *drift])


@dataclass(frozen=True, slots=True)
class Grid:
    """List of s frequencies at which the Fourier transform of a stamp is computed, in an order that is fast to process.

    They lie in a disc about k = 0 that may exceed the Nyquist frequency. They cover the half plane from which a real
    image is computed, and all frequencies that are aliased onto this half plane.

    Attributes
    ----------
    size : int
        Side of the stamp, pixels.
    kx, ky : float32 array, shape (s,)
        Frequencies, radian / pixel.
    runs : int array, shape (r + 1, 3)
        For each of r runs: index of the first sample, and ix and iy of this sample. The last row begins with s.
    pieces : int array, shape (p + 1,)
        Index of the first run of each of p pieces, and r at the end.
    inner : float array, shape (p,)
        Lower limit of |k| in each piece, radian / pixel.

    Notes
    -----
    A sample lies at (ix, iy) times 2 pi / size radian / pixel and is added to the half plane at (iy, ix) modulo size. A
    run is a sequence of samples with one iy and consecutive ix. A piece is a sequence of runs with similar |k|. A
    source whose transform is negligible from some |k| on omits the pieces beyond this |k|.
    """

    size: int
    kx: Float32
    ky: Float32
    runs: Int
    pieces: Int
    inner: Float


@dataclass(frozen=True, slots=True)
class Transfer:
    """Product of the Fourier transforms of PSF and pixel, at the frequencies of a grid.

    Attributes
    ----------
    grid : Grid
        The s frequencies.
    planes : float array, shape (b, 2, s)
        Real and imaginary parts for each of the b planes (basis images) of the PSF, or for one PSF with b = 1.
    """

    grid: Grid
    planes: Array


def grid(size: int, reach: float) -> Grid:
    """Return the frequency grid of a stamp with a side of `size` pixels, up to |k| = `reach` radian / pixel."""
    return _cached_grid(size, reach) if size <= SIDE else _grid(size, reach)


@lru_cache(maxsize=32)
def _cached_grid(size: int, reach: float) -> Grid:
    return _grid(size, reach)


def _grid(size: int, reach: float) -> Grid:
    step = 2 * np.pi / size
    shells = max(size // 16, 4)
    count, samples = fourier.runs(size, reach / step, shells, np.zeros((0, 4), np.int64))
    runs = np.zeros((count + 1, 4), np.int64)
    fourier.runs(size, reach / step, shells, runs)
    runs[-1] = samples, 0, 0, shells
    first, ix, iy, shell = runs.T
    # The disc of frequencies is divided into rings of equal width (shells). The samples of a ring are divided into
    # pieces of about _PIECE_SAMPLES samples.
    start = first[np.searchsorted(shell, shell)]
    part = (first - start) // _PIECE_SAMPLES + shell * (samples // _PIECE_SAMPLES + 1)
    pieces = np.concatenate([[0], np.flatnonzero(np.diff(part)) + 1]).astype(np.int64)
    length = np.diff(first)
    along = np.arange(samples) - np.repeat(first[:-1] - ix[:-1], length)
    kx, ky = (step * along).astype(np.float32), np.repeat((step * iy[:-1]).astype(np.float32), length)
    inner = np.asarray(shell[pieces[:-1]] * (reach / shells), float)
    return Grid(size, kx, ky, np.ascontiguousarray(runs[:, :3]), pieces, inner)


def plane_count(psf: Psf) -> int:
    """Return the number of planes (basis images) of a PSF, 1 for a PSF that is given as a profile."""
    return 1 if psf.planes is None else len(psf.planes.images) + len(psf.planes.drift)


def max_transfer(psf: Psf, min_value: float = NEGLIGIBLE) -> Float:
    """Return the largest modulus of the transform of PSF times pixel, in all directions, as a function of |k|.

    Parameters
    ----------
    psf : Psf
        PSF of the detector.
    min_value : float
        The result ends with the last interval of |k| in which the modulus exceeds this value. The value may be below
        NEGLIGIBLE only for a PSF without planes (basis images); the transform is then computed in double precision.

    Returns
    -------
    float array, shape (i,)
        Element i is the largest modulus of all planes for |k| from i STEP to (i + 1) STEP radian / pixel.
    """
    if min_value != NEGLIGIBLE:
        # This value differs between images.
        return _max_transfer(psf, min_value)
    return psf.keep(("max transfer",), lambda: _max_transfer(psf, min_value))


def _max_transfer(psf: Psf, min_value: float) -> Float:
    bright = min_value < NEGLIGIBLE
    probe = grid(_PROBE, _HIGHEST_BRIGHT if bright else psf.planes.max_frequency if psf.planes else HIGHEST)
    if psf.planes is None:
        planes = _planes(psf, probe, np.float64 if bright else np.float32)
    else:
        # The planes are cut to the stamp by a window with a smooth edge, since a sharp edge contains all frequencies.
        samples = psf.planes.samples
        window = np.hanning(samples * _PROBE + 1).astype(np.float32)
        middle = _middle(psf.planes.images, samples * _PROBE)
        planes = _on_grid(list(middle * window[:, None] * window), samples, probe, psf.intra_pixel, np.float32)
    modulus = np.hypot(planes[:, 0], planes[:, 1]).max(axis=0)
    ring = (np.hypot(probe.kx, probe.ky) / STEP).astype(int)
    rings = np.zeros(ring.max() + 1)
    np.maximum.at(rings, ring, modulus.astype(float))
    above_minimum = np.flatnonzero(rings > min_value)
    return rings[: above_minimum[-1] + 1]


def neglect_factor(psf: Psf) -> float:
    """Return the factor for the limit below which Fourier samples of a source are neglected: 1, or 0.1.

    It is 0.1 for coarse pixels, where the FWHM of the PSF is below 1.3 pixels. The neglected samples at high
    frequencies would then be aliased onto low frequencies, which determine sizes and shapes.
    """
    return _FOLDING if psf.fwhm < _COARSE * psf.pixel_scale else 1.0


def transfer(psf: Psf, size: int, reach: float) -> Transfer:
    """Return the transforms of all planes (basis images) of a PSF for stamps of one size, in single precision.

    Parameters
    ----------
    psf : Psf
        PSF of the detector.
    size : int
        Side of the stamps, pixels.
    reach : float
        Largest |k|, radian / pixel.

    Returns
    -------
    Transfer
        The transforms times that of the pixel, in the order of the weights of `basis_weights`.
    """
    stamp_grid = grid(size, reach)

    def compute() -> Transfer:
        return Transfer(stamp_grid, _planes(psf, stamp_grid, np.float32))

    is_small = plane_count(psf) * 8.0 * len(stamp_grid.kx) <= _KEPT_BYTES
    return psf.keep(("transfer", size, reach), compute) if is_small else compute()


def source_transfer(psf: Psf, weights: Float, stamp_grid: Grid, dtype: type[Any], fading: bool = False) -> Transfer:
    """Return the transform of the PSF of one source times that of the pixel, for large stamps or double precision.

    Parameters
    ----------
    psf : Psf
        PSF of the detector.
    weights : float array, shape (planes,)
        Weights of the PSF's planes (basis images) for the source, from `basis_weights`.
    stamp_grid : Grid
        Fourier grid of the stamp.
    dtype : type
        Data type of the result, float32 or float64.
    fading : bool
        True to fade the PSF to 0 at its border. far_light.py then draws the light that is missing there. Has no effect
        for a PSF without planes.

    Returns
    -------
    Transfer
        The transform, as one plane.
    """
    if psf.planes is None:
        return Transfer(stamp_grid, _planes(psf, stamp_grid, dtype))
    samples = psf.planes.samples
    image = _sum_planes(psf.planes, weights, samples * stamp_grid.size).astype(dtype)
    if fading:
        # The stamp of a moving source may be wider than the PSF image. The window with which the PSF fades to 0
        # therefore has the size of the image.
        window = far_light.fading_window(psf.side, samples, len(image))
        image *= window[:, None] * window
    return Transfer(stamp_grid, _on_grid([image], samples, stamp_grid, psf.intra_pixel, dtype))


def profile_of(psf: Psf, weights: Float) -> Any:
    """Return the PSF of a source as a galsim object in arcsec; `weights` [planes] is a row of `basis_weights`."""
    if psf.planes is None:
        return psf.profile
    return galsim_profile(image_of(psf.planes, weights), psf.pixel_scale / psf.planes.samples, exact=True)


def image_of(planes: Planes, weights: Float) -> Float32:
    """Return the image of a source's PSF; `weights` [planes] is a row of `basis_weights`.

    The image has as many samples per detector pixel (`planes.samples`) as `planes.images`, and the same size.
    """
    return _sum_planes(planes, weights, planes.images.shape[1])


def _planes(psf: Psf, stamp_grid: Grid, dtype: type[Any]) -> Array:
    if psf.planes is None:
        step = 2 * np.pi / stamp_grid.size
        reach = int(np.rint(max(stamp_grid.kx.max(), -stamp_grid.kx.min(), stamp_grid.ky.max()) / step))
        out = np.empty((1, 2, len(stamp_grid.kx)), dtype)
        spectrum = profile_spectrum(psf, stamp_grid.size, reach)
        _move_wings_to_edges(spectrum, psf, stamp_grid.size)
        fourier.take_samples(spectrum, stamp_grid.runs, _pixel(stamp_grid, psf.intra_pixel), out[0])
        return out
    images = [*psf.planes.images, *psf.planes.drift]
    return _on_grid(images, psf.planes.samples, stamp_grid, psf.intra_pixel, dtype)


def _move_wings_to_edges(spectrum: Array, psf: Psf, size: int) -> None:
    """Move the aliased wings of the PSF from the middle of a stamp to its edges without loss of light.

    `spectrum` is the transform of the PSF from `profile_spectrum` and is changed in place. This adds low harmonics to
    the image: a (cos u + cos v) + b cos u cos v. Here u = 2 pi x / size and v = 2 pi y / size, for an offset (x, y) in
    pixels from the middle of the stamp, whose side has `size` pixels. The amplitudes a and b are chosen such that the
    harmonics cancel the aliased wings to second order in the middle; the sum of the harmonics over the stamp is 0.
    """
    axis_distance, diagonal_step = size / 8.0, size / 8.0 / np.sqrt(2.0)
    middle = _image_light(psf, size, 0.0, 0.0)
    off = 0.5 * (_image_light(psf, size, axis_distance, 0.0) + _image_light(psf, size, diagonal_step, diagonal_step))
    # Near the middle of the stamp, the aliased light is approximated by middle + slope (u^2 + v^2), with u = 2 pi x /
    # size and v = 2 pi y / size.
    slope = (off - middle) / (2 * np.pi / 8.0) ** 2
    axis_amplitude, product_amplitude = -middle - 2.0 * slope, middle + 4.0 * slope
    for iy in (-1, 0, 1):
        for ix in (0, 1):
            if ix or iy:
                spectrum[iy, ix] += size**2 * (product_amplitude / 4.0 if ix and iy else axis_amplitude / 2.0)


def _image_light(psf: Psf, size: int, x: float, y: float) -> float:
    """Return the aliased light of a star with flux 1 in a pixel at (x, y) pixels from the middle of its stamp.

    A stamp with a side of `size` pixels is repeated periodically. The result is the light of the 24 copies of the star
    in the two rings of stamps around its stamp.
    """
    steps = [n * size for n in range(-2, 3)]
    places = [(x - c, y - r) for r in steps for c in steps if r or c]
    light = [psf.profile.xValue(u * psf.pixel_scale, v * psf.pixel_scale) for u, v in places]
    return float(np.sum(light)) * psf.pixel_scale**2


def _on_grid(images: list[Array], samples: int, stamp_grid: Grid, strength: float | None, dtype: type[Any]) -> Array:
    out = np.empty((len(images), 2, len(stamp_grid.kx)), dtype)
    columns = int(np.rint(np.abs(stamp_grid.kx).max() * stamp_grid.size / (2 * np.pi))) + 1
    pixel = _pixel(stamp_grid, strength)
    for image, plane in zip(images, out, strict=True):
        fourier.take_samples(spectrum(image, samples * stamp_grid.size, columns), stamp_grid.runs, pixel, plane)
    return out


def _pixel(stamp_grid: Grid, strength: float | None) -> Float:
    """Return the Fourier transform [|iy|, |ix|] of the pixel's response, at all frequencies of a grid.

    `strength` is the loss of response at the pixel's edges relative to its centre, 0 for a uniform response. None means
    that the PSF already includes the pixel; the result is then 1 everywhere.
    """
    step = 2 * np.pi / stamp_grid.size
    columns, rows = (
        np.arange(round(float(np.abs(k).max(initial=0.0)) / step) + 1) for k in (stamp_grid.kx, stamp_grid.ky)
    )
    if strength is None:
        return np.ones((len(rows), len(columns)))
    return pixel_response.transform(columns / stamp_grid.size, rows[:, None] / stamp_grid.size, strength)


def _sum_planes(planes: Planes, weights: Float, side: int) -> Float32:
    """Return the PSF as the weighted sum of its planes (basis images), cut to the middle `side` or `side` + 1 samples.

    The number is chosen such that result and planes have the same middle. `weights` [planes] are the weights of the
    planes for one source, a row of `basis_weights`. Planes with fewer samples are not padded.
    """
    images, drift = _middle(planes.images, side), _middle(planes.drift, side)
    image = np.zeros(images.shape[1:], np.float32)
    margin = (len(image) - drift.shape[1]) // 2
    fourier.add_planes(image, images, weights[: len(images)], 0)
    fourier.add_planes(image, drift, weights[len(images) :], margin)
    return image


def _middle(images: Float32, side: int) -> Float32:
    """Return the middle part of square images [b, s, s], with a side of `side` or `side` + 1 samples.

    The side is chosen such that the part and the images have the same middle. Images with sides of at most `side`
    samples are returned unchanged.
    """
    margin = max((images.shape[1] - side) // 2, 0)
    return images[:, margin : images.shape[1] - margin, margin : images.shape[2] - margin]


def spectrum(image: Array, period: int, columns: int) -> Array:
    """Return the Fourier transform of an image of the PSF on the frequency grid of a stamp.

    Parameters
    ----------
    image : array, shape (s, s)
        Image of the PSF, or one of its planes (basis images), centred on the middle sample.
    period : int
        Side of the stamp, in samples of the image.
    columns : int
        Number of columns of the result, at most period // 2 + 1.

    Returns
    -------
    complex array, shape (period, columns)
        Transform [iy, ix] about the middle of the image, at (ix, iy) cycles per `period` samples. iy takes all values
        in the order of the FFT, and ix is 0 to `columns` - 1.

    Notes
    -----
    The image is cut to the stamp, since its wings would otherwise be aliased. Rows and columns that are empty, or not
    needed, are not transformed, to save time.
    """
    image = _middle(image[None], period)[0]
    lines = scipy.fft.rfft(_from_middle(image, period, 1), axis=1)[:, :columns]
    return np.asarray(scipy.fft.fft(_from_middle(lines, period, 0), axis=0, overwrite_x=True))


def sheared_spectrum(image: Array, period: int, columns: int, shear: float) -> Array:
    """Return the Fourier transform of an image of the PSF in sheared coordinates u = x, v = y - shear x.

    Parameters
    ----------
    image : array, shape (s, s)
        Image of the PSF, or one of its planes (basis images), centred on the middle sample.
    period : int
        Side of the stamp, in samples of the image.
    columns : int
        Number of columns of the result, at most period // 2 + 1.
    shear : float
        Shear of the coordinates, dimensionless; 0 for none.

    Returns
    -------
    complex array, shape (period, columns)
        Transform [iu, iv] about the middle of the image, at (iu, iv) cycles per `period` samples. iu takes all values
        in the order of the FFT, and iv is 0 to `columns` - 1.
    """
    image = _middle(image[None], period)[0]
    middle = np.arange(image.shape[1]) - image.shape[1] // 2
    lines = scipy.fft.rfft(_from_middle(image, period, 0), axis=0)[:columns]
    if shear != 0.0:
        turn = (2 * np.pi * shear / period) * np.arange(len(lines))[:, None] * middle
        lines = lines * np.exp(1j * turn).astype(lines.dtype)
    return np.asarray(scipy.fft.fft(_from_middle(lines, period, 1), axis=1, overwrite_x=True).T)


def _from_middle(image: Array, period: int, axis: int) -> Array:
    """Pad an axis of an image with zeros to `period` samples, and roll the middle of the image to index 0.

    If the image has one sample more than `period`, its first and last samples are summed into one.
    """
    shape = list(image.shape)
    shape[axis] = period
    out = np.zeros(shape, image.dtype)
    half = image.shape[axis] // 2
    if axis == 0:
        out[: len(image) - half] = image[half:]
        out[period - half :] += image[:half]
    else:
        out[:, : image.shape[1] - half] = image[:, half:]
        out[:, period - half :] += image[:, :half]
    return out
