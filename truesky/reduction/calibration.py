"""Calibrate a frame of a CCD: subtract the contributions of the detector, and divide by its response::

    counted = corrected(electrons - bias) - dark current x exposure time
    light = counted / (flat x illumination) - sky x pattern

Here `corrected` removes crosstalk and nonlinearity of the amplifiers. A frame is calibrated in strips of rows to limit
memory.

The pattern contains the fringes of the sky and the varying area of pixels on the sky. It is subtracted and not divided,
because sources have neither: the counts of a star do not depend on the area of a pixel. Charge transfer inefficiency,
the brighter-fatter effect and ghosts are not corrected.
"""

from __future__ import annotations

from collections.abc import Callable, Container, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy import ndimage

from lake_schema.arrays import Array, Bool, Float, Float32
from truesky.reduction import amplifiers
from truesky.reduction.combining import CombinedFrame
from truesky.render.effects.charge import pixel_borders
from truesky.render.effects.light import illumination, pixel_area
from truesky.render.effects.scene import Scene

# Bits of a pixel in the flag map (extension FLG of a calibrated image); the constant FLAGS has their meanings.
NO_DATA, RESPONSE, HOT, SATURATED, UNSURE, COSMIC_RAY, EDGE, PERSISTENCE = 1, 2, 4, 8, 16, 32, 64, 128
# Each bit of the flag map with its meaning, as written to FITS headers.
FLAGS = (
    (NO_DATA, "no data"),
    (RESPONSE, "response far from 1"),
    (HOT, "hot pixel"),
    (SATURATED, "saturated"),
    (UNSURE, "too few frames, or a star in the flat"),
    (COSMIC_RAY, "cosmic ray"),
    (EDGE, "near the edge of the detector, good"),
    (PERSISTENCE, "subtracted persistence above noise, good"),
)
# Flag bits that are only information: pixels with these bits and no others keep their weight.
GOOD = EDGE | PERSISTENCE
# Pixels with a lower value in the master flat get the flag RESPONSE and no weight.
_MIN_RESPONSE = 0.7
# Pixels with a higher value in the master flat get the flag RESPONSE and no weight.
_MAX_RESPONSE = 1.3
# A flat's pixel is flagged UNSURE if it exceeds the median of its neighbourhood by more than this multiple of the rms
# excess of all pixels.
_MAX_DEVIATION = 8.0
# A pixel is hot if its dark current exceeds the median of the detector by more than this multiple of its uncertainty.
_HOT_SIGMA = 8.0
# Pixels within this distance (pixels) of the detector's edge get the flag EDGE: electric fields displace their charge.
_BORDER = 10
# Side, in pixels, of the squares in which the level of the sky is measured.
_MESH = 64
# Side, in pixels, of the square around a flat's pixel whose median the pixel is compared with.
_NEIGHBOURHOOD = 9
# Light above the sky counts as a source if, smoothed by a Gaussian of one pixel, it exceeds its noise by this factor.
_SOURCE_SIGMA = 4.0
# Radius in pixels at which the smoothing Gaussian is truncated.
_SMOOTHING_REACH = 4
# Pixels farther from the sky than this multiple of the scatter do not contribute to the strength of fringes.
_FRINGE_SIGMA = 3.0
# Number of detector rows that are calibrated at a time, to limit memory.
_ROWS = 512


@dataclass(frozen=True, slots=True)
class Masters:
    """Masters (combined calibration frames) of one detector; an omitted master is an image with a constant value.

    Attributes
    ----------
    bias : CombinedFrame
        Bias in electrons. For NISP, the coefficient of the nonlinearity in 1/electron is stored here.
    dark : CombinedFrame
        Dark current in electrons per second.
    flat : CombinedFrame
        Response of each pixel relative to the light that falls on it; 1 if all light is counted.
    flags : uint8 array, shape (ny, nx)
        Flag bits (see `FLAGS`) of pixels that are bad in the dark or the flat.
    dark_time : float
        Mean exposure time of the dark frames in seconds, infinite if unknown. It is needed because the noise of the
        bias, which was subtracted from the darks, is also in the dark current.
    fringes : float32 array, shape (ny, nx), optional
        Fringes in the band as a fraction of the sky; None if they are not corrected.
    """

    bias: CombinedFrame
    dark: CombinedFrame
    flat: CombinedFrame
    flags: Array
    dark_time: float = np.inf
    fringes: Float32 | None = None


