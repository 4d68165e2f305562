"""Calibration of a frame: what its detector added is taken off, what it kept of the light is divided out.

counted = linearised(without_crosstalk(electrons - bias)) - dark time;  light = counted / (flat illumination)

Masters        bias, dark and flat of a detector, with their uncertainties and flags
Reduced        a calibrated image, its weight, its flags
reduced        a frame's electrons above the overscan -> Reduced
counted        electrons above the bias -> as they came to the amplifiers
illuminated    what the optics and the shutter bring to each pixel, as the mission declares it

What is not undone: charge transfer inefficiency, the brighter-fatter effect, ghosts.
"""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from jobs.render.effects.charge import pixel_borders
from jobs.render.effects.light import illumination
from jobs.render.effects.readout import crosstalk, nonlinearity
from jobs.render.effects.scene import Scene
from jobs.render.reduction import amplifiers
from jobs.render.reduction.combining import Combined
from lake_schema.arrays import Array, Bool, Float

# Bits of the flags, and their meaning.
NO_DATA, RESPONSE, HOT, SATURATED, UNSURE, COSMIC_RAY, EDGE = 1, 2, 4, 8, 16, 32, 64
FLAGS = (
    (NO_DATA, "no data"),
    (RESPONSE, "response far from 1"),
    (HOT, "hot pixel"),
    (SATURATED, "saturated"),
    (UNSURE, "too few frames, or a star in the flat"),
    (COSMIC_RAY, "cosmic ray"),
    (EDGE, "beside the edge of the detector, good"),
)
# What a pixel may have that is used all the same.
_GOOD = EDGE
# Response of a pixel that is used, and its largest difference from its neighbours', in units of their rms.
_LEAST, _MOST, _SPREAD = 0.7, 1.3, 8.0
# Standard deviations of a dark's pixel above the others.
_HOT = 8.0
# Pixels beside an edge at which charge is displaced.
_BORDER = 10
# Pixels of the mesh on which the level of the sky is taken, and of a side of the neighbours of a pixel of the flat.
_MESH, _NEAR = 64, 9
# Standard deviations above the sky, smoothed over a pixel, from which light counts as a source's.
_SOURCE = 4.0


@dataclass(frozen=True, slots=True)
class Masters:
    """Of one detector; without one of them: zeros, or ones.

    bias : e-;  dark : e-/s;  flat : response, 1 where all light is counted
    flags : uint8[ny, nx];  dark_time : s that the dark's frames have lasted: the noise of the bias is in them, too
    """

    bias: Combined
    dark: Combined
    flat: Combined
    flags: Array
    dark_time: float = np.inf


@dataclass(frozen=True, slots=True)
class Reduced:
    """A calibrated image [ny, nx].

    image  : float32, electrons of the exposure (or another unit), the sky in it; 0 where there is no value
    weight : float32, inverse variance, 0 where flags say not to use it
    flags  : uint8
    """

    image: Float
    weight: Float
    flags: Array


def nothing(shape: tuple[int, ...], value: float) -> Combined:
    """What stands for a master that there is none of."""
    count = np.ones(shape, np.int16)
    return Combined(np.full(shape, value, np.float32), np.zeros(shape, np.float32), count)


def illuminated(scene: Scene, applied: Container[str]) -> Float:
    """What of the light reaches each pixel [ny, nx], 1 in the middle of the focal plane: as the mission declares it."""
    out = np.ones((scene.ny, scene.nx))
    for effect in (illumination.EFFECT, illumination.SHUTTER):
        if effect.name in applied:
            out = effect.apply(out, *effect.parameters(scene))
    return out


def reading_variance(scene: Scene, applied: Container[str]) -> Float:
    """Variance [ny, nx] of what is read where there is no light: reading, rounding to whole ADU; e-^2."""
    noise = scene.of_amplifiers("read_noise", "electron") if "read_noise" in applied else 0.0
    gain = scene.of_amplifiers("gain", "electron / adu")
    return np.broadcast_to(amplifiers.of_pixels(noise**2 + gain**2 / 12.0, scene), (scene.ny, scene.nx))


def response_flags(flat: Combined) -> Array:
    """Pixels whose response is far from 1, or in which a star has shone that the clipping left."""
    flags = np.where((flat.mean > _LEAST) & (flat.mean < _MOST), 0, RESPONSE).astype(np.uint8)
    smooth = ndimage.median_filter(flat.mean, size=_NEAR, mode="nearest")
    off = flat.mean - smooth
    rms = 1.4826 * float(np.median(np.abs(off)))
    # Dust dims a few pixels by more than their neighbours, and is no star.
    flags[off > _SPREAD * rms] |= UNSURE
    flags[flat.count == 0] |= UNSURE
    return flags


def dark_flags(dark: Combined) -> Array:
    """Pixels in which far more charge is set free than in the others."""
    above = dark.mean - float(np.median(dark.mean))
    hot = above > _HOT * np.where(np.isfinite(dark.uncertainty), dark.uncertainty, np.inf)
    return (np.where(hot, HOT, 0) | np.where(dark.count == 0, UNSURE, 0)).astype(np.uint8)


