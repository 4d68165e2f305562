"""Calibration of a frame: what its detector added is taken off, what it kept of the light is divided out.

counted = undone(electrons - bias) - dark time;  light = counted / (flat illumination) - fringes of the sky

Masters        bias, dark and flat of a detector, with their uncertainties and flags
Reduced        a calibrated image, its weight, its flags
reduced        a frame's electrons above the overscan -> Reduced
illuminated    what the optics and the shutter bring to each pixel, as the mission declares it

A frame is calibrated some rows at a time: memory. What is not undone: charge transfer inefficiency, the brighter-fatter
effect, ghosts; and the area of the sky that a pixel sees. What a source brings knows nothing of that: a sky made flat
by it would leave stars wrong by as much. It is the WCS that tells it to who resamples.
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
    (EDGE, "beside the edge of the detector, good"),
    (PERSISTENCE, "earlier exposures left more than noise; off, good"),
)
# What a pixel may have that is used all the same.
GOOD = EDGE | PERSISTENCE
# Response of a pixel that is used, and its largest difference from its neighbours', in units of their rms.
_MIN_RESPONSE, _MAX_RESPONSE, _MAX_DEVIATION = 0.7, 1.3, 8.0
# Standard deviations of a dark's pixel above the others.
_HOT_SIGMA = 8.0
# Pixels beside an edge at which charge is displaced.
_BORDER = 10
# Pixels of the mesh on which the level of the sky is taken, and of a side of the neighbours of a pixel of the flat.
_MESH, _NEIGHBOURHOOD = 64, 9
# Standard deviations above the sky, smoothed over a pixel, from which light counts as a source's; pixels that the
# smoothing reaches.
_SOURCE_SIGMA, _SMOOTHING_REACH = 4.0, 4
# Rows that are calibrated at a time.
_ROWS = 512


@dataclass(frozen=True, slots=True)
class Masters:
    """Of one detector; without one of them: zeros, or ones.

    bias : e-;  dark : e-/s;  flat : response, 1 where all light is counted
    flags : uint8[ny, nx];  dark_time : s that the dark's frames have lasted: the noise of the bias is in them, too
    """

    bias: CombinedFrame
    dark: CombinedFrame
    flat: CombinedFrame
    flags: Array
    dark_time: float = np.inf


@dataclass(frozen=True, slots=True)
class ReducedImage:
    """A calibrated image [ny, nx].

    image  : float32, electrons of the exposure (or another unit), the sky in it; 0 where there is no value
    weight : float32, inverse variance, 0 where flags say not to use it
    flags  : uint8
    """

    image: Float
    weight: Float
    flags: Array


def neutral_master(shape: tuple[int, ...], value: float) -> CombinedFrame:
    """What stands for a master that there is none of."""
    # One number for all: it takes no memory.
    mean, uncertainty = (np.broadcast_to(np.float32(number), shape) for number in (value, 0.0))
    return CombinedFrame(mean, uncertainty, np.broadcast_to(np.int16(1), shape))


def illumination_map(scene: Scene, applied: Container[str], rows: slice = slice(None)) -> Float:
    """What of the light reaches each pixel [ny, nx], 1 in the middle of the focal plane: as the mission declares it.

    rows : of the detector, all of them or some
    """
    out = np.ones((len(range(scene.ny)[rows]), scene.nx))
    for effect in (illumination.EFFECT, illumination.SHUTTER):
        if effect.name in applied:
            columns, along = effect.parameters(scene)
            out = effect.apply(out, columns, along[rows])
    return out


def reading_variance(scene: Scene, applied: Container[str], rows: slice = slice(None)) -> Float:
    """Variance [ny, nx] of what is read where there is no light: reading, rounding to whole ADU; e-^2.

    rows : of the detector, all of them or some
    """
    shape = len(range(scene.ny)[rows]), scene.nx
    return np.broadcast_to(amplifiers.to_pixels(_amplifier_read_variance(scene, applied), scene, rows), shape)


def _amplifier_read_variance(scene: Scene, applied: Container[str]) -> float | Float:
    """The same of each amplifier, [q]."""
    noise = scene.amplifier_values("read_noise", "electron") if "read_noise" in applied else 0.0
    return noise**2 + scene.amplifier_values("gain", "electron / adu") ** 2 / 12.0


def response_flags(flat: CombinedFrame) -> Array:
    """Pixels whose response is far from 1, or in which a star has shone that the clipping left."""
    flags = np.where((flat.mean > _MIN_RESPONSE) & (flat.mean < _MAX_RESPONSE), 0, RESPONSE).astype(np.uint8)
    # A median of medians: as robust, and a tenth of the time.
    smooth = ndimage.median_filter(flat.mean, size=(1, _NEIGHBOURHOOD), mode="nearest")
    off = flat.mean - ndimage.median_filter(smooth, size=(_NEIGHBOURHOOD, 1), mode="nearest")
    rms = 1.4826 * float(np.median(np.abs(off)))
    # Dust dims a few pixels by more than their neighbours, and is no star.
    flags[off > _MAX_DEVIATION * rms] |= UNSURE
    flags[flat.count == 0] |= UNSURE
    return flags


def dark_flags(dark: CombinedFrame) -> Array:
    """Pixels in which far more charge is set free than in the others."""
    above = dark.mean - float(np.median(dark.mean))
    hot = above > _HOT_SIGMA * np.where(np.isfinite(dark.uncertainty), dark.uncertainty, np.inf)
    return (np.where(hot, HOT, 0) | np.where(dark.count == 0, UNSURE, 0)).astype(np.uint8)


def master_flags(shape: tuple[int, int], masters: Mapping[str, CombinedFrame], without: Container[str]) -> Array:
    """Flags [ny, nx] of a detector's pixels by its flat and its dark; without : masters that are not wanted."""
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

    electrons : [ny, nx] above the level of the overscan;  full : pixels that read no less than a saturated one
    masters   : of its detector;  scene : what effects may know of it
    applied   : names of the effects that are in the frame, and are undone
    unit      : electrons of the exposure that the image's unit is: 1; the exposure time for e-/s; the gain for ADU
    fringes   : [ny, nx] over the sky that each pixel sees, that are taken off
    Error     : of the weight: shot noise of the light that is expected (the sky, and what is far above it), not counted
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
    """What of the light that comes from the sky is counted in each pixel of some rows."""
    flat = masters.flat.mean[rows]
    return np.asarray(flat * (1.0 if masters.flat.vignetted else illumination_map(scene, applied, rows)), float)