@dataclass(frozen=True, slots=True)
class SkyPattern:
    """Pattern of the sky on a detector that sources do not have.

    Attributes
    ----------
    fringes : float32 array, shape (ny, nx), or None
        Fringes as a fraction of the sky; None if they are not corrected.
    strength : float
        Factor of `fringes`: light of the lines that cause fringes relative to that of the sky changes during a night.
    area : (float array, float array, float array) or None
        Columns, rows and coefficients of the change of the pixel area on the sky, the arguments of
        `pixel_area.area_change`; None if the area is not corrected.
    """

    fringes: Float32 | None = None
    strength: float = 1.0
    area: tuple[Float, Float, Float] | None = None

    def factor(self, rows: slice) -> Float | float:
        """Return the sky in the pixels of some rows divided by the sky without fringes in a pixel at the boresight."""
        factor: Float | float = 1.0
        if self.area is not None:
            u, v, stretch = self.area
            factor = 1.0 + pixel_area.area_change(u, v[rows], stretch)
        if self.fringes is not None:
            factor = np.asarray(factor * (1.0 + self.strength * self.fringes[rows]), float)
        return factor


@dataclass(frozen=True, slots=True)
class ReducedImage:
    """A calibrated image.

    Attributes
    ----------
    image : float32 array, shape (ny, nx)
        Light including the sky, in electrons, electrons per second or counts. Pixels without data have no meaningful
        value.
    weight : float32 array, shape (ny, nx)
        Inverse variance in the inverse square of the image's unit; 0 for bad pixels.
    flags : uint8 array, shape (ny, nx)
        Flag bits, see `FLAGS`.
    """

    image: Float
    weight: Float
    flags: Array


def neutral_master(shape: tuple[int, ...], value: float) -> CombinedFrame:
    """Return a master frame of the constant `value` without uncertainty, used if a calibration frame is omitted."""
    # Broadcast a single number to a read-only view of the full shape, which takes no memory.
    mean, uncertainty = (np.broadcast_to(np.float32(number), shape) for number in (value, 0.0))
    return CombinedFrame(mean, uncertainty, np.broadcast_to(np.int16(1), shape))


def illumination_map(scene: Scene, applied: Container[str], rows: slice = slice(None)) -> Float:
    """Return the relative illumination of pixels due to vignetting and the shutter, from the mission parameters.

    Parameters
    ----------
    scene : Scene
        Exposure of the detector with its mission parameters.
    applied : container of str
        Names of the effects that were simulated in the frame. Vignetting or shutter count only if they are among them.
    rows : slice, optional
        Rows of the detector; all by default.

    Returns
    -------
    float array, shape (number of rows, nx)
        Illumination: 1 at the centre of the focal plane, and 1 everywhere if neither effect was simulated.
    """
    out = np.ones((len(range(scene.ny)[rows]), scene.nx))
    for effect in (illumination.EFFECT, illumination.SHUTTER):
        if effect.name in applied:
            columns, along = effect.parameters(scene)
            out = effect.apply(out, columns, along[rows])
    return out


