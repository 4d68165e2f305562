"""Stars of a frame, measured: centroids, curves of growth, moments.

measured   stars that can be trusted, each where the frame's own WCS puts it
Stars      what was measured of them

Positions are windowed centroids in the window that the lake's offsets are of: a Gaussian whose FWHM is the half-light
diameter of a point source.  Ref : Bertin & Arnouts 1996 (XWIN_IMAGE)
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import sep
from scipy.spatial import cKDTree

from lake_schema.arrays import Bool, Float, Int
from truesky.validation.lake.measure import wings
from truesky.validation.lake.measure.frames import Frame, sky_to_pixel
from truesky.validation.lake.measure.references import Reference
from truesky.validation.lake.measure.wings import Wings

FWHM = 2.0 * np.sqrt(2.0 * np.log(2.0))
# Half the side of what is looked at about a star, in FWHM and at least pixels; the outer part of it tells the sky.
_REACH, _MIN_REACH, _SKY_FROM = 10.0, 20, 0.75
# Radii of the apertures, as a part of that reach, and the one that half-light is told by.
_APERTURES = np.array([0.02, 0.03, 0.04, 0.055, 0.075, 0.1, 0.14, 0.19, 0.26, 0.35, 0.46, 0.6, 0.75])
# S/N of a star that is used, part of the full well that its brightest pixel may reach, light of others beside it.
_MIN_SNR, _MAX_FULL, _MAX_BLEND = 60.0, 0.6, 0.01
# Others are looked for within so many FWHM, their light as a part of the star's.
_BLEND_REACH = 8.0
MAX_STARS = 400
# Radius at which a Gaussian has fallen to a third, over half its FWHM.
_PROFILE_EXTENT = 1.26
# Parts of the stars that are left out in turn for the error of the FWHM.
_PARTS = 8
# Pixels from a star's place in which its light goes with the place in the pixel.
_CORE = 3.0
# Standard deviations above what other stars have there, from which a pixel is another's light.
_HIT = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class Stars:
    """Stars [n] of a frame.

    x, y     : where the WCS puts them, pixels from 0;  dx, dy : windowed centroid minus that and the PSF's own offset
    error    : of either, pixels, of photons and reading;  phase_x, phase_y : of the place in its pixel
    growth   : float[n, apertures] e- within the radii, had the optics no vignetting
    flux     : expected e-;  mag : AB of the catalogue
    size, e1, e2 : rms radius in the window, pixels, and its ellipticity
    sky, peak, snr : e- a pixel, e-, of all of it
    """

    id: Int
    x: Float
    y: Float
    dx: Float
    dy: Float
    error: Float
    growth: Float
    flux: Float
    mag: Float
    size: Float
    e1: Float
    e2: Float
    sky: Float
    peak: Float
    snr: Float

    def __len__(self) -> int:
        return len(self.id)

    def select(self, mask: Bool) -> Stars:
        """Those that are kept."""
        return Stars(*(getattr(self, field.name)[mask] for field in fields(self)))


@dataclass(frozen=True, slots=True, eq=False)
class StarMeasurements:
    """Stars, radii of the apertures, half-light radius and FWHM of a point source, and the latter's error, pixels.

    sky_at : distances from the star at which the sky was taken, pixels;  wings : of a point source
    """

    stars: Stars
    radii: Float
    half_light: float
    fwhm: float
    fwhm_error: float
    sky_at: Float
    wings: Wings


def select_stars(frame: Frame, sources: Reference, noise: float) -> Int:
    """Indices of stars worth measuring, brightest first: alone, not saturated, of enough signal.

    noise : e- rms of a pixel of blank sky
    """
    width = float(frame.header["PSFFWHM"]) / frame.scale
    area = np.pi * (1.5 * width) ** 2
    snr = sources.expected / np.sqrt(np.maximum(sources.expected, 0.0) + area * noise**2)
    ny, nx = frame.electrons.shape
    reach = _reach(frame)
    inside = (sources.x > reach) & (sources.x < nx - 1 - reach) & (sources.y > reach) & (sources.y < ny - 1 - reach)
    good = np.flatnonzero(sources.point & np.isfinite(sources.ra) & inside & (snr > _MIN_SNR))
    good = good[np.argsort(-sources.expected[good], kind="stable")]
    if not good.size:
        return good
    tree = cKDTree(np.stack([sources.x, sources.y], axis=1))
    neighbours = tree.query_ball_point(
        np.stack([sources.x[good], sources.y[good]], axis=1), max(_BLEND_REACH * width, 6.0)
    )
    is_isolated = [sum(sources.expected[j] for j in nearby if j != i) < _MAX_BLEND * sources.expected[i]
             for i, nearby in zip(good, neighbours, strict=True)]  # fmt: skip
    return np.asarray(good[np.array(is_isolated, bool)])


def _reach(frame: Frame) -> int:
    return max(round(_REACH * float(frame.header["PSFFWHM"]) / frame.scale), _MIN_REACH)


def measure_stars(frame: Frame, sources: Reference, noise: float) -> StarMeasurements:
    """Up to MOST stars of a frame; noise : e- rms of a pixel of blank sky."""
    index = select_stars(frame, sources, noise)
    reach = _reach(frame)
    radii = _APERTURES * reach
    x, y = sky_to_pixel(frame.wcs, sources.ra[index], sources.dec[index])
    ny, nx = frame.electrons.shape
    inside = (x > reach) & (x < nx - 1 - reach) & (y > reach) & (y < ny - 1 - reach)
    index, x, y = index[inside], x[inside], y[inside]
    cuts, first_column, first_row = _cutouts(frame.electrons, x, y, reach)
    cuts = frame.linearize(cuts)
    axis = np.arange(-reach, reach + 1)
    distance = np.hypot(axis, axis[:, None])
    in_sky_ring = distance > _SKY_FROM * reach
    neighbour_mask = _neighbour_mask(sources, index, first_column, first_row, noise, 2 * reach + 1)
    sky = _clipped_mean(cuts[:, in_sky_ring], ~neighbour_mask[:, in_sky_ring], noise)
    cuts = _replace_contaminated(cuts - sky[:, None, None], neighbour_mask, sources.expected[index], noise)
    peak = cuts[:, reach - 2 : reach + 3, reach - 2 : reach + 3].max(axis=(1, 2)) if len(cuts) else np.zeros(0)
    is_usable = (peak + sky < _MAX_FULL * frame.saturation_level) & (peak > 0.0)
    selected = np.flatnonzero(is_usable)[:MAX_STARS]
    index, first_column, first_row = index[selected], first_column[selected], first_row[selected]
    x, y, cuts, sky, peak = x[selected], y[selected], cuts[selected], sky[selected], peak[selected]
    growth = _growth(cuts, x - first_column, y - first_row, radii) / frame.illumination(x, y)[:, None]
    flux = sources.expected[index]
    half = _half_light(growth, flux, radii)
    window = 2.0 * half / FWHM
    cx, cy, xx, yy, xy, weight = _windowed_moments(cuts, x - first_column, y - first_row, window)
    variance = noise**2 + np.maximum(flux, 0.0) / (4.0 * np.pi * window**2)
    error = np.sqrt(8.0 * np.pi * variance) * window**2 / np.maximum(weight, 1.0)
    size = np.sqrt(0.5 * np.maximum(xx + yy, 0.0))
    trace = np.where(xx + yy > 0.0, xx + yy, np.nan)
    snr = flux / np.sqrt(np.maximum(flux, 0.0) + 4.0 * np.pi * window**2 * noise**2)
    stars = Stars(
        sources.id[index],
        x,
        y,
        first_column + cx - x - sources.psf_x[index],
        first_row + cy - y - sources.psf_y[index],
        error,
        growth,
        flux,
        sources.mag[index],
        size,
        (xx - yy) / trace,
        2.0 * xy / trace,
        sky,
        peak,
        snr,
    )
    is_measured = np.isfinite(stars.dx) & np.isfinite(stars.dy) & np.isfinite(stars.e1)
    centres = (
        (x - first_column + sources.psf_x[index])[is_measured],
        (y - first_row + sources.psf_y[index])[is_measured],
    )
    width, width_error = _fwhm_with_error(cuts[is_measured], *centres, flux[is_measured], window)
    point_wings = wings.measure(frame, sources, index[is_measured], noise, reach)
    return StarMeasurements(
        stars.select(is_measured), radii, half, width, width_error, distance[in_sky_ring], point_wings
    )


def _cutouts(image: np.ndarray, x: Float, y: Float, reach: int) -> tuple[Float, Int, Int]:
    """float[n, side, side] about places, and the column and row of their first pixel."""
    first_column, first_row = (np.rint(axis).astype(int) - reach for axis in (x, y))
    side = 2 * reach + 1
    cuts = [image[b : b + side, a : a + side] for a, b in zip(first_column, first_row, strict=True)]
    return np.array(cuts, float).reshape(-1, side, side), first_column, first_row


def _neighbour_mask(sources: Reference, index: Int, first_column: Int, first_row: Int, noise: float, side: int) -> Bool:
    """bool[n, side, side]: where another source shows in the cut of a star; left, low : of its first pixel."""
    out = np.zeros((len(index), side, side), bool)
    if not len(index):
        return out
    places, axis = np.stack([sources.x, sources.y], axis=1), np.arange(side)
    neighbours = cKDTree(places).query_ball_point(places[index], 1.5 * side)
    for n, (i, nearby) in enumerate(zip(index, neighbours, strict=True)):
        neighbour_indices = np.array([j for j in nearby if j != i], int)
        out[n] = wings.neighbour_mask(sources, neighbour_indices, first_column[n] + axis, first_row[n] + axis, noise)
    # In the star's own core there is no telling whose light it is.
    core = np.hypot(axis - side // 2, (axis - side // 2)[:, None]) < _CORE
    return out & ~core


def _clipped_mean(values: Float, good: Bool, noise: float) -> Float:
    """Means [n] of the good ones of values [n, m] but for those far from their median."""
    if not len(values):
        return np.zeros(0)
    # Where nothing is good, all of it has to do.
    good = good | ~good.any(axis=1, keepdims=True)
    middle = np.nanmedian(np.where(good, values, np.nan), axis=1)
    used = good & (np.abs(values - middle[:, None]) < 3.0 * noise)
    return np.asarray((values * used).sum(axis=1) / np.maximum(used.sum(axis=1), 1))


def _replace_contaminated(cuts: Float, neighbour_mask: Bool, flux: Float, noise: float) -> Float:
    """Without what cosmic rays and neighbours bring: where others are known to shine, and what is far above what other
    stars have there, is what these have.
    """
    if len(cuts) < 8:
        return cuts
    typical = np.maximum(np.median(cuts / flux[:, None, None], axis=0), 0.0)
    expected = flux[:, None, None] * typical
    axis = np.arange(cuts.shape[-1]) - cuts.shape[-1] // 2
    # Near the middle light depends on the place in the pixel.
    core = np.hypot(axis, axis[:, None]) < _CORE
    hit = (cuts > expected + _HIT * np.sqrt(noise**2 + expected) + 0.5 * expected) & ~core
    return np.where(hit | neighbour_mask, expected, cuts)


def _growth(cuts: Float, x: Float, y: Float, radii: Float) -> Float:
    """e- [n, apertures] within circles; light is even in a pixel."""
    out = np.zeros((len(cuts), len(radii)))
    for i, cut in enumerate(cuts):
        out[i] = [sep.sum_circle(cut, [x[i]], [y[i]], r, subpix=0)[0][0] for r in radii]
    return out


def _half_light(growth: Float, flux: Float, radii: Float) -> float:
    """Pixels; of the light that the widest aperture holds."""
    if not len(growth):
        return float(radii[4])
    mean = np.median(growth / flux[:, None], axis=0)
    # Of a Gaussian's light the part outside is exp(-r^2 / 2 sigma^2): its logarithm is nearly straight in r^2.
    outside = np.minimum.accumulate(np.clip(1.0 - mean / mean[-1], 1e-6, 1.0))
    return float(np.sqrt(np.interp(np.log(2.0), np.append(0.0, -np.log(outside)), np.append(0.0, radii**2))))


def _fwhm_with_error(cuts: Float, x: Float, y: Float, flux: Float, window: float) -> tuple[float, float]:
    """(FWHM, its error by leaving out parts of the stars in turn); as of `_fwhm`."""
    bright = np.argsort(-flux, kind="stable")[: max(len(flux) // 2, 4)]
    fwhm = _fwhm(cuts[bright], x[bright], y[bright], flux[bright], window)
    parts = min(_PARTS, len(bright))
    masks = [np.arange(len(bright)) % parts != part for part in range(parts)]
    subsamples = [bright[mask] for mask in masks]
    estimates = np.array(
        [_fwhm(cuts[subsample], x[subsample], y[subsample], flux[subsample], window) for subsample in subsamples]
    )
    if len(estimates) < 2 or not np.isfinite(estimates).all():
        return fwhm, np.nan
    return fwhm, float(np.sqrt((parts - 1) * np.mean((estimates - estimates.mean()) ** 2)))


def _fwhm(cuts: Float, x: Float, y: Float, flux: Float, window: float) -> float:
    """Pixels, of the mean profile of stars, whose places in a pixel sample it finely; NaN of too few.

    The logarithm of the light is told by r^2 and r^4 as far as it falls to a third.
    """
    if len(flux) < 3:
        return np.nan
    axis = np.arange(cuts.shape[-1])
    radius = np.hypot(axis[None, None, :] - x[:, None, None], axis[None, :, None] - y[:, None, None])
    light = cuts / flux[:, None, None]
    in_core = radius < 0.5 * FWHM * window * _PROFILE_EXTENT
    if in_core.sum() < 12:
        return np.nan
    square, log_light = radius[in_core] ** 2, np.log(np.maximum(light[in_core], 1e-9))
    for _ in range(4):
        basis = np.stack([np.ones(len(square)), square, square**2], axis=1)
        first, second, fourth = np.linalg.lstsq(basis, log_light)[0]
        residual = log_light - first - second * square - fourth * square**2
        used = np.abs(residual) < 4.0 * 1.4826 * np.median(np.abs(residual)) + 1e-9
        square, log_light = square[used], log_light[used]
    # Where second u + fourth u^2 = -ln 2, u = r^2.
    root = second**2 - 4.0 * fourth * np.log(2.0)
    if second >= 0.0 or root <= 0.0:
        return np.nan
    return float(2.0 * np.sqrt(2.0 * np.log(2.0) / (np.sqrt(root) - second)))


def _windowed_moments(cuts: Float, x: Float, y: Float, window: float) -> tuple[Float, ...]:
    """Centroids (pixels of the cut), second moments in the window, and the light in it, of each [n]."""
    axis = np.arange(cuts.shape[-1])
    cx, cy = x.copy(), y.copy()
    for _ in range(12):
        wx, wy, u, v = _weights(axis, cx, cy, window)
        zeroth = np.einsum("nij,ni,nj->n", cuts, wy, wx)
        with np.errstate(divide="ignore", invalid="ignore"):
            cx = cx + np.clip(2.0 * np.einsum("nij,ni,nj->n", cuts, wy, wx * u) / zeroth, -1.0, 1.0)
            cy = cy + np.clip(2.0 * np.einsum("nij,ni,nj->n", cuts, wy * v, wx) / zeroth, -1.0, 1.0)
    wx, wy, u, v = _weights(axis, cx, cy, window)
    zeroth = np.einsum("nij,ni,nj->n", cuts, wy, wx)
    with np.errstate(divide="ignore", invalid="ignore"):
        xx = np.einsum("nij,ni,nj->n", cuts, wy, wx * u * u) / zeroth
        yy = np.einsum("nij,ni,nj->n", cuts, wy * v * v, wx) / zeroth
        xy = np.einsum("nij,ni,nj->n", cuts, wy * v, wx * u) / zeroth
    return cx, cy, xx, yy, xy, 2.0 * zeroth


def _weights(axis: Int, cx: Float, cy: Float, window: float) -> tuple[Float, Float, Float, Float]:
    u, v = axis - cx[:, None], axis - cy[:, None]
    return np.exp(-0.5 * (u / window) ** 2), np.exp(-0.5 * (v / window) ** 2), u, v
