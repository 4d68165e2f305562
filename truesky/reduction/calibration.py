"""Calibrate a frame: subtract the contributions of the detector, and divide by its response::

    counted = undone(electrons - bias) - dark time
    light = counted / (flat illumination) - fringes of the sky

A frame is calibrated some rows at a time to limit memory.

Charge transfer inefficiency, the brighter-fatter effect and ghosts are not corrected. The varying area of pixels on the
sky is not corrected either. It does not change the counts of a source, so a division that makes the sky flat would give
wrong fluxes of stars. A resampling program gets the area from the WCS.
"""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy import ndimage

from lake_schema.arrays import Array, Bool, Float, Float32
from truesky.reduction import amplifiers
from truesky.reduction.combining import CombinedFrame
from truesky.render.effects.charge import pixel_borders
from truesky.render.effects.light import illumination
from truesky.render.effects.scene import Scene

# Bits of the flags, and their meaning.
NO_DATA, RESPONSE, HOT, SATURATED, UNSURE, COSMIC_RAY, EDGE, PERSISTENCE = 1, 2, 4, 8, 16, 32, 64, 128
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
# Flags of pixels that are used.
GOOD = EDGE | PERSISTENCE
# Limits of the response of a pixel that is used, and its largest difference from its neighbours in units of their rms.
_MIN_RESPONSE, _MAX_RESPONSE, _MAX_DEVIATION = 0.7, 1.3, 8.0
# Standard deviations of a hot pixel above the others in a dark.
_HOT_SIGMA = 8.0
# Distance from an edge, in pixels, within which charge is displaced.
_BORDER = 10
# Side of a square of the mesh on which the sky is measured, and of the neighbourhood of a flat's pixel, in pixels.
_MESH, _NEIGHBOURHOOD = 64, 9
# Standard deviations above the sky at which light, smoothed over a pixel, counts as a source; reach of the smoothing in
# pixels.
_SOURCE_SIGMA, _SMOOTHING_REACH = 4.0, 4
# Rows that are calibrated at a time.
_ROWS = 512


@dataclass(frozen=True, slots=True)
class Masters:
    """Masters of one detector; a missing master is replaced by zeros or ones.

    Attributes
    ----------
    bias : CombinedFrame
        Bias in electrons.
    dark : CombinedFrame
        Dark current in electrons per second.
    flat : CombinedFrame
        Response, 1 if all light is counted.
    flags : uint8 array, shape (ny, nx)
        Flags of the pixels.
    dark_time : float
        Exposure time of the dark frames in seconds. The dark current contains the noise of the bias, too.
    """

    bias: CombinedFrame
    dark: CombinedFrame
    flat: CombinedFrame
    flags: Array
    dark_time: float = np.inf


@dataclass(frozen=True, slots=True)
class ReducedImage:
    """A calibrated image.

    Attributes
    ----------
    image : float32 array, shape (ny, nx)
        Electrons of the exposure (or another unit), including the sky; 0 without a value.
    weight : float32 array, shape (ny, nx)
        Inverse variance; 0 for pixels that must not be used according to their flags.
    flags : uint8 array, shape (ny, nx)
        Flags, see `FLAGS`.
    """

    image: Float
    weight: Float
    flags: Array


def neutral_master(shape: tuple[int, ...], value: float) -> CombinedFrame:
    """Return a constant master, which replaces a missing one."""
    # Broadcast a single number, which takes no memory.
    mean, uncertainty = (np.broadcast_to(np.float32(number), shape) for number in (value, 0.0))
    return CombinedFrame(mean, uncertainty, np.broadcast_to(np.int16(1), shape))


def illumination_map(scene: Scene, applied: Container[str], rows: slice = slice(None)) -> Float:
    """Return the relative illumination of each pixel by the optics and the shutter, from the mission parameters.

    Parameters
    ----------
    scene : Scene
        Scene of the frame.
    applied : container of str
        Names of the effects in the frame.
    rows : slice, optional
        Rows of the detector; all by default.

    Returns
    -------
    float array, shape (ny, nx)
        Illumination, 1 at the centre of the focal plane.
    """
    out = np.ones((len(range(scene.ny)[rows]), scene.nx))
    for effect in (illumination.EFFECT, illumination.SHUTTER):
        if effect.name in applied:
            columns, along = effect.parameters(scene)
            out = effect.apply(out, columns, along[rows])
    return out


def reading_variance(scene: Scene, applied: Container[str], rows: slice = slice(None)) -> Float:
    """Return the variance of a pixel without light, from readout noise and rounding to whole ADU.

    Parameters
    ----------
    scene : Scene
        Scene of the frame.
    applied : container of str
        Names of the effects in the frame.
    rows : slice, optional
        Rows of the detector; all by default.

    Returns
    -------
    float array, shape (ny, nx)
        Variance in electrons^2.
    """
    shape = len(range(scene.ny)[rows]), scene.nx
    return np.broadcast_to(amplifiers.to_pixels(_amplifier_read_variance(scene, applied), scene, rows), shape)


