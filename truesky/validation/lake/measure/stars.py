"""Measure stars of a frame: centroids, curves of growth and moments.

Notes
-----
Positions are windowed centroids. The window is a Gaussian, whose rms the header states (PSFWIN). The columns psf_x and
psf_y of the table `rendered_truth` (centroid offsets of the PSF) are defined with the same window. Moments have a
window whose FWHM is the half-light diameter of a point source, and so have centroids if the header states no window.

References
----------
Bertin & Arnouts 1996 (XWIN_IMAGE)
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import scipy
import sep
from scipy.spatial import cKDTree

from lake_schema.arrays import Bool, Float, Int
from truesky.validation.lake.measure import wings
from truesky.validation.lake.measure.frames import Frame, sky_to_pixel
from truesky.validation.lake.measure.references import Reference
from truesky.validation.lake.measure.wings import Wings

# FWHM of a Gaussian in standard deviations.
FWHM = 2.0 * np.sqrt(2.0 * np.log(2.0))
# Half of the side of the square cutout around a star, in FWHM of the PSF.
_REACH = 10.0
# Half of the side of the square cutout around a star is at least this number of pixels.
_MIN_REACH = 20
# The sky around a star is measured beyond this fraction of half the side of its cutout.
_SKY_FROM = 0.75
# Radii of the apertures in which the light of a star is summed, as fractions of half the side of its cutout.
_APERTURES = np.array([0.02, 0.03, 0.04, 0.055, 0.075, 0.1, 0.14, 0.19, 0.26, 0.35, 0.46, 0.6, 0.75])
# Only stars with a larger expected signal-to-noise ratio than this are measured.
_MIN_SNR = 60.0
# Stars whose brightest pixel is above this fraction of the saturation level are not measured.
_MAX_FULL = 0.6
# Stars whose neighbours together have more than this fraction of the star's light are not measured.
_MAX_BLEND = 0.01
# Sources within this distance of a star, in FWHM of the PSF, count as its neighbours.
_BLEND_REACH = 8.0
# Largest number of stars that are measured in a frame; the brightest are selected.
MAX_STARS = 400
# The FWHM is fitted to pixels within this radius, in units of half the FWHM; a Gaussian falls to a third there.
_PROFILE_EXTENT = 1.26
# Number of groups of stars that are left out in turn, to estimate the error of the FWHM by a jackknife.
_PARTS = 8
# Pixels within this radius of a star, in pixels, are never masked or replaced by the mean profile, because their light
# depends strongly on the star's position within the pixel.
_CORE = 3.0
# A pixel is contaminated if it exceeds 1.5 times the median profile of stars, in this pixel or one of its neighbours,
# by more than this number of standard deviations.
_HIT = 5.0


@dataclass(frozen=True, slots=True, eq=False)
class Stars:
    """Positions, fluxes and shapes of the measured stars of a frame.

    Attributes
    ----------
    id : int array, shape (n,)
        Identifiers of the stars.
    x, y : float array, shape (n,)
        Expected positions, from the catalogue and the WCS, pixels from 0.
    dx, dy : float array, shape (n,)
        Measured windowed centroid minus the expected position, minus the known centroid offset of the PSF, pixels.
    error : float array, shape (n,)
        Standard error of dx and of dy due to photon and read noise, pixels.
    growth : float array, shape (n, apertures)
        Curve of growth: measured light within each aperture, corrected for vignetting, e-.
    flux : float array, shape (n,)
        Expected light of the star in the exposure, e-.
    mag : float array, shape (n,)
        AB magnitude of the catalogue.
    size : float array, shape (n,)
        rms radius of the light within the Gaussian window along one axis, pixels.
    e1, e2 : float array, shape (n,)
        Ellipticity (xx - yy) / (xx + yy) and 2 xy / (xx + yy), from second moments within the Gaussian window.
    sky : float array, shape (n,)
        Level of the sky around the star, e- per pixel.
    peak : float array, shape (n,)
        Value of the brightest pixel above the sky, e-.
    snr : float array, shape (n,)
        Signal-to-noise ratio of the flux in the window.
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
        """Return only the stars for which `mask`, shape (n,), is True."""
        return Stars(*(getattr(self, field.name)[mask] for field in fields(self)))


