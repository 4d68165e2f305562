"""Measure stars of a frame: centroids, curves of growth and moments.

Notes
-----
Positions are windowed centroids. The window is a Gaussian whose FWHM is the half-light diameter of a point source, as
for the centroid offsets in the tables of the lake.

References
----------
Bertin & Arnouts 1996 (XWIN_IMAGE)
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
# Half the side of the cutout of a star in FWHM, and at least pixels; the sky is measured outside this fraction of it.
_REACH, _MIN_REACH, _SKY_FROM = 10.0, 20, 0.75
# Radii of the apertures as fractions of half the side; they also give the half-light radius.
_APERTURES = np.array([0.02, 0.03, 0.04, 0.055, 0.075, 0.1, 0.14, 0.19, 0.26, 0.35, 0.46, 0.6, 0.75])
# Smallest S/N, largest fraction of the full well in the brightest pixel, and largest relative light of neighbours.
_MIN_SNR, _MAX_FULL, _MAX_BLEND = 60.0, 0.6, 0.01
# Neighbours are searched within this number of FWHM.
_BLEND_REACH = 8.0
MAX_STARS = 400
# Radius at which a Gaussian falls to a third, in units of half its FWHM.
_PROFILE_EXTENT = 1.26
# Number of jackknife groups of stars for the error of the FWHM.
_PARTS = 8
# Radius in pixels within which the light depends on the position within the pixel.
_CORE = 3.0
# Standard deviations above the mean profile of stars from which a pixel is contaminated.
_HIT = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class Stars:
    """Measured stars of a frame.

    Attributes
    ----------
    id : int array, shape (n,)
        Identifiers.
    x, y : float array, shape (n,)
        Positions from the catalogue and the WCS, pixels from 0.
    dx, dy : float array, shape (n,)
        Windowed centroid minus this position and minus the offset of the PSF, pixels.
    error : float array, shape (n,)
        Error of dx and of dy from photons and read noise, pixels.
    growth : float array, shape (n, apertures)
        Light within the radii, corrected for vignetting, e-.
    flux : float array, shape (n,)
        Expected light, e-.
    mag : float array, shape (n,)
        AB magnitude of the catalogue.
    size, e1, e2 : float array, shape (n,)
        rms radius in the window, pixels, and ellipticity.
    sky : float array, shape (n,)
        Sky level, e- per pixel.
    peak : float array, shape (n,)
        Brightest pixel above the sky, e-.
    snr : float array, shape (n,)
        Signal-to-noise ratio.
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
        """Return the stars selected by a mask."""
        return Stars(*(getattr(self, field.name)[mask] for field in fields(self)))


@dataclass(frozen=True, slots=True, eq=False)
class StarMeasurements:
    """Stars of a frame, and the profile of a point source.

    Attributes
    ----------
    stars : Stars
        Measured stars.
    radii : float array, shape (apertures,)
        Radii of the apertures, pixels.
    half_light, fwhm, fwhm_error : float
        Half-light radius and FWHM of a point source, and the error of the FWHM, pixels.
    sky_at : float array, shape (m,)
        Distances from the star of the pixels in which the sky is measured, pixels.
    wings : Wings
        Wings of a point source.
    """

    stars: Stars
    radii: Float
    half_light: float
    fwhm: float
    fwhm_error: float
    sky_at: Float
    wings: Wings