def _amplifier_read_variance(scene: Scene, applied: Container[str]) -> float | Float:
    """Return the variance of a pixel without light for each amplifier, in electrons^2."""
    noise = scene.amplifier_values("read_noise", "electron") if "read_noise" in applied else 0.0
    return noise**2 + scene.amplifier_values("gain", "electron / adu") ** 2 / 12.0


def response_flags(flat: CombinedFrame) -> Array:
    """Flag pixels with a response far from 1, and pixels with light of a star that clipping did not remove."""
    flags = np.where((flat.mean > _MIN_RESPONSE) & (flat.mean < _MAX_RESPONSE), 0, RESPONSE).astype(np.uint8)
    # A median of medians is as robust as a median in two dimensions, and takes a tenth of the time.
    smooth = ndimage.median_filter(flat.mean, size=(1, _NEIGHBOURHOOD), mode="nearest")
    off = flat.mean - ndimage.median_filter(smooth, size=(_NEIGHBOURHOOD, 1), mode="nearest")
    rms = 1.4826 * float(np.median(np.abs(off)))
    # Only excesses are flagged, since dust dims some pixels more than their neighbours.
    flags[off > _MAX_DEVIATION * rms] |= UNSURE
    flags[flat.count == 0] |= UNSURE
    return flags


def dark_flags(dark: CombinedFrame) -> Array:
    """Flag pixels with a much higher dark current than others."""
    above = dark.mean - float(np.median(dark.mean))
    hot = above > _HOT_SIGMA * np.where(np.isfinite(dark.uncertainty), dark.uncertainty, np.inf)
    return (np.where(hot, HOT, 0) | np.where(dark.count == 0, UNSURE, 0)).astype(np.uint8)