@dataclass(frozen=True, slots=True, eq=False)
class StarMeasurements:
    """Measured stars of a frame, and the mean profile of a point source in this frame.

    Attributes
    ----------
    stars : Stars
        Measured stars.
    radii : float array, shape (apertures,)
        Radii of the apertures of the curve of growth, pixels.
    half_light, fwhm, fwhm_error : float
        Half-light radius and FWHM of a point source, and the standard error of the FWHM, pixels. NaN if there are too
        few stars for the FWHM or its error.
    sky_at : float array, shape (m,)
        Distances from the star to the m pixels of its cutout in which the sky is measured, pixels.
    wings : Wings
        Power law that describes the light of a point source at large distances.
    """

    stars: Stars
    radii: Float
    half_light: float
    fwhm: float
    fwhm_error: float
    sky_at: Float
    wings: Wings


def select_stars(frame: Frame, sources: Reference, noise: float) -> Int:
    """Select the isolated stars with an expected S/N above 60, away from the edges of a frame.

    Saturation is not checked here.

    Parameters
    ----------
    frame : Frame
        Raw frame in electrons.
    sources : Reference
        Known sources of the frame.
    noise : float
        rms noise of a pixel of blank sky, e-.

    Returns
    -------
    int array, shape (n,)
        Indices of the stars in `sources`, brightest first.
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
    """Measure the isolated, bright and unsaturated stars of a frame, at most 400, and the profile of a point source.

    Parameters
    ----------
    frame : Frame
        Raw frame in electrons.
    sources : Reference
        Known sources of the frame.
    noise : float
        rms noise of a pixel of blank sky, e-.

    Returns
    -------
    StarMeasurements
        Measured stars, brightest first; without any star the arrays are empty.
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
    centroid_window = float(frame.header.get("PSFWIN", frame.scale * window)) / frame.scale
    cx, cy, *_, weight = _windowed_moments(cuts, x - first_column, y - first_row, centroid_window)
    variance = noise**2 + np.maximum(flux, 0.0) / (4.0 * np.pi * centroid_window**2)
    error = np.sqrt(8.0 * np.pi * variance) * centroid_window**2 / np.maximum(weight, 1.0)
    _, _, xx, yy, xy, _ = _windowed_moments(cuts, x - first_column, y - first_row, window)
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
    """Return square cutouts of an image with 2 `reach` + 1 pixels along each side, centred on positions (pixels).

    Also returns the column and the row of the first pixel of each cutout. Cutouts must be inside the image.
    """
    first_column, first_row = (np.rint(axis).astype(int) - reach for axis in (x, y))
    side = 2 * reach + 1
    cuts = [image[b : b + side, a : a + side] for a, b in zip(first_column, first_row, strict=True)]
    return np.array(cuts, float).reshape(-1, side, side), first_column, first_row