def select_stars(frame: Frame, sources: Reference, noise: float) -> Int:
    """Return indices of isolated, unsaturated and bright stars, brightest first.

    Parameters
    ----------
    frame : Frame
        A frame.
    sources : Reference
        Known sources of the frame.
    noise : float
        rms of a pixel of blank sky, e-.

    Returns
    -------
    int array, shape (n,)
        Indices of the sources.
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
    """Measure up to MAX_STARS stars of a frame.

    Parameters
    ----------
    frame : Frame
        A frame.
    sources : Reference
        Known sources of the frame.
    noise : float
        rms of a pixel of blank sky, e-.

    Returns
    -------
    StarMeasurements
        Stars and the profile of a point source.
    """
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
    """Square cutouts around positions, and the column and row of their first pixels."""
    first_column, first_row = (np.rint(axis).astype(int) - reach for axis in (x, y))
    side = 2 * reach + 1
    cuts = [image[b : b + side, a : a + side] for a, b in zip(first_column, first_row, strict=True)]
    return np.array(cuts, float).reshape(-1, side, side), first_column, first_row


def _neighbour_mask(sources: Reference, index: Int, first_column: Int, first_row: Int, noise: float, side: int) -> Bool:
    """Mask of pixels in cutouts of stars in which another source is visible."""
    out = np.zeros((len(index), side, side), bool)
    if not len(index):
        return out
    places, axis = np.stack([sources.x, sources.y], axis=1), np.arange(side)
    neighbours = cKDTree(places).query_ball_point(places[index], 1.5 * side)
    for n, (i, nearby) in enumerate(zip(index, neighbours, strict=True)):
        neighbour_indices = np.array([j for j in nearby if j != i], int)
        out[n] = wings.neighbour_mask(sources, neighbour_indices, first_column[n] + axis, first_row[n] + axis, noise)
    # The core of a star is not masked, since light there cannot be assigned to a neighbour.
    core = np.hypot(axis - side // 2, (axis - side // 2)[:, None]) < _CORE
    return out & ~core


def _clipped_mean(values: Float, good: Bool, noise: float) -> Float:
    """Mean of the good values of each row without outliers."""
    if not len(values):
        return np.zeros(0)
    # All values are used if none is good.
    good = good | ~good.any(axis=1, keepdims=True)
    middle = np.nanmedian(np.where(good, values, np.nan), axis=1)
    used = good & (np.abs(values - middle[:, None]) < 3.0 * noise)
    return np.asarray((values * used).sum(axis=1) / np.maximum(used.sum(axis=1), 1))


def _replace_contaminated(cuts: Float, neighbour_mask: Bool, flux: Float, noise: float) -> Float:
    """Replace pixels with light of cosmic rays or neighbours by the typical profile of the stars."""
    if len(cuts) < 8:
        return cuts
    typical = np.maximum(np.median(cuts / flux[:, None, None], axis=0), 0.0)
    expected = flux[:, None, None] * typical
    axis = np.arange(cuts.shape[-1]) - cuts.shape[-1] // 2
    # The core depends on the position within the pixel.
    core = np.hypot(axis, axis[:, None]) < _CORE
    hit = (cuts > expected + _HIT * np.sqrt(noise**2 + expected) + 0.5 * expected) & ~core
    return np.where(hit | neighbour_mask, expected, cuts)


def _growth(cuts: Float, x: Float, y: Float, radii: Float) -> Float:
    """Light (e-) of each star within circles; light is evenly distributed within a pixel."""
    out = np.zeros((len(cuts), len(radii)))
    for i, cut in enumerate(cuts):
        out[i] = [sep.sum_circle(cut, [x[i]], [y[i]], r, subpix=0)[0][0] for r in radii]
    return out


def _half_light(growth: Float, flux: Float, radii: Float) -> float:
    """Half-light radius in pixels relative to the light within the widest aperture."""
    if not len(growth):
        return float(radii[4])
    mean = np.median(growth / flux[:, None], axis=0)
    # For a Gaussian, the log of the fraction outside r, exp(-r^2 / 2 sigma^2), is linear in r^2.
    outside = np.minimum.accumulate(np.clip(1.0 - mean / mean[-1], 1e-6, 1.0))
    return float(np.sqrt(np.interp(np.log(2.0), np.append(0.0, -np.log(outside)), np.append(0.0, radii**2))))


def _fwhm_with_error(cuts: Float, x: Float, y: Float, flux: Float, window: float) -> tuple[float, float]:
    """FWHM and its jackknife error over groups of stars."""
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
    """FWHM (pixels) of the mean profile of stars, whose positions sample a pixel finely; NaN if there are too few.

    The logarithm of the light is fitted with r^2 and r^4 down to a third of the peak.
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
    # Half maximum is at u = r^2 with second u + fourth u^2 = -ln 2.
    root = second**2 - 4.0 * fourth * np.log(2.0)
    if second >= 0.0 or root <= 0.0:
        return np.nan
    return float(2.0 * np.sqrt(2.0 * np.log(2.0) / (np.sqrt(root) - second)))


def _windowed_moments(cuts: Float, x: Float, y: Float, window: float) -> tuple[Float, ...]:
    """Centroids (pixels of the cutout), second moments in the window, and the light in it, of each star."""
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
