"""Measure fluxes of stars by fitting the effective PSF of the frame, which is built from its brighter stars.

The effective PSF is the fraction of a point source's light in a pixel as a function of the distance from the point. It
includes the width of the pixel and is represented by cubic splines.

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

# Radius of the fit in FWHM, and its smallest value in pixels; knots per FWHM, and their smallest distance in pixels.
_REACH, _MIN_REACH, _KNOTS, _FINEST = 2.0, 3.0, 4.0, 1.0 / 3.0
# Weight of the second differences, in units of the mean weight of a coefficient.
_SMOOTH = 1e-5
# Fewest stars for a PSF; relative variation of the PSF between stars, and its floor relative to the peak; standard
# deviations of an outlier.
MIN_STARS, _PSF_VARIATION, _FLOOR, _OUTLIER = 8, 0.03, 3e-3, 5.0
# Number of iterations of a fit, and largest shift of a position per iteration, pixels.
_ROUNDS, _STEP = 5, 0.3


@dataclass(frozen=True, slots=True)
class EffectivePsf:
    """Effective PSF as cubic splines.

    Attributes
    ----------
    coefficients : float array, shape (k, k)
        Spline coefficients (rows, columns).
    step : float
        Distance between knots, pixels.
    reach : float
        The PSF extends from -reach to reach, pixels.
    """

    coefficients: Float
    step: float
    reach: float

    def evaluate(self, x: Float, y: Float) -> tuple[Float, Float, Float]:
        """Return the value, and its slopes along columns and rows, at distances (pixels) from the point."""
        (i, first, rise), (j, second, climb) = (_basis(axis, self.step, self.reach) for axis in (x, y))
        coefficients = self.coefficients[j[:, :, None], i[:, None, :]]
        return (
            np.einsum("mji,mj,mi->m", coefficients, second, first),
            np.einsum("mji,mj,mi->m", coefficients, second, rise),
            np.einsum("mji,mj,mi->m", coefficients, climb, first),
        )


def _basis(x: Float, step: float, reach: float) -> tuple[np.ndarray, Float, Float]:
    """Indices, values and slopes, each of shape (m, 4), of the splines that are not 0 at x."""
    place = (x + reach) / step
    first = np.clip(np.floor(place).astype(int), 0, _knots(step, reach) - 4)
    t = place - first
    value = np.stack([(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3], axis=1) / 6.0
    slope = np.stack([-((1 - t) ** 2), 3 * t**2 - 4 * t, -3 * t**2 + 2 * t + 1, t**2], axis=1) / (2.0 * step)
    return first[:, None] + np.arange(4), value, slope


def _knots(step: float, reach: float) -> int:
    return int(np.ceil(2.0 * reach / step)) + 3


def build(x: Float, y: Float, value: Float, weight: Float, fwhm: float) -> EffectivePsf:
    """Build the effective PSF from pixels of stars.

    Parameters
    ----------
    x, y : float array, shape (m,)
        Distances of the pixels from their stars, pixels.
    value : float array, shape (m,)
        Fraction of the star's light in each pixel.
    weight : float array, shape (m,)
        Inverse variance of the value.
    fwhm : float
        FWHM, pixels.

    Returns
    -------
    EffectivePsf
        The PSF; coefficients are NaN if they are not determined.
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
    """Least-squares coefficients with small second differences, from a banded normal matrix; NaN if it is singular."""
    heavy, width = basis * weight[:, None], 3 * k + 3
    band = np.zeros((width + 1, k * k))
    for i in range(16):
        for j in range(16):
            lag = index[0, i] - index[0, j]
            if lag >= 0:
                band[lag] += np.bincount(index[:, j], heavy[:, i] * basis[:, j], k * k)
    smooth = _SMOOTH * band[0].mean()
    for step in (1, k):
        # Second differences are those of three neighbours along a row or a column.
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
    """Return the radius in pixels within which stars are fitted."""
    return max(_REACH * fwhm, _MIN_REACH)


