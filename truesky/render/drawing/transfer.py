"""What passes a PSF and the pixels: transfer functions on the Fourier grids of stamps.

basis_weights what each source takes of the PSF's planes: its colour, its place on the detector
plane_count   how many there are
passing       how much passes at most, by frequency
folding       how much less may be left out where pixels are coarse
grid          the samples of a stamp's half plane inside a disc, in the order in which the kernel takes them
transfer      all planes of a PSF on such a grid
collapsed     the one of a single source
image_of      its image
sheared_spectrum  of a plane, in coordinates that a row rises in
profile_of    the same as a galsim object, for the reference
"""

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

# radian / pixel between the samples of `passing`: those of a stamp of 32 pixels.
STEP = 2 * np.pi / 32
# What passes less than this in single precision passes nothing; in double precision that is less than this.
NEGLIGIBLE, NEGLIGIBLE_DOUBLE = 1e-7, 1e-14
# Frequencies beyond this are not looked at through a PSF without planes, which has no last frequency: two and a half
# times the Nyquist frequency; of bright sources four times.
HIGHEST, _HIGHEST_BRIGHT = 2.5 * np.pi, 4.0 * np.pi
# Samples that the kernel takes together: their planes stay in the cache.
_PIECE_SAMPLES = 1024
# A PSF, pixel included, of fewer pixels FWHM passes so much beyond half a cycle a pixel that what is left out there
# folds onto the frequencies that sizes and shapes are measured at; and the part that may still be left out. Chosen on
# 144 sources through NISP's PSF in Y and H: their R2 is then wrong by 1.2e-4 at the most, their ellipticity by 3.7e-5
# (3.2e-4, 1.7e-4 with all of it), in no more time.
_COARSE, _FOLDING = 1.3, 0.1
# Stamp that `passing` is measured on, pixels.
_PROBE = 64


