"""Light of stars by fitting a PSF: the effective one of the frame itself, from its brighter stars.

Effective   part of a point's light in a pixel, by its distance from the point: cubic splines, the pixel's width in them
built       cuts of stars and their light -> Effective
lights      stars of a frame -> light of each, by least squares in light and place

Ref : Anderson & King 2000, PASP 112, 1360 (effective PSF); Stetson 1987, PASP 99, 191 (fitting)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solveh_banded

from lake_schema.arrays import Bool, Float
from truesky.validation.lake.measure.frames import Frame
from truesky.validation.lake.measure.stars import StarMeasurements

# FWHM on either side of a star, and at least pixels; knots a FWHM, and pixels between them at least.
_REACH, _MIN_REACH, _KNOTS, _FINEST = 2.0, 3.0, 4.0, 1.0 / 3.0
# Of the mean weight of a coefficient, by which second differences are kept small.
_SMOOTH = 1e-5
# Stars that it is built from, at least; how much the PSF differs from star to star, of itself and of its peak;
# deviations of an outlier.
MIN_STARS, _PSF_VARIATION, _FLOOR, _OUTLIER = 8, 0.03, 3e-3, 5.0
# Rounds of a fit, and how far a place may be moved in one, pixels.
_ROUNDS, _STEP = 5, 0.3


@dataclass(frozen=True, slots=True)
class EffectivePsf:
    """float64[k, k] coefficients of cubic splines (rows, columns), `step` pixels apart, from -reach to reach."""

    coefficients: Float
    step: float
    reach: float

    def evaluate(self, x: Float, y: Float) -> tuple[Float, Float, Float]:
        """(value, its slopes along columns and rows) [m] at distances from the point, pixels."""
        (i, first, rise), (j, second, climb) = (_basis(axis, self.step, self.reach) for axis in (x, y))
        coefficients = self.coefficients[j[:, :, None], i[:, None, :]]
        return (
            np.einsum("mji,mj,mi->m", coefficients, second, first),
            np.einsum("mji,mj,mi->m", coefficients, second, rise),
            np.einsum("mji,mj,mi->m", coefficients, climb, first),
        )


def _basis(x: Float, step: float, reach: float) -> tuple[np.ndarray, Float, Float]:
    """(indices, values, slopes) [m, 4] of the splines that are not 0 at x [m]."""
    place = (x + reach) / step
    first = np.clip(np.floor(place).astype(int), 0, _knots(step, reach) - 4)
    t = place - first
    value = np.stack([(1 - t) ** 3, 3 * t**3 - 6 * t**2 + 4, -3 * t**3 + 3 * t**2 + 3 * t + 1, t**3], axis=1) / 6.0
    slope = np.stack([-((1 - t) ** 2), 3 * t**2 - 4 * t, -3 * t**2 + 2 * t + 1, t**2], axis=1) / (2.0 * step)
    return first[:, None] + np.arange(4), value, slope


def _knots(step: float, reach: float) -> int:
    return int(np.ceil(2.0 * reach / step)) + 3


def build(x: Float, y: Float, value: Float, weight: Float, fwhm: float) -> EffectivePsf:
    """Of pixels [m].

    x, y : distances from their stars, pixels;  value : part of the star's light in each;  weight : of it
    fwhm : pixels
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
    """Coefficients [k k]: least squares with small second differences, by a banded normal matrix; else NaN."""
    heavy, width = basis * weight[:, None], 3 * k + 3
    band = np.zeros((width + 1, k * k))
    for i in range(16):
        for j in range(16):
            lag = index[0, i] - index[0, j]
            if lag >= 0:
                band[lag] += np.bincount(index[:, j], heavy[:, i] * basis[:, j], k * k)
    smooth = _SMOOTH * band[0].mean()
    for step in (1, k):
        # Second differences of three neighbours along a row, or a column.
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
    """Pixels from a star that are fitted."""
    return max(_REACH * fwhm, _MIN_REACH)