def _neighbour_mask(sources: Reference, index: Int, first_column: Int, first_row: Int, noise: float, side: int) -> Bool:
    """Return masks of the pixels in square cutouts of stars in which another known source is visible.

    `index` has the indices of the n stars in `sources`. The masks have the shape (n, side, side), and never include the
    pixels within 3 pixels of the star.
    """
    out = np.zeros((len(index), side, side), bool)
    if not len(index):
        return out
    places, axis = np.stack([sources.x, sources.y], axis=1), np.arange(side)
    neighbours = cKDTree(places).query_ball_point(places[index], 1.5 * side)
    for n, (i, nearby) in enumerate(zip(index, neighbours, strict=True)):
        neighbour_indices = np.array([j for j in nearby if j != i], int)
        out[n] = wings.neighbour_mask(sources, neighbour_indices, first_column[n] + axis, first_row[n] + axis, noise)
    # Do not mask the core of a star: its light cannot be separated from the light of a neighbour.
    core = np.hypot(axis - side // 2, (axis - side // 2)[:, None]) < _CORE
    return out & ~core


def _clipped_mean(values: Float, good: Bool, noise: float) -> Float:
    """Return the mean of each row of `values` (pixels around a star) without outliers.

    Values are used if `good` is True and if they are within 3 times `noise` (rms) of the median of their row.

    If no value of a row is good, all are used.
    """
    if not len(values):
        return np.zeros(0)
    # Treat all values of a row as good if none is.
    good = good | ~good.any(axis=1, keepdims=True)
    middle = np.nanmedian(np.where(good, values, np.nan), axis=1)
    used = good & (np.abs(values - middle[:, None]) < 3.0 * noise)
    return np.asarray((values * used).sum(axis=1) / np.maximum(used.sum(axis=1), 1))


def _replace_contaminated(cuts: Float, neighbour_mask: Bool, flux: Float, noise: float) -> Float:
    """Replace pixels with light of cosmic rays or neighbours by the median profile of all stars times the star's flux.

    `cuts` are cutouts of stars in e- above the sky. With fewer than eight stars, they are returned unchanged.
    """
    if len(cuts) < 8:
        return cuts
    typical = np.maximum(np.median(cuts / flux[:, None, None], axis=0), 0.0)
    expected = flux[:, None, None] * typical
    # Stars differ by up to half a pixel in their position within a pixel. On a steep profile, a pixel may be as bright
    # as its neighbours are in the median profile. Otherwise stars of VIS lose 0.4 to 1.1 % of their light.
    largest = flux[:, None, None] * scipy.ndimage.maximum_filter(typical, 3)
    axis = np.arange(cuts.shape[-1]) - cuts.shape[-1] // 2
    # Do not replace pixels of the core: their values depend on the star's position within the pixel.
    core = np.hypot(axis, axis[:, None]) < _CORE
    hit = (cuts > largest + _HIT * np.sqrt(noise**2 + largest) + 0.5 * largest) & ~core
    return np.where(hit | neighbour_mask, expected, cuts)


def _growth(cuts: Float, x: Float, y: Float, radii: Float) -> Float:
    """Return the light (e-) of each star within circles of the given radii (pixels), shape (stars, radii).

    Pixels that are partly inside a circle contribute the fraction of their area.
    """
    out = np.zeros((len(cuts), len(radii)))
    for i, cut in enumerate(cuts):
        out[i] = [sep.sum_circle(cut, [x[i]], [y[i]], r, subpix=0)[0][0] for r in radii]
    return out


def _half_light(growth: Float, flux: Float, radii: Float) -> float:
    """Return the radius (pixels) that contains half of the light within the widest aperture, from the median star.

    Without stars, the fifth radius is returned.
    """
    if not len(growth):
        return float(radii[4])
    mean = np.median(growth / flux[:, None], axis=0)
    # Interpolate the logarithm of the light outside r linearly in r^2, which is exact for a Gaussian.
    outside = np.minimum.accumulate(np.clip(1.0 - mean / mean[-1], 1e-6, 1.0))
    return float(np.sqrt(np.interp(np.log(2.0), np.append(0.0, -np.log(outside)), np.append(0.0, radii**2))))


def _fwhm_with_error(cuts: Float, x: Float, y: Float, flux: Float, window: float) -> tuple[float, float]:
    """Return the FWHM (pixels) of the brighter half of the stars, and its jackknife error over groups of stars.

    The error is NaN if the FWHM of a subsample cannot be measured.
    """
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
    """Return the FWHM (pixels) of the mean profile of stars, or NaN with fewer than three stars or a failed fit.

    The logarithm of the light of all stars is fitted with a polynomial in r^2 and r^4, down to a third of the peak.
    Stars at different positions within a pixel sample the profile finely. `window` is the first estimate of sigma.
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
    # `second` and `fourth` are the fitted coefficients of r^2 and r^4 in the logarithm of the profile. At half maximum,
    # u = r^2 solves second u + fourth u^2 = -ln 2.
    root = second**2 - 4.0 * fourth * np.log(2.0)
    if second >= 0.0 or root <= 0.0:
        return np.nan
    return float(2.0 * np.sqrt(2.0 * np.log(2.0) / (np.sqrt(root) - second)))


def _windowed_moments(cuts: Float, x: Float, y: Float, window: float) -> tuple[Float, ...]:
    """Measure windowed centroids and second moments of stars in cutouts, with a Gaussian of sigma `window` (pixels).

    Returns the centroids cx and cy in pixels of the cutout, the second moments xx, yy and xy in pixels^2, and twice the
    weighted light, which for a Gaussian star of this width is its flux.
    """
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