def _subtract_fringes(image: Float, fringes: Float32, used: Bool) -> None:
    """Of the image, in place: fringes of the sky, whose level they follow."""
    sky = SkyMesh.from_image(image / (1.0 + fringes), used)
    for rows in _strips(len(image)):
        image[rows] -= sky.rows(rows) * fringes[rows]


def _edge_flags(scene: Scene, applied: Container[str]) -> Array:
    """Bits [ny, nx] of the last pixels of a detector that the field at its edge displaces."""
    flags = np.zeros((scene.ny, scene.nx), np.uint8)
    if pixel_borders.EDGES.name in applied:
        flags[:_BORDER] = flags[-_BORDER:] = flags[:, :_BORDER] = flags[:, -_BORDER:] = EDGE
    return flags


def expected_light(image: Float, used: Bool, floor: float) -> Float:
    """Light of the sky, on a mesh, and of what is far above it, smoothed: e- [ny, nx], nowhere below 0.

    floor : variance of a pixel without light.  A pixel's own noise must not tell its weight: means would be too low.
    """
    return _expected_light(image, used, SkyMesh.from_image(image, used), floor, slice(0, len(image)))


def _expected_light(image: Float, used: Bool, mesh: SkyMesh, floor: float, rows: slice) -> Float:
    """The same of some rows, of which the mesh tells the sky."""
    padded = slice(max(rows.start - _SMOOTHING_REACH, 0), min(rows.stop + _SMOOTHING_REACH, len(image)))
    sky = mesh.rows(padded)
    above = ndimage.gaussian_filter(
        np.where(used[padded], image[padded] - sky, 0.0), 1.0, mode="nearest", radius=_SMOOTHING_REACH
    )
    inner = slice(rows.start - padded.start, rows.stop - padded.start)
    sky, above = sky[inner], above[inner]
    # A Gaussian of one pixel averages the noise of 4 pi of them.
    noise = np.sqrt((np.maximum(sky, 0.0) + floor) / (4.0 * np.pi))
    return np.asarray(np.maximum(sky, 0.0) + np.where(above > _SOURCE_SIGMA * noise, above, 0.0))


def sky_level(image: Float, used: Bool) -> Float:
    """The sky [ny, nx], of its mesh."""
    return SkyMesh.from_image(image, used).rows(slice(0, len(image)))


@dataclass(frozen=True, slots=True)
class SkyMesh:
    """The sky of an image: medians of a mesh's squares, clipped from above twice, linear between their middles.

    values : [n, m];  middles : of the squares along the rows and along the columns;  shape : of the image
    """

    values: Float
    middles: tuple[Float, Float]
    shape: tuple[int, int]

    @classmethod
    def from_image(cls, image: Float, used: Bool) -> SkyMesh:
        """Of an image [ny, nx], of the pixels that are used."""
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
        """The sky of some rows, from the first to one past the last."""
        across = np.array([np.interp(np.arange(self.shape[1]), self.middles[1], row) for row in self.values])
        # In squares; the outermost level is held beyond their middles.
        at = np.interp(np.arange(rows.start, rows.stop), self.middles[0], np.arange(len(self.values)))
        low = np.minimum(at.astype(int), max(len(self.values) - 2, 0))
        fraction, high = (at - low)[:, None], np.minimum(low + 1, len(self.values) - 1)
        return np.asarray((1.0 - fraction) * across[low] + fraction * across[high])