def fit_fluxes(frame: Frame, measurements: StarMeasurements, total_light: Float, noise: float) -> tuple[Float, Float]:
    """(e- [n] of all light of the stars, its error), NaN where they are too few to tell a PSF.

    frame : that shows them;  found : stars;  whole : e- [n] of all light, of the brighter ones at least
    noise : e- rms of a pixel of blank sky
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
    # Without a floor the many pixels of the wings would outweigh the few of the core.
    variance = 1.0 / weight + (_PSF_VARIATION * value) ** 2 + (_FLOOR * value.max()) ** 2
    psf = build(u, v, value, 1.0 / variance, measurements.fwhm)
    if not np.isfinite(psf.coefficients).all():
        return np.full(n, np.nan), np.full(n, np.nan)
    # As many pixels of each: those that some have not count for nothing.
    max_pixels = max(len(cut) for *_, cut in pixels)
    u, v, cut, is_pixel = (np.zeros((n, max_pixels)) for _ in range(4))
    for i, star_values in enumerate(pixels):
        m = len(star_values[2])
        u[i, :m], v[i, :m], cut[i, :m], is_pixel[i, :m] = *star_values, 1.0
    return _fit_stars(psf, (u, v), cut, is_pixel > 0.0, stars.flux, noise)


def _star_pixels(frame: Frame, measurements: StarMeasurements, i: int) -> tuple[Float, Float, Float]:
    """(x, y from the place of a star, e- above the sky as if the optics had no vignetting) of the pixels about it."""
    stars, reach = measurements.stars, fit_radius(measurements.fwhm)
    # A place may move: the PSF is known a little less far than it is asked for.
    x, y, radius = float(stars.x[i]), float(stars.y[i]), reach - 2.0 * _STEP
    across, up = (np.arange(int(np.ceil(at - radius)), int(np.floor(at + radius)) + 1) for at in (x, y))
    cut = frame.linearize(frame.electrons[up[0] : up[-1] + 1, across[0] : across[-1] + 1].astype(float)) - stars.sky[i]
    u, v = np.broadcast_arrays(across - x, (up - y)[:, None])
    return u.ravel(), v.ravel(), cut.ravel() / float(frame.illumination(stars.x[i : i + 1], stars.y[i : i + 1])[0])


def _fit_stars(
    psf: EffectivePsf, place: tuple[Float, Float], cut: Float, is_pixel: Bool, flux: Float, noise: float
) -> tuple[Float, Float]:
    """(e- [n], its error) of stars, NaN where too few pixels are good.

    place : x, y [n, m] of pixels;  cut : e- [n, m];  there : whether there is such a pixel;  flux : where to begin
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
        # In units of the flux, so that light and place weigh alike.
        flux_step, du, dv = _solve_step((value, -rise, -climb), heavy, residual / np.where(failed, 1.0, flux)[:, None])
        u, v = (np.clip(a + b, -2 * _STEP, 2 * _STEP) for a, b in ((u, du), (v, dv)))
        flux = flux * (1.0 + flux_step)
    error = np.where(failed, 1.0, (heavy * value**2).sum(axis=1)) ** -0.5
    return np.where(failed, np.nan, flux), np.where(failed, np.nan, error)


def _solve_step(columns: Sequence[Float], weight: Float, residual: Float) -> list[Float]:
    """Of each star [n] the three numbers by which its columns [n, m] explain what is left; 0 if no pixel is good.

    Their matrix is far from singular: a PSF and its slopes along two axes are nearly orthogonal.
    """
    basis = np.stack(columns, axis=2)
    weighted = np.swapaxes(basis * weight[:, :, None], 1, 2)
    normal = weighted @ basis
    normal[~weight.any(axis=1)] = np.eye(3)
    return list(np.linalg.solve(normal, weighted @ residual[:, :, None])[:, :, 0].T)