def fit_fluxes(frame: Frame, measurements: StarMeasurements, total_light: Float, noise: float) -> tuple[Float, Float]:
    """Fit the fluxes and positions of stars with the effective PSF of the frame.

    Parameters
    ----------
    frame : Frame
        Frame with the stars.
    measurements : StarMeasurements
        Stars of the frame.
    total_light : float array, shape (n,)
        All light of each star, e-; required for the brighter stars, NaN if unknown.
    noise : float
        rms of a pixel of blank sky, e-.

    Returns
    -------
    flux, error : float array, shape (n,)
        Fitted light and its error, e-; NaN if there are too few stars for a PSF.
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
    # Without this floor the many pixels of the wings would outweigh the few pixels of the core.
    variance = 1.0 / weight + (_PSF_VARIATION * value) ** 2 + (_FLOOR * value.max()) ** 2
    psf = build(u, v, value, 1.0 / variance, measurements.fwhm)
    if not np.isfinite(psf.coefficients).all():
        return np.full(n, np.nan), np.full(n, np.nan)
    # Arrays have the same number of pixels for each star; padding is masked.
    max_pixels = max(len(cut) for *_, cut in pixels)
    u, v, cut, is_pixel = (np.zeros((n, max_pixels)) for _ in range(4))
    for i, star_values in enumerate(pixels):
        m = len(star_values[2])
        u[i, :m], v[i, :m], cut[i, :m], is_pixel[i, :m] = *star_values, 1.0
    return _fit_stars(psf, (u, v), cut, is_pixel > 0.0, stars.flux, noise)


def _star_pixels(frame: Frame, measurements: StarMeasurements, i: int) -> tuple[Float, Float, Float]:
    """x and y relative to a star, and e- above the sky corrected for vignetting, of the pixels around it."""
    stars, reach = measurements.stars, fit_radius(measurements.fwhm)
    # The position may shift, so the fit uses a slightly smaller radius than that of the PSF.
    x, y, radius = float(stars.x[i]), float(stars.y[i]), reach - 2.0 * _STEP
    across, up = (np.arange(int(np.ceil(at - radius)), int(np.floor(at + radius)) + 1) for at in (x, y))
    cut = frame.linearize(frame.electrons[up[0] : up[-1] + 1, across[0] : across[-1] + 1].astype(float)) - stars.sky[i]
    u, v = np.broadcast_arrays(across - x, (up - y)[:, None])
    return u.ravel(), v.ravel(), cut.ravel() / float(frame.illumination(stars.x[i : i + 1], stars.y[i : i + 1])[0])


def _fit_stars(
    psf: EffectivePsf, place: tuple[Float, Float], cut: Float, is_pixel: Bool, flux: Float, noise: float
) -> tuple[Float, Float]:
    """Fitted flux (e-) and its error per star, NaN if too few pixels are good.

    `place` are x and y of the pixels, `cut` their e-, each of shape (n, m); `flux` is the initial flux.
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
        # Dividing by the flux gives flux and position steps similar weights.
        flux_step, du, dv = _solve_step((value, -rise, -climb), heavy, residual / np.where(failed, 1.0, flux)[:, None])
        u, v = (np.clip(a + b, -2 * _STEP, 2 * _STEP) for a, b in ((u, du), (v, dv)))
        flux = flux * (1.0 + flux_step)
    error = np.where(failed, 1.0, (heavy * value**2).sum(axis=1)) ** -0.5
    return np.where(failed, np.nan, flux), np.where(failed, np.nan, error)


def _solve_step(columns: Sequence[Float], weight: Float, residual: Float) -> list[Float]:
    """Least-squares solution of the three columns (n, m) for the residuals of each star; 0 if no pixel is good.

    The matrix is well conditioned, since a PSF and its slopes along two axes are nearly orthogonal.
    """
    basis = np.stack(columns, axis=2)
    weighted = np.swapaxes(basis * weight[:, :, None], 1, 2)
    normal = weighted @ basis
    normal[~weight.any(axis=1)] = np.eye(3)
    return list(np.linalg.solve(normal, weighted @ residual[:, :, None])[:, :, 0].T)