def reading_variance(scene: Scene, applied: Container[str], rows: slice = slice(None)) -> Float:
    """Return the variance of pixels without light, from readout noise and rounding to whole ADU.

    Parameters
    ----------
    scene : Scene
        Exposure of the detector with its mission parameters.
    applied : container of str
        Names of the effects that were simulated in the frame. Readout noise counts only if it is among them.
    rows : slice, optional
        Rows of the detector; all by default.

    Returns
    -------
    float array, shape (number of rows, nx)
        Variance in electrons^2. It is constant within an amplifier.
    """
    shape = len(range(scene.ny)[rows]), scene.nx
    return np.broadcast_to(amplifiers.to_pixels(_amplifier_read_variance(scene, applied), scene, rows), shape)


def _amplifier_read_variance(scene: Scene, applied: Container[str]) -> float | Float:
    """Return the variance of a pixel without light in electrons^2: one value per amplifier, or one for all."""
    noise = scene.amplifier_values("read_noise", "electron") if "read_noise" in applied else 0.0
    return noise**2 + scene.amplifier_values("gain", "electron / adu") ** 2 / 12.0


def is_bad_response(response: Float | Float32) -> Bool:
    """Return True for responses far from 1, outside 0.7 to 1.3, in an array of any shape."""
    return np.asarray(~((response > _MIN_RESPONSE) & (response < _MAX_RESPONSE)))


def response_flags(flat: CombinedFrame) -> Array:
    """Return the flag bits of each pixel that follow from the master flat, uint8[ny, nx].

    RESPONSE marks values outside 0.7 to 1.3. UNSURE marks pixels without an accepted frame, and pixels much brighter
    than their neighbours, which may contain the same star in all flats.
    """
    flags = np.where(is_bad_response(flat.mean), RESPONSE, 0).astype(np.uint8)
    # Take the median along rows, then along columns: as robust as a median over the square, in a tenth of the time.
    smooth = ndimage.median_filter(flat.mean, size=(1, _NEIGHBOURHOOD), mode="nearest")
    off = flat.mean - ndimage.median_filter(smooth, size=(_NEIGHBOURHOOD, 1), mode="nearest")
    rms = 1.4826 * float(np.median(np.abs(off)))
    # Flag only pixels brighter than their neighbours: darker pixels may be real, because dust absorbs light.
    flags[off > _MAX_DEVIATION * rms] |= UNSURE
    flags[flat.count == 0] |= UNSURE
    return flags


def dark_flags(dark: CombinedFrame) -> Array:
    """Return the flag bits of each pixel that follow from the master dark, uint8[ny, nx].

    HOT marks a dark current more than 8 standard deviations above the median of the detector, and UNSURE pixels in
    which no dark frame was accepted.
    """
    above = dark.mean - float(np.median(dark.mean))
    hot = above > _HOT_SIGMA * np.where(np.isfinite(dark.uncertainty), dark.uncertainty, np.inf)
    return (np.where(hot, HOT, 0) | np.where(dark.count == 0, UNSURE, 0)).astype(np.uint8)


def master_flags(shape: tuple[int, int], masters: Mapping[str, CombinedFrame], without: Container[str]) -> Array:
    """Return the flag bits of a detector's pixels that follow from its master flat and master dark.

    Parameters
    ----------
    shape : (int, int)
        Shape (ny, nx) of the detector in pixels.
    masters : mapping of str to CombinedFrame
        Master frames by kind: "flat" and "dark" are required unless they are in `without`.
    without : container of str
        Kinds of masters that are ignored.

    Returns
    -------
    uint8 array, shape (ny, nx)
        Flag bits, see `FLAGS`; 0 everywhere if both kinds are ignored.
    """
    flags = np.zeros(shape, np.uint8)
    if "flat" not in without:
        flags |= response_flags(masters["flat"])
    if "dark" not in without:
        flags |= dark_flags(masters["dark"])
    return flags


def _strips(ny: int) -> Iterator[slice]:
    yield from (slice(first, min(first + _ROWS, ny)) for first in range(0, ny, _ROWS))


