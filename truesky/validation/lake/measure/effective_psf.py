"""Measure fluxes of stars by fitting the effective PSF of the frame, which is built from its brighter stars.

The effective PSF is the fraction of a point source's light in a pixel, as a function of the pixel's offset (x, y) from
the source. It includes the response of the pixel and is represented by cubic splines.

References
----------
Anderson & King 2000, PASP 112, 1360 (effective PSF)
Stetson 1987, PASP 99, 191 (fitting)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solveh_banded

from lake_schema.arrays import Bool, Float
from truesky.validation.lake.measure.frames import Frame
from truesky.validation.lake.measure.stars import StarMeasurements

# Half of the side of the square around a star in which the PSF is defined, in FWHM.
_REACH = 2.0
# Half of the side of the square around a star in which the PSF is defined is at least this number of pixels.
_MIN_REACH = 3.0
# Number of knots, per FWHM of the stars, of the splines that represent the PSF.
_KNOTS = 4.0
# Smallest distance between knots of the splines that represent the PSF, pixels.
_FINEST = 1.0 / 3.0
# Weight, in the fit of the PSF, of the squared second differences of the spline coefficients, relative to the mean
# weight of the data on a coefficient. It makes the splines smooth.
_SMOOTH = 1e-5
# A PSF is not built from fewer bright stars than this number. A star with fewer good pixels than this number is not
# fitted.
MIN_STARS = 8
# Error of a pixel value due to differences between the PSFs of stars, as a fraction of the value.
_PSF_VARIATION = 0.03
# Smallest error of a pixel value when the PSF is built, as a fraction of the peak value.
_FLOOR = 3e-3
# Pixels that deviate from the fit by more than this number of standard deviations are rejected.
_OUTLIER = 5.0
# Number of iterations of the fit of a star's flux and position.
_ROUNDS = 5
# Half of the largest shift of a star's position in a fit, pixels.
_STEP = 0.3


@dataclass(frozen=True, slots=True)
class EffectivePsf:
    """Effective PSF: fraction of a point source's light in a pixel, as cubic splines of the pixel's offset (x, y).

    Attributes
    ----------
    coefficients : float array, shape (k, k)
        Spline coefficients, first axis along rows (y), second along columns (x).
    step : float
        Distance between knots, pixels.
    reach : float
        The PSF is defined for offsets from -reach to reach along both axes, pixels.
    """

    coefficients: Float
    step: float
    reach: float

    def evaluate(self, x: Float, y: Float) -> tuple[Float, Float, Float]:
        """Return the PSF and its derivatives with respect to x and y at offsets (pixels) from the source.

        All arrays have the shape (m,). Offsets outside the range of the PSF are extrapolated and not useful.
        """
        (i, first, rise), (j, second, climb) = (_basis(axis, self.step, self.reach) for axis in (x, y))
        coefficients = self.coefficients[j[:, :, None], i[:, None, :]]
        return (
            np.einsum("mji,mj,mi->m", coefficients, second, first),
            np.einsum("mji,mj,mi->m", coefficients, second, rise),
            np.einsum("mji,mj,mi->m", coefficients, climb, first),
        )


def _basis(x: Float, step: float, reach: float) -> tuple[np.ndarray, Float, Float]:
    """Return indices, values and derivatives of the four cubic B-splines that are not 0 at each x, shape (m, 4).

    Knots have the distance `step` and begin at -`reach`, in pixels.
    """
    place = (x + reach) / step
    first = np.clip(np.floor(place).astype(int), 0, _knots(step, reach) - 4)
    t = place - first
    value = np.stack([(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3], axis=1) / 6.0
    slope = np.stack([-((1 - t) ** 2), 3 * t**2 - 4 * t, -3 * t**2 + 2 * t + 1, t**2], axis=1) / (2.0 * step)
    return first[:, None] + np.arange(4), value, slope


def _knots(step: float, reach: float) -> int:
    return int(np.ceil(2.0 * reach / step)) + 3


def build(x: Float, y: Float, value: Float, weight: Float, fwhm: float) -> EffectivePsf:
    """Fit the effective PSF to pixels of several stars, and repeat the fit without outliers.

    Parameters
    ----------
    x, y : float array, shape (m,)
        Offset of each pixel from the position of its star, pixels.
    value : float array, shape (m,)
        Fraction of the star's light in each pixel.
    weight : float array, shape (m,)
        Inverse variance of each value.
    fwhm : float
        FWHM of the stars, pixels.

    Returns
    -------
    EffectivePsf
        The PSF. Its coefficients are NaN if the pixels do not determine them, and 0 without pixels.
    """
    step, reach = max(fwhm / _KNOTS, _FINEST), fit_radius(fwhm)
    k = _knots(step, reach)
    used = np.ones(len(value), bool)
    (i, first, _), (j, second, _) = (_basis(axis, step, reach) for axis in (x, y))
    index = (j[:, :, None] * k + i[:, None, :]).reshape(-1, 16)
    basis = (second[:, :, None] * first[:, None, :]).reshape(-1, 16)
    solution = np.zeros(k * k)
    for _ in range(2):
        if not used.any():
            break
        solution = _solve_coefficients(index[used], basis[used], value[used], weight[used], k)
        used = np.abs(value - (basis * solution[index]).sum(axis=1)) < _OUTLIER / np.sqrt(weight)
    return EffectivePsf(solution.reshape(k, k), step, reach)


def _solve_coefficients(index: np.ndarray, basis: Float, value: Float, weight: Float, k: int) -> Float:
    """Return the k^2 spline coefficients of a smoothed least-squares fit; all are NaN if the matrix is singular.

    `index` and `basis`, shape (m, 16), have the coefficients on which each pixel depends, and their factors. The sum of
    squared second differences of the coefficients is added with a small weight. The normal matrix is banded.
    """
    heavy, width = basis * weight[:, None], 3 * k + 3
    band = np.zeros((width + 1, k * k))
    for i in range(16):
        for j in range(16):
            lag = index[0, i] - index[0, j]
            if lag >= 0:
                band[lag] += np.bincount(index[:, j], heavy[:, i] * basis[:, j], k * k)
    smooth = _SMOOTH * band[0].mean()
    for step in (1, k):
        # Add the squares of a - 2 b + c for each three adjacent coefficients along rows, then along columns.
        middle = np.arange(k * k).reshape(k, k)
        first = (middle[:, :-2] if step == 1 else middle[:-2]).ravel()
        for i, a in enumerate((1.0, -2.0, 1.0)):
            for j, c in enumerate((1.0, -2.0, 1.0)[: i + 1]):
                band[(i - j) * step] += smooth * a * c * np.bincount(first + j * step, minlength=k * k)
    light = np.bincount(index.ravel(), (heavy * value[:, None]).ravel(), k * k)
    try:
        return np.asarray(solveh_banded(band, light, lower=True, check_finite=False))
    except np.linalg.LinAlgError:
        return np.full(k * k, np.nan)


def fit_radius(fwhm: float) -> float:
    """Return half of the side (pixels) of the square around a star in which the PSF is defined, for a FWHM in pixels.

    The square whose pixels are fitted is 0.6 pixels narrower on each side.
    """
    return max(_REACH * fwhm, _MIN_REACH)


def fit_fluxes(frame: Frame, measurements: StarMeasurements, total_light: Float, noise: float) -> tuple[Float, Float]:
    """Measure fluxes of stars by PSF fitting: build the effective PSF of a frame, and fit it to each star.

    Positions are fitted as well.

    Parameters
    ----------
    frame : Frame
        Raw frame with the stars.
    measurements : StarMeasurements
        Measured stars of the frame: positions, sky levels, first estimates of fluxes, and the FWHM.
    total_light : float array, shape (n,)
        Total light of each star from aperture photometry, e-; NaN if unknown. The PSF is built from the brighter half
        of the stars with a value.
    noise : float
        rms noise of a pixel of blank sky, e-.

    Returns
    -------
    flux, error : float array, shape (n,)
        Fitted light and its standard error, e-. NaN for stars that cannot be fitted, and for all stars if fewer than
        eight are available for the PSF.
    """
    stars, n = measurements.stars, len(measurements.stars)
    bright = np.flatnonzero(np.isfinite(total_light) & (total_light > 0.0))
    bright = bright[np.argsort(-total_light[bright], kind="stable")][: max(len(bright) // 2, MIN_STARS)]
    if len(bright) < MIN_STARS or not np.isfinite(measurements.fwhm):
        return np.full(n, np.nan), np.full(n, np.nan)
    pixels = [_star_pixels(frame, measurements, i) for i in range(n)]
    parts = [np.stack([u, v, cut / total_light[i], total_light[i] ** 2 / (noise**2 + np.maximum(cut, 0.0))])
             for i, (u, v, cut) in ((i, pixels[i]) for i in bright)]  # fmt: skip
    u, v, value, weight = np.concatenate(parts, axis=1)
    # Add an error floor: otherwise the many faint pixels of the wings would outweigh the few pixels of the core.
    variance = 1.0 / weight + (_PSF_VARIATION * value) ** 2 + (_FLOOR * value.max()) ** 2
    psf = build(u, v, value, 1.0 / variance, measurements.fwhm)
    if not np.isfinite(psf.coefficients).all():
        return np.full(n, np.nan), np.full(n, np.nan)
    # Copy the pixels of all stars to arrays (star, pixel); `is_pixel` is 0 for padding of stars with fewer pixels.
    max_pixels = max(len(cut) for *_, cut in pixels)
    u, v, cut, is_pixel = (np.zeros((n, max_pixels)) for _ in range(4))
    for i, star_values in enumerate(pixels):
        m = len(star_values[2])
        u[i, :m], v[i, :m], cut[i, :m], is_pixel[i, :m] = *star_values, 1.0
    return _fit_stars(psf, (u, v), cut, is_pixel > 0.0, stars.flux, noise)


def _star_pixels(frame: Frame, measurements: StarMeasurements, i: int) -> tuple[Float, Float, Float]:
    """Return the pixels around star number `i`: offsets x and y from the star, and light, as flat arrays.

    The light is in e- above the sky, corrected for nonlinearity and vignetting.
    """
    stars, reach = measurements.stars, fit_radius(measurements.fwhm)
    # Use a slightly smaller square than the range of the PSF, because the fit may shift the position.
    x, y, radius = float(stars.x[i]), float(stars.y[i]), reach - 2.0 * _STEP
    across, up = (np.arange(int(np.ceil(at - radius)), int(np.floor(at + radius)) + 1) for at in (x, y))
    cut = frame.linearize(frame.electrons[up[0] : up[-1] + 1, across[0] : across[-1] + 1].astype(float)) - stars.sky[i]
    u, v = np.broadcast_arrays(across - x, (up - y)[:, None])
    return u.ravel(), v.ravel(), cut.ravel() / float(frame.illumination(stars.x[i : i + 1], stars.y[i : i + 1])[0])


def _fit_stars(
    psf: EffectivePsf, place: tuple[Float, Float], cut: Float, is_pixel: Bool, flux: Float, noise: float
) -> tuple[Float, Float]:
    """Fit flux and position of n stars with a PSF; return the fluxes and their standard errors in e-.

    `place` are the offsets x and y of the pixels from their star, and `cut` their light in e- above the sky, all of
    shape (n, m); `is_pixel` is False for padding. `flux` is the first estimate in e-. Results are NaN for stars with
    fewer than eight good pixels or without positive flux.
    """
    flux, good = flux.astype(float), is_pixel
    u, v, failed = np.zeros_like(flux), np.zeros_like(flux), np.zeros(len(flux), bool)
    for n in range(_ROUNDS):
        x, y = place[0] - u[:, None], place[1] - v[:, None]
        value, rise, climb = (part.reshape(cut.shape) for part in psf.evaluate(x.ravel(), y.ravel()))
        model = np.maximum(flux[:, None] * value, 0.0)
        weight = 1.0 / (noise**2 + model)
        residual = cut - flux[:, None] * value
        if n > 1:
            good = is_pixel & (
                np.abs(residual) < _OUTLIER * np.sqrt(1.0 / weight + (3.0 * _PSF_VARIATION * model) ** 2)
            )
        failed |= (good.sum(axis=1) < MIN_STARS) | ~(flux > 0.0)
        heavy = weight * (good & ~failed[:, None])
        # Divide by the flux, so that the solution is the relative change of the flux and the shift in pixels.
        flux_step, du, dv = _solve_step((value, -rise, -climb), heavy, residual / np.where(failed, 1.0, flux)[:, None])
        u, v = (np.clip(a + b, -2 * _STEP, 2 * _STEP) for a, b in ((u, du), (v, dv)))
        flux = flux * (1.0 + flux_step)
    error = np.where(failed, 1.0, (heavy * value**2).sum(axis=1)) ** -0.5
    return np.where(failed, np.nan, flux), np.where(failed, np.nan, error)


def _solve_step(columns: Sequence[Float], weight: Float, residual: Float) -> list[Float]:
    """Return the weighted least-squares solution for each of n stars: three coefficients of `columns`, each (n,).

    `columns` are three arrays of shape (n, m) whose linear combination is fitted to `residual`, shape (n, m): the PSF
    and its two derivatives, which are nearly orthogonal. The solution is 0 for a star whose weights are all 0.
    """
    basis = np.stack(columns, axis=2)
    weighted = np.swapaxes(basis * weight[:, :, None], 1, 2)
    normal = weighted @ basis
    normal[~weight.any(axis=1)] = np.eye(3)
    return list(np.linalg.solve(normal, weighted @ residual[:, :, None])[:, :, 0].T)
