"""Detect and measure sources in a calibrated image, with the column names of SourceExtractor.

Bits of the column FLAGS have the meaning of SourceExtractor: 1 for bad pixels in the aperture of MAG_AUTO, 2 for
deblended sources, 4 for a saturated pixel, 8 for sources that are cut off by the edge or contain pixels without data,
16 for an aperture beyond the edge. The column IMAFLAGS_ISO is the bitwise OR of the image's flags in all pixels of the
source.

References
----------
Bertin & Arnouts 1996, A&AS 117, 393; Barbary 2016, JOSS 1, 58 (sep). Windowed positions and their errors: manual of
SourceExtractor (sextractor.readthedocs.io), section "Windowed positional parameters".
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
import sep
from astropy.wcs import WCS
from scipy import ndimage

from lake_schema.arrays import Array, Bool, Float, Int
from lake_schema.errors import OutOfRange
from lake_schema.fits.ldac import ColumnData
from truesky.reduction.calibration import NO_DATA, SATURATED, ReducedImage
from truesky.render.camera import astrometry

# Side, in pixels, of the squares in which the level of the sky is measured.
_MESH = 64
# Side, in squares, of the median filter that smooths the levels of the sky.
_MESH_FILTER = 3
# Side, in pixels, of the squares over which pixels are averaged before the level of the sky is measured.
_SMOOTHING = 3
# The Kron radius is measured in an ellipse this many times larger than the isophotal ellipse (A_IMAGE, B_IMAGE).
_ISOPHOTES = 6.0
# Size of the elliptical aperture of MAG_AUTO in Kron radii.
_KRON = 2.5
# Smallest size of this aperture in units of the isophotal ellipse, the default of SourceExtractor. The Kron radius of
# faint sources is mostly noise.
_LEAST_KRON = 3.5
# Smallest radius, in pixels, of the aperture of MAG_AUTO; below it, a circle of this radius is used.
_MIN_RADIUS = 1.75
# Value of `subpix` with which sep computes exact overlaps of pixels and apertures.
_EXACT = 0
# Standard deviation of the Gaussian window for XWIN_IMAGE and YWIN_IMAGE, as a multiple of the half-light radius.
_WINDOW = 2.0 / (2.0 * np.sqrt(2.0 * np.log(2.0)))
# Radius of this window in standard deviations, as in SourceExtractor.
_WINDOW_RADIUS = 4.0
# Largest number of pixels of all windows whose position errors are computed at the same time, to limit memory.
_WINDOW_PIXELS = 1 << 20
# Number of detected pixels for which sep reserves memory, as a fraction of the pixels of a tile.
_PIXEL_STACK = 0.5
# Largest number of objects into which sep may divide a source while deblending.
_MAX_SUBOBJECTS = 8192
# Side, in pixels, of the square tiles in which sources are detected. sep compares all pairs of sources and keeps all
# their pixels in memory, which takes too long for a whole detector.
_TILE = 2048
# Width, in pixels, of the border around a tile that is searched as well, so that sources at its edge are complete.
_TILE_MARGIN = 256
# Pixels within this distance (pixels) of a detected source do not contribute to the sky.
_MARGIN = 3
# Smallest rms of the sky in units of the image, to avoid a division by 0.
_FLOOR = np.float32(1e-20)
# Magnitude, and error of the magnitude, of a source whose flux is not positive, as in SourceExtractor.
_NO_MAGNITUDE = 99.0
# Change of the magnitude per change of ln(flux).
_MAGNITUDE_PER_LN = 2.5 / np.log(10.0)


@dataclass(frozen=True, slots=True)
class Limits:
    """Conditions that a group of adjacent pixels must meet to be detected as a source.

    Attributes
    ----------
    threshold : float
        Smallest value of each pixel above the sky, in standard deviations of the sky, 0.5 to 10,000.
    pixels : int
        Smallest number of adjacent pixels, 1 to 10,000.

    Raises
    ------
    OutOfRange
        If a limit is out of range.
    """

    threshold: float = 1.5
    pixels: int = 5

    def __post_init__(self) -> None:
        if not 0.5 <= self.threshold <= 1e4:
            raise OutOfRange("--threshold", self.threshold, 0.5, 1e4)
        if not 1 <= self.pixels <= 10_000:
            raise OutOfRange("--least-pixels", self.pixels, 1, 10_000)


def detect_sources(image: ReducedImage, gain: float, radius: float, limits: Limits) -> dict[str, Array]:
    """Detect and measure the sources in an image with sep (the algorithms of SourceExtractor).

    Parameters
    ----------
    image : ReducedImage
        The calibrated image, including the sky. Pixels with weight 0 and any flag other than SATURATED are masked.
    gain : float
        Electrons per unit of the image, for the shot noise of fluxes.
    radius : float
        Radius of the circular aperture of MAG_APER in pixels.
    limits : Limits
        Detection threshold and smallest number of pixels.

    Returns
    -------
    dict of str to array
        One value per source in each array, except `errors` and `window_errors`, shape (3, n): the covariances xx, yy
        and xy of the errors of (x, y) and of (xwin, ywin) in pixels^2. Positions are in pixels from 0, fluxes in units
        of the image, and `theta` is in radians. The function `columns` converts these measurements to catalogue
        columns. Sources are in the order of the tiles, beginning at the first row. The arrays are empty without
        sources.

    Notes
    -----
    The image is searched in tiles of 2048 x 2048 pixels. At the edge of a tile, a source that extends more than 256
    pixels from its brightest pixel may be truncated or counted twice.
    """
    return _measure(image, gain, radius, limits, is_windowed=True)[0]


def detect_segments(image: ReducedImage, gain: float, radius: float, limits: Limits) -> tuple[dict[str, Array], Int]:
    """Detect and measure the sources in an image, and return the pixels of each source as well.

    Parameters
    ----------
    image : ReducedImage
        As for `detect_sources`.
    gain : float
        Electrons per unit of the image, for the shot noise of fluxes.
    radius : float
        Radius of the circular aperture of MAG_APER in pixels.
    limits : Limits
        Detection threshold and smallest number of pixels.

    Returns
    -------
    measured : dict of str to array
        The measurements of `detect_sources` without those in a Gaussian window (`xwin`, `ywin`, `window_errors`), which
        take a third of the time.
    segments : int32 array, shape (ny, nx)
        Number of the source to which a pixel belongs, from 1 in the order of the measurements, or 0.
    """
    return _measure(image, gain, radius, limits, is_windowed=False)


def _measure(
    image: ReducedImage, gain: float, radius: float, limits: Limits, is_windowed: bool
) -> tuple[dict[str, Array], Int]:
    """Return measurements and pixels of the sources, with measurements in a Gaussian window or without."""
    masked = (image.flags & ~np.uint8(SATURATED) != 0) & (image.weight <= 0.0)
    above, noise, sky = _subtract_sky(image, masked, limits)
    # The threshold is that of SourceExtractor: the smoothed image against the noise of unsmoothed pixels. With sep's
    # matched filter a third of the detections would be noise.
    sources, segmentation = _extract(above, noise, masked, limits, gain=gain, filter_type="conv")
    centres = sources["x"], sources["y"]
    shape = sources["a"], sources["b"], np.clip(sources["theta"], -np.pi / 2, np.pi / 2)
    # Pixels of other sources are left out; the mean of the others in the aperture takes their place.
    chosen_pixels = {"mask": masked, "seg_id": np.arange(1, len(sources) + 1), "segmap": segmentation}
    common = {"err": noise, "gain": gain, "subpix": _EXACT, **chosen_pixels}
    kron, _ = sep.kron_radius(above, *centres, *shape, _ISOPHOTES, **chosen_pixels)
    kron = np.maximum(_KRON * np.where(np.isfinite(kron), kron, 0.0), _LEAST_KRON)
    small = kron * np.sqrt(shape[0] * shape[1]) < _MIN_RADIUS
    auto = sep.sum_ellipse(above, *centres, *shape, kron, **common)
    small_aperture = sep.sum_circle(above, *centres, _MIN_RADIUS, **common)
    aperture = sep.sum_circle(above, *centres, radius, **common)
    flux, error, _ = (np.where(small, b, a) for a, b in zip(auto, small_aperture, strict=True))
    half_light, _ = sep.flux_radius(
        above, *centres, _ISOPHOTES * shape[0], 0.5, normflux=np.maximum(flux, 1e-20), subpix=5, **chosen_pixels
    )
    windowed = _in_windows((above, noise, masked), gain, centres, half_light) if is_windowed else {}
    bits = _flag_bits(segmentation, image.flags, len(sources))
    # Pixels of other sources do not count as bad pixels.
    auto_flags = sep.sum_ellipse(above, *centres, *shape, kron, mask=masked, subpix=1)[2]
    flags = _flags(sources["flag"], auto_flags | aperture[2], auto_flags, bits)
    pixel = np.rint(centres[1]).astype(int), np.rint(centres[0]).astype(int)
    measured = {
        "x": centres[0], "y": centres[1], **windowed, "a": shape[0], "b": shape[1], "theta": shape[2],
        "errors": _errors(sources, flux / np.maximum(error, 1e-20)), "npix": sources["npix"],
        "fwhm": _fwhm(above, segmentation, sources["peak"]),
        "flux_iso": sources["flux"], "flux_max": sources["peak"], "threshold": sources["thresh"], "kron": kron,
        "flux_auto": flux, "fluxerr_auto": error, "flux_aper": aperture[0], "fluxerr_aper": aperture[1],
        "flux_radius": half_light, "background": sky.back()[pixel], "flags": flags, "imaflags": bits,
    }  # fmt: skip
    return measured, segmentation


def _in_windows(
    maps: tuple[Array, Array, Bool], gain: float, centres: tuple[Float, Float], half_light: Float
) -> dict[str, Array]:
    """Return positions in a Gaussian window, and their errors; for `maps` see `_window_errors`."""
    window = np.maximum(_WINDOW * half_light, 0.5)
    xwin, ywin, _ = sep.winpos(maps[0], *centres, window, mask=maps[2], subpix=_EXACT)
    return {"xwin": xwin, "ywin": ywin, "window_errors": _window_errors(maps, gain, (xwin, ywin), window)}


def _subtract_sky(image: ReducedImage, masked: Bool, limits: Limits) -> tuple[Array, Array, sep.Background]:
    """Return the image minus the sky, the rms of the sky (both float32[ny, nx]), and the model of the sky's level.

    The sky is measured twice. The second time, pixels on and near the sources of a first detection are left out.
    """
    # Delete arrays as soon as possible: each takes a third of a gigabyte for a large detector.
    pixels = np.ascontiguousarray(image.image, np.float32)
    empty = image.weight > 0.0
    sky, noise = _measure_sky(pixels, empty)
    on_source = _extract(_subtract_background(pixels, sky), noise, masked, limits, deblend_cont=1.0)[1] > 0
    empty &= ~ndimage.binary_dilation(on_source, iterations=_MARGIN)
    del on_source
    if empty.any():
        sky, noise = _measure_sky(pixels, empty)
    return _subtract_background(pixels, sky), noise, sky


def _measure_sky(pixels: Array, empty: Bool) -> tuple[sep.Background, Array]:
    """Return the model of the sky's level, and the rms of the sky, float32[ny, nx], from the pixels that are `empty`.

    The level is that of means of 3 x 3 pixels. Raw pixels are whole numbers of ADU, and sep's estimate of their mode is
    wrong by up to one ADU, which is a third of the noise of a VIS pixel.
    """
    mesh = {"bw": _MESH, "bh": _MESH, "fw": _MESH_FILTER, "fh": _MESH_FILTER}
    smooth, share = np.where(empty, pixels, np.float32(0.0)), empty.astype(np.float32)
    for values in (smooth, share):
        ndimage.uniform_filter(values, _SMOOTHING, output=values)
    np.divide(smooth, share, out=smooth, where=empty)
    del share, values
    sky = sep.Background(smooth, mask=~empty, **mesh)
    del smooth
    noise = sep.Background(pixels, mask=~empty, **mesh).rms()
    return sky, np.asarray(np.maximum(noise, _FLOOR, out=noise))


def _extract(above: Array, noise: Array, masked: Bool, limits: Limits, **options: Any) -> tuple[Array, Array]:
    """Detect sources tile by tile; return the table of sep.extract, and the segmentation map, int32[ny, nx].

    The map has the number of the source to which a pixel belongs, from 1, or 0. `above` is the image minus the sky,
    `noise` the rms of the sky, `masked` is True for pixels to ignore, and `options` are passed to sep.extract.
    """
    sep.set_sub_object_limit(_MAX_SUBOBJECTS)
    segmentation, all_sources, count = np.zeros(above.shape, np.int32), [], 0
    for first_row, first_column in product(*(range(0, side, _TILE) for side in above.shape)):
        padded = tuple(
            slice(max(first - _TILE_MARGIN, 0), first + _TILE + _TILE_MARGIN) for first in (first_row, first_column)
        )
        tile, error, mask = (np.ascontiguousarray(array[padded]) for array in (above, noise, masked))
        sep.set_extract_pixstack(max(300_000, int(_PIXEL_STACK * tile.size)))
        sources, tile_segmentation = sep.extract(
            tile, limits.threshold, err=error, mask=mask, minarea=limits.pixels, segmentation_map=True, **options
        )
        for axis, axis_slice in zip("yx", padded, strict=True):
            for name in (axis, f"{axis}min", f"{axis}max", f"{axis}peak", f"{axis}cpeak"):
                sources[name] += axis_slice.start
        # Keep a source only if its brightest pixel is in this tile: neighbouring tiles may have detected it as well.
        in_tile = (sources["ypeak"] // _TILE == first_row // _TILE) & (
            sources["xpeak"] // _TILE == first_column // _TILE
        )
        number = np.zeros(len(sources) + 1, np.int32)
        number[1:][in_tile] = count + np.arange(1, in_tile.sum() + 1)
        np.copyto(segmentation[padded], number[tile_segmentation], where=number[tile_segmentation] > 0)
        all_sources.append(sources[in_tile])
        count += int(in_tile.sum())
    return np.concatenate(all_sources), segmentation


def _subtract_background(pixels: Array, sky: sep.Background) -> Array:
    back = sky.back()
    return np.asarray(np.subtract(pixels, back, out=back))


def _errors(sources: Array, signal: Float) -> Float:
    """Return the covariance of the position errors of n sources in pixels^2: xx, yy and xy, float64[3, n].

    If sep gives no finite error (a source with a masked pixel), the second moments of the source's light divided by
    the squared S/N are used. `signal` is the S/N of each flux.
    """
    errors = np.stack([sources[name] for name in ("errx2", "erry2", "errxy")])
    light_errors = np.stack([sources[name] for name in ("x2", "y2", "xy")]) / np.maximum(signal, 1.0) ** 2
    return np.where(np.isfinite(errors).all(axis=0), errors, light_errors)


def _window_errors(
    maps: tuple[Array, Array, Bool], gain: float, positions: tuple[Float, Float], window: Float
) -> Float:
    """Return the covariance of the errors of windowed positions in pixels^2: xx, yy and xy, float64[3, n].

    Parameters
    ----------
    maps : (float array, float array, bool array), each of shape (ny, nx)
        Image minus the sky, rms of the sky, and a mask that is True for pixels to ignore.
    gain : float
        Electrons per unit of the image.
    positions : (float array, float array), each of shape (n,)
        Windowed columns and rows, from 0.
    window : float array, shape (n,)
        Standard deviation of the Gaussian window of each source, pixels.

    Returns
    -------
    float array, shape (3, n)
        Covariances 4 sum(w^2 v d d') / sum(w I)^2, where w is the window, I the light, v the variance of a pixel and d
        its distance from the position. If the light in the window is not positive, the variance is that of the window.
    """
    out = np.zeros((3, len(window)))
    half: Int = np.minimum(np.ceil(_WINDOW_RADIUS * window).astype(np.int64), max(maps[0].shape))
    for size in np.unique(half):
        offset = np.arange(-size, size + 1)
        sources = np.flatnonzero(half == size)
        step = max(_WINDOW_PIXELS // len(offset) ** 2, 1)
        # The window of a bleeding star may be larger than the image: it is summed in strips of rows.
        rows = max(_WINDOW_PIXELS // len(offset), 1)
        for first in range(0, len(sources), step):
            at = sources[first : first + step]
            places = np.stack([positions[0][at], positions[1][at], window[at]])
            strips = [offset[start : start + rows] for start in range(0, len(offset), rows)]
            sums = np.sum([_window_sums(maps, gain, places, (offset, strip)) for strip in strips], axis=0)
            total, terms = sums[0], sums[1:]
            is_bright = total > 0.0
            largest = np.multiply.outer([1.0, 1.0, 0.0], window[at] ** 2)
            out[:, at] = np.where(is_bright, 4.0 * terms / np.where(is_bright, total, 1.0) ** 2, largest)
    return out


def _window_sums(maps: tuple[Array, Array, Bool], gain: float, places: Float, offsets: tuple[Int, Int]) -> Float:
    """Return sum(w I), and sum(w^2 v d d') for xx, yy and xy, of `_window_errors` for n sources, float64[4, n].

    `places`, float64[3, n], has the columns, rows and windows of the sources. The sums are over pixels at the `offsets`
    (columns, rows) from the middle pixel of each source.
    """
    shape, (column, row, sigma) = maps[0].shape, places[:, :, None, None]
    x = np.rint(column).astype(np.int64) + offsets[0]
    y = np.rint(row).astype(np.int64) + offsets[1][:, None]
    dx, dy = x - column, y - row
    x, y = np.broadcast_arrays(x, y)
    inside = (x >= 0) & (x < shape[1]) & (y >= 0) & (y < shape[0])
    pixel = np.clip(y, 0, shape[0] - 1), np.clip(x, 0, shape[1] - 1)
    light, rms = (np.asarray(plane[pixel], float) for plane in maps[:2])
    weight = np.exp(-0.5 * (dx**2 + dy**2) / sigma**2)
    weight *= inside & ~maps[2][pixel] & (dx**2 + dy**2 <= (_WINDOW_RADIUS * sigma) ** 2)
    variance = weight**2 * (rms**2 + np.maximum(light, 0.0) / gain)
    parts = (weight * light, variance * dx**2, variance * dy**2, variance * (dx * dy))
    return np.stack([part.sum(axis=(1, 2)) for part in parts])


def _fwhm(above: Array, segmentation: Array, peak: Float) -> Float:
    """Return an estimate of the FWHM of each source in pixels.

    It is the diameter of a circle with the area of the source's pixels that are above half of its peak value. `above`
    is the image minus the sky.
    """
    inside = segmentation > 0
    source_index = segmentation[inside] - 1
    high = above[inside] >= 0.5 * peak[source_index]
    return np.asarray(2.0 * np.sqrt(np.bincount(source_index[high], minlength=len(peak)) / np.pi))


def _flag_bits(segmentation: Array, flags: Array, count: int) -> Array:
    """Return the bitwise OR of `flags` in the pixels of each of `count` sources, int16[count]."""
    bits = np.zeros(count + 1, np.int16)
    flagged = (segmentation > 0) & (flags > 0)
    np.bitwise_or.at(bits, segmentation[flagged], flags[flagged].astype(np.int16))
    return bits[1:]


def _flags(detection_flags: Array, aperture_flags: Array, auto_flags: Array, bits: Array) -> Array:
    """Return the FLAGS of SourceExtractor from the flags of sep.

    The arguments are sep's flags of the detection, of all apertures, and of the aperture of MAG_AUTO, and the bits of
    the image's flags in the pixels of each source.
    """
    flags = np.where(detection_flags & sep.OBJ_MERGED, 2, 0) | np.where(detection_flags & sep.OBJ_TRUNC, 8, 0)
    flags |= np.where(auto_flags & (sep.APER_HASMASKED | sep.APER_ALLMASKED), 1, 0)
    flags |= np.where(aperture_flags & sep.APER_TRUNC, 16, 0) | np.where(bits & NO_DATA, 8, 0)
    return np.asarray(flags | np.where(bits & SATURATED, 4, 0), np.int16)


def columns(sources: dict[str, Array], system: WCS, zero_point: float) -> list[ColumnData]:
    """Convert measurements to columns of a FITS_LDAC catalogue with the names and units of SourceExtractor.

    Parameters
    ----------
    sources : dict of str to array
        Measurements from `detect_sources`.
    system : WCS
        WCS of the image.
    zero_point : float
        AB magnitude of a source with the flux 1 in units of the image.

    Returns
    -------
    list of ColumnData
        Name, FITS format code, unit and values of each column. Pixel coordinates count from 1. Magnitudes and their
        errors are 99 if the flux is not positive.
    """
    ra, dec = astrometry.sky_of_pixel(system, sources["x"], sources["y"])
    ra_window, dec_window = astrometry.sky_of_pixel(system, sources["xwin"], sources["ywin"])
    long, short, angle = _axes(*sources["errors"])
    window = _axes(*sources["window_errors"])
    window_sky = _axes(*_sky_moments(system, sources))
    magnitudes = {
        kind: _magnitudes(sources[f"flux_{kind}"], sources[f"fluxerr_{kind}"], zero_point) for kind in ("auto", "aper")
    }
    a, b = sources["a"], sources["b"]
    number = np.arange(1, len(a) + 1)
    return [
        ("NUMBER", "J", "", number),
        ("X_IMAGE", "D", "pixel", sources["x"] + 1.0), ("Y_IMAGE", "D", "pixel", sources["y"] + 1.0),
        ("XWIN_IMAGE", "D", "pixel", sources["xwin"] + 1.0), ("YWIN_IMAGE", "D", "pixel", sources["ywin"] + 1.0),
        ("ERRA_IMAGE", "E", "pixel", long), ("ERRB_IMAGE", "E", "pixel", short), ("ERRTHETA_IMAGE", "E", "deg", angle),
        ("ERRAWIN_IMAGE", "E", "pixel", window[0]), ("ERRBWIN_IMAGE", "E", "pixel", window[1]),
        ("ERRTHETAWIN_IMAGE", "E", "deg", window[2]),
        ("ERRAWIN_WORLD", "E", "deg", window_sky[0]), ("ERRBWIN_WORLD", "E", "deg", window_sky[1]),
        ("ERRTHETAWIN_WORLD", "E", "deg", window_sky[2]),
        ("ALPHA_J2000", "D", "deg", ra), ("DELTA_J2000", "D", "deg", dec),
        ("ALPHAWIN_J2000", "D", "deg", ra_window), ("DELTAWIN_J2000", "D", "deg", dec_window),
        ("FLUX_AUTO", "E", "count", sources["flux_auto"]), ("FLUXERR_AUTO", "E", "count", sources["fluxerr_auto"]),
        ("MAG_AUTO", "E", "mag", magnitudes["auto"][0]), ("MAGERR_AUTO", "E", "mag", magnitudes["auto"][1]),
        ("FLUX_APER", "E", "count", sources["flux_aper"]), ("FLUXERR_APER", "E", "count", sources["fluxerr_aper"]),
        ("MAG_APER", "E", "mag", magnitudes["aper"][0]), ("MAGERR_APER", "E", "mag", magnitudes["aper"][1]),
        ("FLUX_ISO", "E", "count", sources["flux_iso"]), ("FLUX_MAX", "E", "count", sources["flux_max"]),
        ("FLUX_RADIUS", "E", "pixel", sources["flux_radius"]), ("KRON_RADIUS", "E", "", sources["kron"]),
        ("BACKGROUND", "E", "count", sources["background"]), ("THRESHOLD", "E", "count", sources["threshold"]),
        ("ISOAREA_IMAGE", "J", "pixel**2", sources["npix"]), ("FWHM_IMAGE", "E", "pixel", sources["fwhm"]),
        ("A_IMAGE", "E", "pixel", a), ("B_IMAGE", "E", "pixel", b),
        ("THETA_IMAGE", "E", "deg", np.degrees(sources["theta"])), ("ELLIPTICITY", "E", "", 1.0 - b / a),
        ("FLAGS", "I", "", sources["flags"]), ("IMAFLAGS_ISO", "I", "", sources["imaflags"]),
    ]  # fmt: skip


def _sky_moments(system: WCS, sources: dict[str, Array]) -> Float:
    """Return the covariance of the errors of windowed positions on the sky, deg^2: xx, yy and xy, float64[3, n].

    x points east and y north. SourceExtractor counts ERRTHETAWIN_WORLD from x to y.
    """
    xx, yy, xy = sources["window_errors"]
    derivative = astrometry.jacobian(system, sources["xwin"], sources["ywin"]) / 3600.0
    (ux, uy), (vx, vy) = np.moveaxis(derivative, 0, -1)
    # The derivative is that of the position to the west.
    ux, uy = -ux, -uy
    return np.stack([
        ux * ux * xx + 2.0 * ux * uy * xy + uy * uy * yy,
        vx * vx * xx + 2.0 * vx * vy * xy + vy * vy * yy,
        ux * vx * xx + (ux * vy + uy * vx) * xy + uy * vy * yy,
    ])  # fmt: skip


def _axes(xx: Float, yy: Float, xy: Float) -> tuple[Float, Float, Float]:
    """Return semi-major axis, semi-minor axis and position angle of the error ellipse with these second moments.

    Moments are in the square of the unit of the axes. The angle is in degrees from x to y.
    """
    middle, off = 0.5 * (xx + yy), np.hypot(0.5 * (xx - yy), xy)
    angle = np.degrees(0.5 * np.arctan2(2.0 * xy, xx - yy))
    return np.sqrt(middle + off), np.sqrt(np.maximum(middle - off, 0.0)), angle


def _magnitudes(flux: Float, error: Float, zero_point: float) -> tuple[Float, Float]:
    is_positive: Bool = flux > 0.0
    safe_flux = np.where(is_positive, flux, 1.0)
    return (
        np.where(is_positive, zero_point - 2.5 * np.log10(safe_flux), _NO_MAGNITUDE),
        np.where(is_positive, _MAGNITUDE_PER_LN * error / safe_flux, _NO_MAGNITUDE),
    )