def calibrate(
    electrons: Float,
    saturated: Bool,
    masters: Masters,
    scene: Scene,
    applied: Container[str],
    unit: float = 1.0,
    pattern: SkyPattern | None = None,
) -> ReducedImage:
    """Calibrate a frame of a CCD.

    Parameters
    ----------
    electrons : float array, shape (ny, nx)
        Electrons of each pixel above the level of the overscan. The array is overwritten, to save memory.
    saturated : bool array, shape (ny, nx)
        True for saturated pixels, which get the flag SATURATED and the weight 0.
    masters : Masters
        Bias, dark and flat of the detector.
    scene : Scene
        Exposure of the detector with its mission parameters.
    applied : container of str
        Names of effects that were simulated in the frame. Crosstalk, nonlinearity, vignetting and shutter are corrected
        only if they are among them. Readout noise is included in the weights only if it is among them.
    unit : float, optional
        Number by which electrons are divided: 1 for electrons, the exposure time for e-/s, the gain for ADU.
    pattern : SkyPattern, optional
        Fringes and pixel area. Their change of the sky is subtracted; None to skip this.

    Returns
    -------
    ReducedImage
        The calibrated image. Pixels without data, with response 0 or below, or with NaN have the weight 0. Their value
        is 0, or minus the subtracted pattern of the sky.

    Notes
    -----
    Weights contain the shot noise of the expected light (of the sky, and of sources far above it), not of the counted
    light, so that weighted means are unbiased.
    """
    time = scene.exposure_time_s
    electrons -= masters.bias.mean
    image = amplifiers.undo_effects(electrons, scene, applied)
    flags = masters.flags | _edge_flags(scene, applied)
    np.bitwise_or(flags, np.uint8(SATURATED), out=flags, where=saturated)
    del saturated
    flags[amplifiers.unread_pixels(scene)] = NO_DATA
    used = flags & ~np.uint8(GOOD) == 0
    for rows in _strips(scene.ny):
        response = _response(masters, scene, applied, rows)
        has_value = (flags[rows] & NO_DATA == 0) & (response > 0.0) & np.isfinite(image[rows])
        used[rows] &= has_value
        signal = image[rows] - masters.dark.mean[rows] * time
        image[rows] = np.where(has_value, signal, 0.0) / np.where(has_value, response, 1.0)
    subtracted = None if pattern is None else _subtract_pattern(image, pattern, used)
    floor = float(np.median(_amplifier_read_variance(scene, applied)))
    sky, weight = SkyMesh.from_image(image, used), np.zeros(image.shape, np.float32)
    for rows in _strips(scene.ny):
        light = _expected_light(image, used, sky, floor, rows)
        response = _response(masters, scene, applied, rows)
        # The subtracted light has shot noise, too.
        counted = light if subtracted is None else light + subtracted(rows)
        variance = np.maximum(counted * response + masters.dark.mean[rows] * time, 0.0)
        variance += reading_variance(scene, applied, rows)
        variance += ((1.0 - time / masters.dark_time) * masters.bias.uncertainty[rows]) ** 2
        variance += (masters.dark.uncertainty[rows] * time) ** 2
        variance += (light * response * masters.flat.uncertainty[rows]) ** 2
        with np.errstate(divide="ignore", invalid="ignore"):
            pixel_weight = np.where(used[rows], response**2 / variance, 0.0)
        weight[rows] = np.where(np.isfinite(pixel_weight), pixel_weight * unit**2, 0.0)
    image /= unit
    singles: tuple[Any, Any] = (image.astype(np.float32), weight)
    return ReducedImage(*singles, flags)


def _response(masters: Masters, scene: Scene, applied: Container[str], rows: slice) -> Float:
    """Return flat times illumination for the pixels in `rows`; a flat that contains vignetting is used unchanged."""
    flat = masters.flat.mean[rows]
    return np.asarray(flat * (1.0 if masters.flat.vignetted else illumination_map(scene, applied, rows)), float)


