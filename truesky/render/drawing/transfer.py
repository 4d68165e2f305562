"""Transfer functions of the PSF and the pixel on the Fourier grids of stamps."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import scipy.fft
from scipy.ndimage import maximum

from lake_schema.arrays import Array, Float, Float32, Int
from truesky.numerics import matrices
from truesky.render.drawing import far_light
from truesky.render.drawing.kernels import fourier
from truesky.render.effects.light import intra_pixel
from truesky.render.psf.model import SIDE, Planes, Psf, galsim_profile, profile_spectrum

# Spacing of the samples of `max_transfer`, radian / pixel: the frequency step of a stamp of 32 pixels.
STEP = 2 * np.pi / 32
# Transfer functions below this are negligible, in single and in double precision.
NEGLIGIBLE, NEGLIGIBLE_DOUBLE = 1e-7, 1e-14
# A PSF without planes has no last frequency. It is followed up to 2.5 times the Nyquist frequency, and up to 4 times
# for bright sources.
HIGHEST, _HIGHEST_BRIGHT = 2.5 * np.pi, 4.0 * np.pi
# Number of samples that the kernel processes together, so that their planes stay in the cache.
_PIECE_SAMPLES = 1024
# A PSF, including the pixel, with a FWHM below the first number of pixels is coarsely sampled: samples neglected above
# the Nyquist frequency alias onto the frequencies of sizes and shapes. Only the second fraction of the usual limit may
# then be neglected. It was chosen for 144 sources with NISP's PSF in Y and H: errors of R2 are at most 1.2e-4, errors
# of the ellipticity at most 3.7e-5 (3.2e-4 and 1.7e-4 with the usual limit), without more CPU time.
_COARSE, _FOLDING = 1.3, 0.1
# Side of the stamp on which `max_transfer` is measured, pixels.
_PROBE = 64


def basis_weights(psf: Psf, photons: Float | None, column: Float, row: Float) -> Float:
    """Weights of the PSF's planes for each source, from its colour and its position on the detector.

    Parameters
    ----------
    psf : Psf
        PSF of the detector.
    photons : float array, shape (n, w), or None
        Fraction of the source's photons in each sub-band; None for flat f_nu.
    column, row : float array, shape (n,)
        Positions, pixels.

    Returns
    -------
    float array, shape (n, planes)
        Weights of the planes of `transfer`.
    """
    planes, n = psf.planes, len(column)
    if planes is None:
        return np.ones((n, 1))
    waves = planes.wavelength
    if photons is None:
        photons = np.full((n, len(waves)), 1.0 / len(waves))
    # Neighbouring sub-bands may share one plane of the PSF.
    photons = photons.reshape(n, len(waves), photons.shape[1] // len(waves)).sum(axis=2)
    # Beyond the border of the detector, the polynomial is constant.
    x = np.clip((column - planes.half[0]) / (planes.half[0] + 0.5), -1.0, 1.0)
    y = np.clip((row - planes.half[1]) / (planes.half[1] + 0.5), -1.0, 1.0)
    redder = matrices.matmul(photons, waves) - waves.mean()
    drift = [x**i * y**j * redder**colour for i, j, colour in planes.powers]
    return np.column_stack([photons, *drift])


@dataclass(frozen=True, slots=True)
class Grid:
    """Samples of a stamp's Fourier half plane inside a disc, and of its aliases: s samples, in pieces of runs.

    Attributes
    ----------
    size : int
        Side of the stamp, pixels.
    kx, ky : float32 array, shape (s,)
        Frequencies, radian / pixel.
    runs : int array, shape (r + 1, 3)
        First sample, its ix and its iy for each run; the last row contains s.
    pieces : int array, shape (p + 1,)
        First run of each piece.
    inner : float array, shape (p,)
        Smallest |k| in the piece, radian / pixel.

    Notes
    -----
    A sample lies at (ix, iy) times 2 pi / size radian / pixel and is added to the half plane at (iy, ix) modulo size. A
    run contains samples with one iy and consecutive ix. A piece contains whole runs with similar |k|, and is omitted
    for sources with a smaller reach.
    """

    size: int
    kx: Float32
    ky: Float32
    runs: Int
    pieces: Int
    inner: Float


@dataclass(frozen=True, slots=True)
class Transfer:
    """Product of the transforms of PSF and pixel on a grid.

    Attributes
    ----------
    grid : Grid
        The samples.
    planes : float array, shape (b, 2, s)
        Real and imaginary parts of each plane.
    """

    grid: Grid
    planes: Array


def grid(size: int, reach: float) -> Grid:
    """Samples of a stamp of `size` pixels with |k| <= reach, in radian / pixel."""
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
    # A piece ends after _PIECE_SAMPLES samples, or at the end of its shell.
    start = first[np.searchsorted(shell, shell)]
    part = (first - start) // _PIECE_SAMPLES + shell * (samples // _PIECE_SAMPLES + 1)
    pieces = np.concatenate([[0], np.flatnonzero(np.diff(part)) + 1]).astype(np.int64)
    length = np.diff(first)
    along = np.arange(samples) - np.repeat(first[:-1] - ix[:-1], length)
    kx, ky = (step * along).astype(np.float32), np.repeat((step * iy[:-1]).astype(np.float32), length)
    inner = np.asarray(shell[pieces[:-1]] * (reach / shells), float)
    return Grid(size, kx, ky, np.ascontiguousarray(runs[:, :3]), pieces, inner)


def plane_count(psf: Psf) -> int:
    """Number of planes of `transfer`."""
    return 1 if psf.planes is None else len(psf.planes.images) + len(psf.planes.drift)


def max_transfer(psf: Psf, min_value: float = NEGLIGIBLE) -> Float:
    """Largest modulus of the transforms of PSF times pixel at |k| = i STEP radian / pixel.

    Parameters
    ----------
    psf : Psf
        PSF of the detector.
    min_value : float
        The result ends where the modulus is smaller than this. Values below NEGLIGIBLE are for double precision and a
        PSF without planes.

    Returns
    -------
    float array
        The moduli.
    """
    bright = min_value < NEGLIGIBLE
    probe = grid(_PROBE, _HIGHEST_BRIGHT if bright else psf.planes.max_frequency if psf.planes else HIGHEST)
    if psf.planes is None:
        planes = _planes(psf, probe, np.float64 if bright else np.float32)
    else:
        # The window has a smooth edge, since a sharp edge contains all frequencies.
        samples = psf.planes.samples
        window = np.hanning(samples * _PROBE + 1).astype(np.float32)
        middle = _middle(psf.planes.images, samples * _PROBE)
        planes = _on_grid(list(middle * window[:, None] * window), samples, probe, psf.intra_pixel, np.float32)
    modulus = np.hypot(planes[:, 0], planes[:, 1]).max(axis=0)
    ring = (np.hypot(probe.kx, probe.ky) / STEP).astype(int)
    rings = np.asarray(maximum(modulus, ring, np.arange(ring.max() + 1)), float)
    above_minimum = np.flatnonzero(rings > min_value)
    return rings[: above_minimum[-1] + 1]


def neglect_factor(psf: Psf) -> float:
    """Factor of the negligible Fourier samples of a source for this PSF: below 1 if the pixels are coarse."""
    return _FOLDING if psf.fwhm < _COARSE * psf.pixel_scale else 1.0


def transfer(psf: Psf, size: int, reach: float) -> Transfer:
    """All planes of a PSF for stamps of one size, in single precision.

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
        The planes.
    """
    stamp_grid = grid(size, reach)
    return Transfer(stamp_grid, _planes(psf, stamp_grid, np.float32))


def source_transfer(psf: Psf, weights: Float, stamp_grid: Grid, dtype: type[Any], fading: bool = False) -> Transfer:
    """Transfer function of one source, for large stamps or for double precision.

    Parameters
    ----------
    psf : Psf
        PSF of the detector.
    weights : float array, shape (planes,)
        Weights of `basis_weights`.
    stamp_grid : Grid
        Fourier grid of the stamp.
    dtype : type
        Data type of the plane, float32 or float64.
    fading : bool
        True to fade the PSF towards its border, where far_light.py draws the rest.

    Returns
    -------
    Transfer
        One plane.
    """
    if psf.planes is None:
        return Transfer(stamp_grid, _planes(psf, stamp_grid, dtype))
    samples = psf.planes.samples
    image = _sum_planes(psf.planes, weights, samples * stamp_grid.size).astype(dtype)
    if fading:
        # The stamp of a trail may be wider than the plane.
        window = far_light.fading_window(psf.side, samples, len(image))
        image *= window[:, None] * window
    return Transfer(stamp_grid, _on_grid([image], samples, stamp_grid, psf.intra_pixel, dtype))


def profile_of(psf: Psf, weights: Float) -> Any:
    """PSF of a source with given weights of the planes, as a galsim object in arcsec."""
    if psf.planes is None:
        return psf.profile
    return galsim_profile(image_of(psf.planes, weights), psf.pixel_scale / psf.planes.samples, exact=True)


def image_of(planes: Planes, weights: Float) -> Float32:
    """PSF of a source with given weights, in the samples of the planes."""
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

    The added harmonics of the stamp, a (cos u + cos v) + b cos u cos v with u, v = 2 pi x / size, 2 pi y / size, cancel
    the wings in the middle to second order. The spectrum is that of `profile_spectrum`, changed in place.
    """
    axis_distance, diagonal_step = size / 8.0, size / 8.0 / np.sqrt(2.0)
    middle = _image_light(psf, size, 0.0, 0.0)
    off = 0.5 * (_image_light(psf, size, axis_distance, 0.0) + _image_light(psf, size, diagonal_step, diagonal_step))
    # The light of the images is middle + slope (u^2 + v^2).
    slope = (off - middle) / (2 * np.pi / 8.0) ** 2
    axis_amplitude, product_amplitude = -middle - 2.0 * slope, middle + 4.0 * slope
    for iy in (-1, 0, 1):
        for ix in (0, 1):
            if ix or iy:
                spectrum[iy, ix] += size**2 * (product_amplitude / 4.0 if ix and iy else axis_amplitude / 2.0)