def master_flags(shape: tuple[int, int], masters: Mapping[str, CombinedFrame], without: Container[str]) -> Array:
    """Return flags of a detector's pixels from its flat and its dark.

    Parameters
    ----------
    shape : (int, int)
        Shape of the detector.
    masters : mapping of str to CombinedFrame
        Masters by kind.
    without : container of str
        Kinds of masters that are not used.

    Returns
    -------
    uint8 array, shape (ny, nx)
        Flags.
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
    fringes: Float32 | None = None,
) -> ReducedImage:
    """Calibrate a frame.

    Parameters
    ----------
    electrons : float array, shape (ny, nx)
        Electrons above the level of the overscan.
    saturated : bool array, shape (ny, nx)
        True for saturated pixels.
    masters : Masters
        Masters of the detector.
    scene : Scene
        Scene of the frame.
    applied : container of str
        Names of the effects in the frame that are undone.
    unit : float, optional
        Electrons of the exposure per unit of the image: 1 for electrons, the exposure time for e-/s, the gain for ADU.
    fringes : float32 array, shape (ny, nx), optional
        Fringes relative to the sky in each pixel, which are subtracted.

    Returns
    -------
    ReducedImage
        The image in the required unit.

    Notes
    -----
    Weights contain the shot noise of the expected light (of the sky, and of sources far above it), not of the counted
    light.
    """
    time = scene.exposure_time_s
    image = amplifiers.undo_effects(electrons - masters.bias.mean, scene, applied)
    del electrons
    flags = masters.flags | _edge_flags(scene, applied)
    np.bitwise_or(flags, np.uint8(SATURATED), out=flags, where=saturated)
    flags[amplifiers.unread_pixels(scene)] = NO_DATA
    used = flags & ~np.uint8(GOOD) == 0
    for rows in _strips(scene.ny):
        response = _response(masters, scene, applied, rows)
        has_value = (flags[rows] & NO_DATA == 0) & (response > 0.0) & np.isfinite(image[rows])
        used[rows] &= has_value
        signal = image[rows] - masters.dark.mean[rows] * time
        image[rows] = np.where(has_value, signal, 0.0) / np.where(has_value, response, 1.0)
    if fringes is not None:
        _subtract_fringes(image, fringes, used)
    floor = float(np.median(_amplifier_read_variance(scene, applied)))
    sky, weight = SkyMesh.from_image(image, used), np.zeros(image.shape, np.float32)
    for rows in _strips(scene.ny):
        light = _expected_light(image, used, sky, floor, rows)
        response = _response(masters, scene, applied, rows)
        variance = np.maximum(light * response + masters.dark.mean[rows] * time, 0.0)
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
    """Return the fraction of light that is counted in each pixel of some rows."""
    flat = masters.flat.mean[rows]
    return np.asarray(flat * (1.0 if masters.flat.vignetted else illumination_map(scene, applied, rows)), float)


def _subtract_fringes(image: Float, fringes: Float32, used: Bool) -> None:
    """Subtract the fringes of the sky in place; their amplitude is proportional to the level of the sky."""
    sky = SkyMesh.from_image(image / (1.0 + fringes), used)
    for rows in _strips(len(image)):
        image[rows] -= sky.rows(rows) * fringes[rows]


def _edge_flags(scene: Scene, applied: Container[str]) -> Array:
    """Return the flag EDGE for pixels near the edge, which the field at the edge displaces; uint8[ny, nx]."""
    flags = np.zeros((scene.ny, scene.nx), np.uint8)
    if pixel_borders.EDGES.name in applied:
        flags[:_BORDER] = flags[-_BORDER:] = flags[:, :_BORDER] = flags[:, -_BORDER:] = EDGE
    return flags


def expected_light(image: Float, used: Bool, floor: float) -> Float:
    """Return the expected light: the sky on a mesh, plus smoothed light of sources far above it.

    Parameters
    ----------
    image : float array, shape (ny, nx)
        Image in electrons.
    used : bool array, shape (ny, nx)
        True for good pixels.
    floor : float
        Variance of a pixel without light in electrons^2.

    Returns
    -------
    float array, shape (ny, nx)
        Expected light in electrons, 0 or more.

    Notes
    -----
    A pixel's weight must not depend on the pixel's noise, since weighted means would then be too low.
    """
    return _expected_light(image, used, SkyMesh.from_image(image, used), floor, slice(0, len(image)))


def _expected_light(image: Float, used: Bool, mesh: SkyMesh, floor: float, rows: slice) -> Float:
    """Return the expected light of some rows, with the sky from `mesh`."""
    padded = slice(max(rows.start - _SMOOTHING_REACH, 0), min(rows.stop + _SMOOTHING_REACH, len(image)))
    sky = mesh.rows(padded)
    above = ndimage.gaussian_filter(
        np.where(used[padded], image[padded] - sky, 0.0), 1.0, mode="nearest", radius=_SMOOTHING_REACH
    )
    inner = slice(rows.start - padded.start, rows.stop - padded.start)
    sky, above = sky[inner], above[inner]
    # Smoothing with a Gaussian of one pixel averages the noise of 4 pi pixels.
    noise = np.sqrt((np.maximum(sky, 0.0) + floor) / (4.0 * np.pi))
    return np.asarray(np.maximum(sky, 0.0) + np.where(above > _SOURCE_SIGMA * noise, above, 0.0))


def sky_level(image: Float, used: Bool) -> Float:
    """Return the sky of an image from a mesh, float64[ny, nx]."""
    return SkyMesh.from_image(image, used).rows(slice(0, len(image)))


@dataclass(frozen=True, slots=True)
class SkyMesh:
    """Sky of an image: clipped medians of squares, interpolated linearly between their centres.

    Medians are clipped twice from above.

    Attributes
    ----------
    values : float array, shape (n, m)
        Level of each square.
    middles : (float array, float array)
        Centres of the squares in rows and in columns.
    shape : (int, int)
        Shape of the image.
    """

    values: Float
    middles: tuple[Float, Float]
    shape: tuple[int, int]

    @classmethod
    def from_image(cls, image: Float, used: Bool) -> SkyMesh:
        """Return the sky of an image [ny, nx], measured in the pixels that are True in `used`."""
        edges = [np.linspace(0, n, max(n // _MESH, 1) + 1).round().astype(int) for n in image.shape]
        mesh = np.zeros((len(edges[0]) - 1, len(edges[1]) - 1))
        for i, (first_row, past_row) in enumerate(zip(edges[0][:-1], edges[0][1:], strict=True)):
            for j, (first_column, past_column) in enumerate(zip(edges[1][:-1], edges[1][1:], strict=True)):
                values = image[first_row:past_row, first_column:past_column][
                    used[first_row:past_row, first_column:past_column]
                ]
                for _ in range(2):
                    middle = float(np.median(values)) if values.size else 0.0
                    spread = 1.4826 * float(np.median(np.abs(values - middle))) if values.size else 0.0
                    values = values[values <= middle + 3.0 * spread]
                mesh[i, j] = float(np.median(values)) if values.size else np.nan
        empty = np.isnan(mesh)
        if empty.all():
            mesh[:] = 0.0
        elif empty.any():
            # A square without a pixel has the level of the nearest one.
            mesh = mesh[tuple(ndimage.distance_transform_edt(empty, return_distances=False, return_indices=True))]
        along, across = (0.5 * (edge[:-1] + edge[1:] - 1) for edge in edges)
        return cls(mesh, (along, across), (image.shape[0], image.shape[1]))

    def rows(self, rows: slice) -> Float:
        """Return the sky in some rows."""
        across = np.array([np.interp(np.arange(self.shape[1]), self.middles[1], row) for row in self.values])
        # Position in units of squares. Beyond the outermost centres the sky is constant.
        at = np.interp(np.arange(rows.start, rows.stop), self.middles[0], np.arange(len(self.values)))
        low = np.minimum(at.astype(int), max(len(self.values) - 2, 0))
        fraction, high = (at - low)[:, None], np.minimum(low + 1, len(self.values) - 1)
        return np.asarray((1.0 - fraction) * across[low] + fraction * across[high])