def _subtract_pattern(image: Float, pattern: SkyPattern, used: Bool) -> Callable[[slice], Float]:
    """Subtract the change of the sky by a pattern from `image` in place, and return it as a function of the rows.

    The sky is measured in the pixels that are True in `used`, after division by the pattern. The fringes are scaled to
    the image.
    """
    sky = SkyMesh.from_image(image, used, pattern)
    if pattern.fringes is not None:
        pattern = replace(pattern, strength=_fringe_strength(image, pattern, sky, used))
        sky = SkyMesh.from_image(image, used, pattern)

    def change(rows: slice) -> Float:
        return np.asarray(sky.rows(rows) * (pattern.factor(rows) - 1.0), float)

    for rows in _strips(len(image)):
        image[rows] -= change(rows)
    return change


def _fringe_strength(image: Float, pattern: SkyPattern, sky: SkyMesh, used: Bool) -> float:
    """Return the factor by which the fringes of `pattern` fit an image best, by least squares.

    Pixels far from the sky level `sky`, in units of the scatter, are left out. The result is 0 if no pixel is used or
    the pattern has no fringes.
    """
    assert pattern.fringes is not None
    plain, product, square = SkyPattern(area=pattern.area), 0.0, 0.0
    for rows in _strips(len(image)):
        level = sky.rows(rows) * plain.factor(rows)
        good = used[rows] & (level > 0.0)
        excess, fringes = image[rows][good] / level[good] - 1.0, pattern.fringes[rows][good].astype(float)
        if not len(excess):
            continue
        middle = float(np.median(excess))
        is_used = np.abs(excess - middle) < _FRINGE_SIGMA * 1.4826 * float(np.median(np.abs(excess - middle)))
        fringes = fringes[is_used] - fringes[is_used].mean() if is_used.any() else fringes[is_used]
        product += float((fringes * excess[is_used]).sum())
        square += float((fringes**2).sum())
    return product / square if square > 0.0 else 0.0


def _edge_flags(scene: Scene, applied: Container[str]) -> Array:
    """Return the flag EDGE for pixels within 10 pixels of the detector's edge, and 0 for others; uint8[ny, nx].

    Electric fields displace charge there. No pixel is flagged if this effect was not simulated.
    """
    flags = np.zeros((scene.ny, scene.nx), np.uint8)
    if pixel_borders.EDGES.name in applied:
        flags[:_BORDER] = flags[-_BORDER:] = flags[:, :_BORDER] = flags[:, -_BORDER:] = EDGE
    return flags


def expected_light(image: Float, used: Bool, floor: float) -> Float:
    """Return a smooth model of the light in an image, from which a caller computes the shot noise.

    The model is the sky, measured on a mesh, plus the smoothed light of sources more than 4 sigma above the sky.

    Parameters
    ----------
    image : float array, shape (ny, nx)
        Calibrated image in electrons, including the sky.
    used : bool array, shape (ny, nx)
        True for good pixels. Others contribute neither to the sky nor to sources.
    floor : float
        Variance of a pixel without light in electrons^2.

    Returns
    -------
    float array, shape (ny, nx)
        Expected light in electrons, 0 or more.

    Notes
    -----
    The light is smoothed, because a weight must not depend on the noise of the same pixel: weighted means would then be
    too low.
    """
    return _expected_light(image, used, SkyMesh.from_image(image, used), floor, slice(0, len(image)))


def _expected_light(image: Float, used: Bool, mesh: SkyMesh, floor: float, rows: slice) -> Float:
    """Return `expected_light` for the pixels in `rows` only, with the sky level from `mesh`."""
    padded = slice(max(rows.start - _SMOOTHING_REACH, 0), min(rows.stop + _SMOOTHING_REACH, len(image)))
    sky = mesh.rows(padded)
    above = ndimage.gaussian_filter(
        np.where(used[padded], image[padded] - sky, 0.0), 1.0, mode="nearest", radius=_SMOOTHING_REACH
    )
    inner = slice(rows.start - padded.start, rows.stop - padded.start)
    sky, above = sky[inner], above[inner]
    # Smoothing with a Gaussian of sigma = 1 pixel reduces the variance of independent pixels by a factor of 4 pi.
    noise = np.sqrt((np.maximum(sky, 0.0) + floor) / (4.0 * np.pi))
    return np.asarray(np.maximum(sky, 0.0) + np.where(above > _SOURCE_SIGMA * noise, above, 0.0))