def _image_light(psf: Psf, size: int, x: float, y: float) -> float:
    """Light of a star's images in the two rings of stamps around its stamp, in a pixel at (x, y) from its middle."""
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
    """Transfer function [|iy|, |ix|] of the pixel; a strength of 0 is a uniform response, and None gives 1."""
    step = 2 * np.pi / stamp_grid.size
    columns, rows = (
        np.arange(round(float(np.abs(k).max(initial=0.0)) / step) + 1) for k in (stamp_grid.kx, stamp_grid.ky)
    )
    if strength is None:
        return np.ones((len(rows), len(columns)))
    return intra_pixel.apply(columns / stamp_grid.size, rows[:, None] / stamp_grid.size, strength)


def _sum_planes(planes: Planes, weights: Float, side: int) -> Float32:
    """Weighted sum of the planes, cut to `side` samples or one more."""
    images, drift = _middle(planes.images, side), _middle(planes.drift, side)
    image = np.zeros(images.shape[1:], np.float32)
    margin = (len(image) - drift.shape[1]) // 2
    fourier.add_planes(image, images, weights[: len(images)], 0)
    fourier.add_planes(image, drift, weights[len(images) :], margin)
    return image


def _middle(images: Float32, side: int) -> Float32:
    """Middle of square planes [b, s, s], with `side` samples or one more."""
    margin = max((images.shape[1] - side) // 2, 0)
    return images[:, margin : images.shape[1] - margin, margin : images.shape[2] - margin]


def spectrum(image: Array, period: int, columns: int) -> Array:
    """Fourier transform of a plane on the grid of a stamp.

    Parameters
    ----------
    image : array, shape (s, s)
        The plane.
    period : int
        Side of the stamp, samples.
    columns : int
        Number of columns of the result.

    Returns
    -------
    complex array, shape (period, columns)
        The first columns of the transform.

    Notes
    -----
    The plane is cut to the stamp, since its wings would otherwise be aliased. Rows and columns that are empty, or not
    needed, are not transformed.
    """
    image = _middle(image[None], period)[0]
    lines = scipy.fft.rfft(_from_middle(image, period, 1), axis=1)[:, :columns]
    return np.asarray(scipy.fft.fft(_from_middle(lines, period, 0), axis=0, overwrite_x=True))


def sheared_spectrum(image: Array, period: int, columns: int, shear: float) -> Array:
    """Fourier transform of a plane in the coordinates u = x, v = y - shear x, transposed.

    Parameters
    ----------
    image : array, shape (s, s)
        The plane.
    period : int
        Side of the stamp, samples.
    columns : int
        Number of columns of the result.
    shear : float
        Shear of the coordinates.

    Returns
    -------
    complex array, shape (period, columns)
        Frequencies of u in rows, and the first frequencies of v in columns.
    """
    image = _middle(image[None], period)[0]
    middle = np.arange(image.shape[1]) - image.shape[1] // 2
    lines = scipy.fft.rfft(_from_middle(image, period, 0), axis=0)[:columns]
    if shear != 0.0:
        turn = (2 * np.pi * shear / period) * np.arange(len(lines))[:, None] * middle
        lines = lines * np.exp(1j * turn).astype(lines.dtype)
    return np.asarray(scipy.fft.fft(_from_middle(lines, period, 1), axis=1, overwrite_x=True).T)


def _from_middle(image: Array, period: int, axis: int) -> Array:
    """Pad an axis to the period and roll its middle to index 0; a surplus last sample is added to the first."""
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
