"""Light of stars by fitting a PSF: the effective one of the frame itself, from its brighter stars.

Effective   part of a point's light in a pixel, by its distance from the point: cubic splines, the pixel's width in them
built       cuts of stars and their light -> Effective
lights      stars of a frame -> light of each, by least squares in light and place

Ref : Anderson & King 2000, PASP 112, 1360 (effective PSF); Stetson 1987, PASP 99, 191 (fitting)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from jobs import sums
from jobs.validation.measure.frames import Frame
from jobs.validation.measure.stars import Measured
from lake_schema.arrays import Float

# FWHM on either side of a star, and at least pixels; knots a FWHM, and pixels between them at least.
_REACH, _LEAST_REACH, _KNOTS, _FINEST = 2.0, 3.0, 4.0, 1.0 / 3.0
# Of the mean weight of a coefficient, by which second differences are kept small; rounds of its solution.
_SMOOTH, _SOLVED = 1e-5, 200
# Stars that it is built from, at least; how much the PSF differs from star to star, of itself and of its peak;
# deviations of an outlier.
LEAST, _DIFFERS, _FLOOR, _OUTLIER = 8, 0.03, 3e-3, 5.0
# Rounds of a fit, and how far a place may be moved in one, pixels.
_ROUNDS, _STEP = 5, 0.3


@dataclass(frozen=True, slots=True)
class Effective:
    """float64[k, k] coefficients of cubic splines (rows, columns), `step` pixels apart, from -reach to reach."""

    coefficients: Float
    step: float
    reach: float

    def at(self, x: Float, y: Float) -> tuple[Float, Float, Float]:
        """(value, its slopes along columns and rows) [m] at distances from the point, pixels."""
        (i, first, rise), (j, second, climb) = (_basis(axis, self.step, self.reach) for axis in (x, y))
        own = self.coefficients[j[:, :, None], i[:, None, :]]
        return (
            np.einsum("mji,mj,mi->m", own, second, first),
            np.einsum("mji,mj,mi->m", own, second, rise),
            np.einsum("mji,mj,mi->m", own, climb, first),
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


def built(x: Float, y: Float, value: Float, weight: Float, fwhm: float) -> Effective:
    """Of pixels [m].

    x, y : distances from their stars, pixels;  value : part of the star's light in each;  weight : of it
    fwhm : pixels
    """
    step, reach = max(fwhm / _KNOTS, _FINEST), reach_of(fwhm)
    k = _knots(step, reach)
    kept = np.ones(len(value), bool)
    (i, first, _), (j, second, _) = (_basis(axis, step, reach) for axis in (x, y))
    index = (j[:, :, None] * k + i[:, None, :]).reshape(-1, 16)
    basis = (second[:, :, None] * first[:, None, :]).reshape(-1, 16)
    solution = np.zeros(k * k)
    for _ in range(2):
        solution = _solved(index[kept], basis[kept], value[kept], weight[kept], k)
        kept = np.abs(value - (basis * solution[index]).sum(axis=1)) < _OUTLIER / np.sqrt(weight)
    return Effective(solution.reshape(k, k), step, reach)


def _solved(index: np.ndarray, basis: Float, value: Float, weight: Float, k: int) -> Float:
    """Coefficients [k k] by conjugate gradients."""

    def back(pixels: Float) -> Float:
        return np.asarray(np.bincount(index.ravel(), (basis * (weight * pixels)[:, None]).ravel(), k * k), float)

    smooth = _SMOOTH * np.bincount(index.ravel(), (basis**2 * weight[:, None]).ravel(), k * k).mean()

    def applied(c: Float) -> Float:
        square, rough = c.reshape(k, k), np.zeros((k, k))
        for axis in (0, 1):
            pad = [(2, 2) if axis == a else (0, 0) for a in (0, 1)]
            rough += np.diff(np.pad(np.diff(square, 2, axis), pad), 2, axis)
        return np.asarray(back((basis * c[index]).sum(axis=1)) + smooth * rough.ravel())

    out = np.zeros(k * k)
    left = back(value)
    along, size = left, float((left**2).sum())
    for _ in range(_SOLVED):
        turned = applied(along)
        length = size / max(float((along * turned).sum()), 1e-300)
        out, left = out + length * along, left - length * turned
        new = float((left**2).sum())
        along, size = left + new / max(size, 1e-300) * along, new
    return out


def reach_of(fwhm: float) -> float:
    """Pixels from a star that are fitted."""
    return max(_REACH * fwhm, _LEAST_REACH)


def lights(frame: Frame, found: Measured, whole: Float, noise: float) -> tuple[Float, Float]:
    """(e- [n] of all light of the stars, its error), NaN where they are too few to tell a PSF.

    frame : that shows them;  found : stars;  whole : e- [n] of all light, of the brighter ones at least
    noise : e- rms of a pixel of blank sky
    """
    stars, n = found.stars, len(found.stars)
    bright = np.flatnonzero(np.isfinite(whole) & (whole > 0.0))
    bright = bright[np.argsort(-whole[bright], kind="stable")][: max(len(bright) // 2, LEAST)]
    out, error = np.full(n, np.nan), np.full(n, np.nan)
    if len(bright) < LEAST or not np.isfinite(found.fwhm):
        return out, error
    pixels = [_pixels(frame, found, i) for i in range(n)]
    parts = [np.stack([u, v, cut / whole[i], whole[i] ** 2 / (noise**2 + np.maximum(cut, 0.0))])
             for i, (u, v, cut) in ((i, pixels[i]) for i in bright)]  # fmt: skip
    u, v, value, weight = np.concatenate(parts, axis=1)
    # Without a floor the many pixels of the wings would outweigh the few of the core.
    variance = 1.0 / weight + (_DIFFERS * value) ** 2 + (_FLOOR * value.max()) ** 2
    psf = built(u, v, value, 1.0 / variance, found.fwhm)
    for i in range(n):
        out[i], error[i] = _fitted(psf, *pixels[i], float(stars.flux[i]), noise)
    return out, error


def _pixels(frame: Frame, found: Measured, i: int) -> tuple[Float, Float, Float]:
    """(x, y from the place of a star, e- above the sky as if the optics had no vignetting) of the pixels about it."""
    stars, reach = found.stars, reach_of(found.fwhm)
    # A place may move: the PSF is known a little less far than it is asked for.
    x, y, near = float(stars.x[i]), float(stars.y[i]), reach - 2.0 * _STEP
    across, up = (np.arange(int(np.ceil(at - near)), int(np.floor(at + near)) + 1) for at in (x, y))
    cut = frame.light(frame.electrons[up[0] : up[-1] + 1, across[0] : across[-1] + 1].astype(float)) - stars.sky[i]
    u, v = np.broadcast_arrays(across - x, (up - y)[:, None])
    return u.ravel(), v.ravel(), cut.ravel() / float(frame.illumination(stars.x[i : i + 1], stars.y[i : i + 1])[0])


def _fitted(psf: Effective, x: Float, y: Float, cut: Float, flux: float, noise: float) -> tuple[float, float]:
    """(e-, its error) of one star; flux : where to begin."""
    u, v, good = 0.0, 0.0, np.ones(len(cut), bool)
    weight = np.ones(len(cut))
    value = weight
    for n in range(_ROUNDS):
        value, rise, climb = psf.at(x - u, y - v)
        told = np.maximum(flux * value, 0.0)
        weight = 1.0 / (noise**2 + told)
        left = cut - flux * value
        if n > 1:
            good = np.abs(left) < _OUTLIER * np.sqrt(1.0 / weight + (3.0 * _DIFFERS * told) ** 2)
        if good.sum() < LEAST:
            return np.nan, np.nan
        root = np.sqrt(weight * good)
        matrix = np.stack([value, -flux * rise, -flux * climb], axis=1) * root[:, None]
        more, du, dv = sums.least_squares(matrix, left * root)
        flux, u, v = flux + float(more), *(float(np.clip(a + b, -2 * _STEP, 2 * _STEP)) for a, b in ((u, du), (v, dv)))
    return flux, float((weight * good * value**2).sum() ** -0.5)