def sky_level(image: Float, used: Bool) -> Float:
    """Return the level of the sky in each pixel, float64[ny, nx], measured in the pixels that are True in `used`."""
    return SkyMesh.from_image(image, used).rows(slice(0, len(image)))


@dataclass(frozen=True, slots=True)
class SkyMesh:
    """Level of the sky in an image: medians of squares of about 64 pixels, interpolated linearly between their centres.

    Before the median is taken, pixels more than 3 sigma above it are removed, twice.

    Attributes
    ----------
    values : float array, shape (n, m)
        Level of the sky in each square, in the unit of the image.
    middles : (float array, float array)
        Row numbers (n) and column numbers (m) of the centres of the squares, counted from 0.
    shape : (int, int)
        Shape (ny, nx) of the image.
    """

    values: Float
    middles: tuple[Float, Float]
    shape: tuple[int, int]

    @classmethod
    def from_image(cls, image: Float, used: Bool, pattern: SkyPattern | None = None) -> SkyMesh:
        """Measure the sky of an image.

        Parameters
        ----------
        image : float array, shape (ny, nx)
            Image with the sky.
        used : bool array, shape (ny, nx)
            True for pixels in which the sky is measured.
        pattern : SkyPattern, optional
            Pattern by which the image is divided before.

        Returns
        -------
        SkyMesh
            The sky. A square without used pixels has the level of the nearest square; if all are empty, the sky is 0.
        """
        edges = [np.linspace(0, n, max(n // _MESH, 1) + 1).round().astype(int) for n in image.shape]
        mesh = np.zeros((len(edges[0]) - 1, len(edges[1]) - 1))
        for i, (first_row, past_row) in enumerate(zip(edges[0][:-1], edges[0][1:], strict=True)):
            rows = slice(first_row, past_row)
            band = image[rows] if pattern is None else image[rows] / pattern.factor(rows)
            for j, (first_column, past_column) in enumerate(zip(edges[1][:-1], edges[1][1:], strict=True)):
                values = band[:, first_column:past_column][used[rows, first_column:past_column]]
                for _ in range(2):
                    middle = float(np.median(values)) if values.size else 0.0
                    spread = 1.4826 * float(np.median(np.abs(values - middle))) if values.size else 0.0
                    values = values[values <= middle + 3.0 * spread]
                mesh[i, j] = float(np.median(values)) if values.size else np.nan
        empty = np.isnan(mesh)
        if empty.all():
            mesh[:] = 0.0
        elif empty.any():
            # Give a square without usable pixels the level of the nearest square that has some.
            mesh = mesh[tuple(ndimage.distance_transform_edt(empty, return_distances=False, return_indices=True))]
        along, across = (0.5 * (edge[:-1] + edge[1:] - 1) for edge in edges)
        return cls(mesh, (along, across), (image.shape[0], image.shape[1]))

    def rows(self, rows: slice) -> Float:
        """Return the level of the sky in the rows of a slice with start and stop, float64[number of rows, nx]."""
        across = np.array([np.interp(np.arange(self.shape[1]), self.middles[1], row) for row in self.values])
        # Convert row numbers to fractional indices of squares; rows beyond the outermost centres get the index of the
        # outermost square.
        at = np.interp(np.arange(rows.start, rows.stop), self.middles[0], np.arange(len(self.values)))
        low = np.minimum(at.astype(int), max(len(self.values) - 2, 0))
        fraction, high = (at - low)[:, None], np.minimum(low + 1, len(self.values) - 1)
        return np.asarray((1.0 - fraction) * across[low] + fraction * across[high])