def basis_weights(psf: Psf, photons: Float | None, column: Float, row: Float) -> Float:
    """float64[n, planes]: the share of each plane of `transfer` in each source's PSF.

    photons     : [n, w] fraction of its photons in each sub-band; None: flat f_nu
    column, row : [n] pixels
    psf         : of the detector
    """
    planes, n = psf.planes, len(column)
    if planes is None:
        return np.ones((n, 1))
    waves = planes.wavelength
    if photons is None:
        photons = np.full((n, len(waves)), 1.0 / len(waves))
    # Of neighbouring sub-bands the PSF may have one plane.
    photons = photons.reshape(n, len(waves), photons.shape[1] // len(waves)).sum(axis=2)
    # Beyond the border the polynomial is held.
    x = np.clip((column - planes.half[0]) / (planes.half[0] + 0.5), -1.0, 1.0)
    y = np.clip((row - planes.half[1]) / (planes.half[1] + 0.5), -1.0, 1.0)
    redder = matrices.matmul(photons, waves) - waves.mean()
    drift = [x**i * y**j * redder**colour for i, j, colour in planes.powers]
    return np.column_stack([photons, *drift])


@dataclass(frozen=True, slots=True)
class Grid:
    """The samples of a stamp's Fourier half plane inside a disc, and of its aliases: s samples, in pieces of runs.

    A sample lies at (ix, iy) times 2 pi / size radian / pixel and adds to the half plane's place (iy, ix) modulo
    size. Runs are of samples with one iy and consecutive ix; pieces are whole runs of about one |k|, which a source
    that reaches less far leaves out.

    kx, ky : float32[s] radian / pixel
    runs   : int64[r + 1, 3] first sample, its ix, its iy; the last is s
    pieces : int64[p + 1] first run
    inner  : float64[p] smallest |k|, radian / pixel
    """

    size: int
    kx: Float32
    ky: Float32
    runs: Int
    pieces: Int
    inner: Float


@dataclass(frozen=True, slots=True)
class Transfer:
    """PSF times pixel on a grid: planes float[b, 2, s], real and imaginary parts."""

    grid: Grid
    planes: Array


def grid(size: int, reach: float) -> Grid:
    """Samples of a stamp of `size` pixels at |k| <= reach, radian / pixel."""
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
    # A piece is full after so many samples, or at the end of its shell.
    start = first[np.searchsorted(shell, shell)]
    part = (first - start) // _PIECE_SAMPLES + shell * (samples // _PIECE_SAMPLES + 1)
    pieces = np.concatenate([[0], np.flatnonzero(np.diff(part)) + 1]).astype(np.int64)
    length = np.diff(first)
    along = np.arange(samples) - np.repeat(first[:-1] - ix[:-1], length)
    kx, ky = (step * along).astype(np.float32), np.repeat((step * iy[:-1]).astype(np.float32), length)
    inner = np.asarray(shell[pieces[:-1]] * (reach / shells), float)
    return Grid(size, kx, ky, np.ascontiguousarray(runs[:, :3]), pieces, inner)


def plane_count(psf: Psf) -> int:
    """How many planes `transfer` has."""
    return 1 if psf.planes is None else len(psf.planes.images) + len(psf.planes.drift)


def max_transfer(psf: Psf, min_value: float = NEGLIGIBLE) -> Float:
    """float64[m]: the largest modulus of PSF times pixel at k = i STEP radian / pixel; less than `least` beyond.

    least : below NOTHING of a PSF without planes, for what is drawn in double precision
    """
    bright = min_value < NEGLIGIBLE
    probe = grid(_PROBE, _HIGHEST_BRIGHT if bright else psf.planes.max_frequency if psf.planes else HIGHEST)
    if psf.planes is None:
        planes = _planes(psf, probe, np.float64 if bright else np.float32)
    else:
        # A smooth edge: a sharp one passes some of every frequency.
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
    """Of the Fourier samples that may be left out of a source, the part that may be through this PSF."""
    return _FOLDING if psf.fwhm < _COARSE * psf.pixel_scale else 1.0


def transfer(psf: Psf, size: int, reach: float) -> Transfer:
    """All planes of a PSF for stamps of `size` pixels, single precision, up to |k| = reach."""
    stamp_grid = grid(size, reach)
    return Transfer(stamp_grid, _planes(psf, stamp_grid, np.float32))


def source_transfer(psf: Psf, weights: Float, stamp_grid: Grid, dtype: type[Any], fading: bool = False) -> Transfer:
    """One plane: a source's own PSF, for large stamps or in double precision (float64).

    weights : [planes] from basis_weights;  fading : towards its border, into what far_light.py draws
    psf     : of the detector;  some : the stamp's Fourier grid;  dtype : of the plane
    """
    if psf.planes is None:
        return Transfer(stamp_grid, _planes(psf, stamp_grid, dtype))
    samples = psf.planes.samples
    image = _sum_planes(psf.planes, weights, samples * stamp_grid.size).astype(dtype)
    if fading:
        # A stamp may be wider than the plane, for a trail.
        window = far_light.fading_window(psf.side, samples, len(image))
        image *= window[:, None] * window
    return Transfer(stamp_grid, _on_grid([image], samples, stamp_grid, psf.intra_pixel, dtype))


def profile_of(psf: Psf, weights: Float) -> Any:
    """A source's own PSF as a galsim object, arcsec."""
    if psf.planes is None:
        return psf.profile
    return galsim_profile(image_of(psf.planes, weights), psf.pixel_scale / psf.planes.samples, exact=True)


def image_of(planes: Planes, weights: Float) -> Float32:
    """A source's own PSF in the planes' samples."""
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
    """The wings that come into a stamp at its edges leave its middle for its edges: no light is lost.

    Harmonics of the stamp, one (cos u + cos v) + both cos u cos v, are added that cancel them in the middle to second
    order in u, v = 2 pi x / size, 2 pi y / size.
    spectrum : of spectrum_of
    """
    axis_distance, diagonal_step = size / 8.0, size / 8.0 / np.sqrt(2.0)
    middle = _image_light(psf, size, 0.0, 0.0)
    off = 0.5 * (_image_light(psf, size, axis_distance, 0.0) + _image_light(psf, size, diagonal_step, diagonal_step))
    # The images' light is middle + slope (u^2 + v^2).
    slope = (off - middle) / (2 * np.pi / 8.0) ** 2
    axis_amplitude, product_amplitude = -middle - 2.0 * slope, middle + 4.0 * slope
    for iy in (-1, 0, 1):
        for ix in (0, 1):
            if ix or iy:
                spectrum[iy, ix] += size**2 * (product_amplitude / 4.0 if ix and iy else axis_amplitude / 2.0)


def _image_light(psf: Psf, size: int, x: float, y: float) -> float:
    """Of a star's light, that of its images in the stamps about, two deep, in a pixel at (x, y) from its middle."""
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
    """The pixel's transfer function at |iy|, |ix|; strength : of its response, 0 = even all over, None = 1."""
    step = 2 * np.pi / stamp_grid.size
    columns, rows = (
        np.arange(round(float(np.abs(k).max(initial=0.0)) / step) + 1) for k in (stamp_grid.kx, stamp_grid.ky)
    )
    if strength is None:
        return np.ones((len(rows), len(columns)))
    return intra_pixel.apply(columns / stamp_grid.size, rows[:, None] / stamp_grid.size, strength)


def _sum_planes(planes: Planes, weights: Float, side: int) -> Float32:
    """The planes' sum, cut to `side` samples or one more."""
    images, drift = _middle(planes.images, side), _middle(planes.drift, side)
    image = np.zeros(images.shape[1:], np.float32)
    margin = (len(image) - drift.shape[1]) // 2
    fourier.add_planes(image, images, weights[: len(images)], 0)
    fourier.add_planes(image, drift, weights[len(images) :], margin)
    return image


def _middle(images: Float32, side: int) -> Float32:
    """The middle of square planes [b, s, s], `side` samples or one more."""
    margin = max((images.shape[1] - side) // 2, 0)
    return images[:, margin : images.shape[1] - margin, margin : images.shape[2] - margin]


def spectrum(image: Array, period: int, columns: int) -> Array:
    """Fourier transform of a plane on the grid of a stamp of `period` samples: complex[period, columns], the first.

    A plane is cut to the stamp: its wings beyond would otherwise come in at the opposite edge. Rows and columns that
    are empty, or not asked for, are not transformed.
    """
    image = _middle(image[None], period)[0]
    lines = scipy.fft.rfft(_from_middle(image, period, 1), axis=1)[:, :columns]
    return np.asarray(scipy.fft.fft(_from_middle(lines, period, 0), axis=0, overwrite_x=True))


def sheared_spectrum(image: Array, period: int, columns: int, shear: float) -> Array:
    """The same of an image in coordinates u = x, v = y - shear x, transposed: complex[period, columns], v's first."""
    image = _middle(image[None], period)[0]
    middle = np.arange(image.shape[1]) - image.shape[1] // 2
    lines = scipy.fft.rfft(_from_middle(image, period, 0), axis=0)[:columns]
    if shear != 0.0:
        turn = (2 * np.pi * shear / period) * np.arange(len(lines))[:, None] * middle
        lines = lines * np.exp(1j * turn).astype(lines.dtype)
    return np.asarray(scipy.fft.fft(_from_middle(lines, period, 1), axis=1, overwrite_x=True).T)


def _from_middle(image: Array, period: int, axis: int) -> Array:
    """Filled up to the period along an axis, the middle first; of one too many the last is added to the first."""
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