def counted(above: Float, scene: Scene, applied: Container[str]) -> Float:
    """Electrons [ny, nx] above the bias as they were read -> as they came to the amplifiers.

    above   : of a frame;  scene : what effects may know of it
    applied : names of the effects that are undone, where they are of the amplifiers
    """
    out = amplifiers.without_crosstalk(above, scene) if crosstalk.EFFECT.name in applied else above
    return amplifiers.linearised(out, scene) if nonlinearity.EFFECT.name in applied else out


def reduced(
    electrons: Float, full: Bool, masters: Masters, scene: Scene, applied: Container[str], unit: float = 1.0
) -> Reduced:
    """Calibrate a frame.

    electrons : [ny, nx] above the level of the overscan;  full : pixels that read no less than a saturated one
    masters   : of its detector;  scene : what effects may know of it
    applied   : names of the effects that are in the frame, and are undone
    unit      : electrons of the exposure that the image's unit is: 1; the exposure time for e-/s; the gain for ADU
    Error     : of the weight: shot noise of the light that is expected (the sky, and what is far above it), not counted
    """
    time = scene.exposure_time_s
    came = counted(electrons - masters.bias.mean, scene, applied)
    dark = masters.dark.mean * time
    flags = masters.flags | np.where(full, SATURATED, 0).astype(np.uint8) | _edges(scene, applied)
    flags[amplifiers.unread(scene)] = NO_DATA
    response = masters.flat.mean * (1.0 if masters.flat.vignetted else illuminated(scene, applied))
    known = (flags & NO_DATA == 0) & (response > 0.0) & np.isfinite(came)
    used = known & (flags & ~np.uint8(_GOOD) == 0)
    image = np.where(known, came - dark, 0.0) / np.where(known, response, 1.0)
    reading = reading_variance(scene, applied)
    light = expected(image, used, float(np.median(reading)))
    variance = np.maximum(light * response + dark, 0.0) + reading
    variance += ((1.0 - time / masters.dark_time) * masters.bias.uncertainty) ** 2
    variance += (masters.dark.uncertainty * time) ** 2 + (light * response * masters.flat.uncertainty) ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        weight = np.where(used, response**2 / variance, 0.0)
    return Reduced(
        (image / unit).astype(np.float32), np.where(np.isfinite(weight), weight * unit**2, 0.0).astype(np.float32),
        flags,
    )  # fmt: skip


def _edges(scene: Scene, applied: Container[str]) -> Array:
    """Bits [ny, nx] of the last pixels of a detector that the field at its edge displaces."""
    flags = np.zeros((scene.ny, scene.nx), np.uint8)
    if pixel_borders.EDGES.name in applied:
        flags[:_BORDER] = flags[-_BORDER:] = flags[:, :_BORDER] = flags[:, -_BORDER:] = EDGE
    return flags


def expected(image: Float, used: Bool, floor: float) -> Float:
    """Light of the sky, on a mesh, and of what is far above it, smoothed: e- [ny, nx], nowhere below 0.

    floor : variance of a pixel without light.  A pixel's own noise must not tell its weight: means would be too low.
    """
    sky = level(image, used)
    above = ndimage.gaussian_filter(np.where(used, image - sky, 0.0), 1.0, mode="nearest")
    # A Gaussian of one pixel averages the noise of 4 pi of them.
    noise = np.sqrt((np.maximum(sky, 0.0) + floor) / (4.0 * np.pi))
    return np.asarray(np.maximum(sky, 0.0) + np.where(above > _SOURCE * noise, above, 0.0))


def level(image: Float, used: Bool) -> Float:
    """The sky [ny, nx]: medians of a mesh's squares, clipped from above twice, linear between their middles."""
    edges = [np.linspace(0, n, max(n // _MESH, 1) + 1).round().astype(int) for n in image.shape]
    mesh = np.zeros((len(edges[0]) - 1, len(edges[1]) - 1))
    for i, (down, up) in enumerate(zip(edges[0][:-1], edges[0][1:], strict=True)):
        for j, (left, right) in enumerate(zip(edges[1][:-1], edges[1][1:], strict=True)):
            values = image[down:up, left:right][used[down:up, left:right]]
            for _ in range(2):
                middle = float(np.median(values)) if values.size else 0.0
                spread = 1.4826 * float(np.median(np.abs(values - middle))) if values.size else 0.0
                values = values[values <= middle + 3.0 * spread]
            mesh[i, j] = float(np.median(values)) if values.size else np.nan
    empty = np.isnan(mesh)
    if empty.all():
        return np.zeros(image.shape)
    # A square without a pixel has the level of the nearest one.
    mesh = mesh[tuple(ndimage.distance_transform_edt(empty, return_distances=False, return_indices=True))]
    middles = [0.5 * (edge[:-1] + edge[1:] - 1) for edge in edges]
    across = np.array([np.interp(np.arange(image.shape[1]), middles[1], row) for row in mesh])
    weights = np.array([np.interp(np.arange(image.shape[0]), middles[0], row) for row in np.eye(len(mesh))])
    return np.asarray(np.einsum("ry,rx->yx", weights, across))
