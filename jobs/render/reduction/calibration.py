"""Calibration of a frame: what its detector added is taken off, what it kept of the light is divided out.

counted = linearised(electrons - bias) - dark time;  light = counted / (flat illumination)

Masters        bias, dark and flat of a detector, with their uncertainties and flags
Reduced        a calibrated image, its weight, its flags
reduced        a frame's electrons above the overscan -> Reduced
linearised, of_pixels    by amplifier: the inverse of the amplifiers' response; their numbers as a map
illuminated    what the optics and the shutter bring to each pixel, as the mission declares it

What is not undone: charge transfer inefficiency, the brighter-fatter effect, crosstalk, ghosts.
"""

from __future__ import annotations

from collections.abc import Container
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from jobs.render.channels import readout
from jobs.render.effects.light import illumination
from jobs.render.effects.readout import nonlinearity
from jobs.render.effects.scene import Scene
from jobs.render.reduction.combining import Combined
from lake_schema.arrays import Array, Bool, Float

# Bits of the flags, and their meaning.
NO_DATA, RESPONSE, HOT, SATURATED, UNSURE, COSMIC_RAY = 1, 2, 4, 8, 16, 32
FLAGS = (
    (NO_DATA, "no data"),
    (RESPONSE, "response far from 1"),
    (HOT, "hot pixel"),
    (SATURATED, "saturated"),
    (UNSURE, "too few frames, or a star in the flat"),
    (COSMIC_RAY, "cosmic ray: unlike other exposures"),
)
# Response of a pixel that is used, and its largest difference from its neighbours', in units of their rms.
_LEAST, _MOST, _SPREAD = 0.7, 1.3, 8.0
# Standard deviations of a dark's pixel above the others.
_HOT = 8.0
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

    image  : float32, electrons of the exposure (or e-/s), the sky in it
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


def of_pixels(numbers: float | Float, shape: tuple[int, ...], middle: int) -> float | Float:
    """Numbers [4] of the amplifiers as a map [ny, nx] of their pixels; one number stays one."""
    if np.ndim(numbers) == 0:
        return numbers
    return readout.quadrant_map(np.asarray(numbers), shape, middle)


def linearised(frame: Float, scene: Scene) -> Float:
    """Electrons [ny, nx] above the bias, as the amplifiers gave them -> as they came."""
    curve = nonlinearity.parameters(scene)
    if all(np.ndim(number) == 0 for number in curve):
        return nonlinearity.linearised(frame, *curve)
    # Amplifier by amplifier; between the halves nothing is read.
    which = readout.quadrant_map(np.arange(1.0, 5.0), frame.shape, scene.middle)
    out = np.zeros(frame.shape)
    for number in range(4):
        own = which == number + 1.0
        out[own] = nonlinearity.linearised(frame[own], *(n[number] if isinstance(n, np.ndarray) else n for n in curve))
    return out


def illuminated(scene: Scene, applied: Container[str]) -> Float:
    """What of the light reaches each pixel [ny, nx], 1 in the middle of the focal plane: as the mission declares it."""
    out = np.ones((scene.ny, scene.nx))
    for effect in (illumination.EFFECT, illumination.SHUTTER):
        if effect.name in applied:
            out = effect.apply(out, *effect.parameters(scene))
    return out


def reading_variance(scene: Scene, applied: Container[str]) -> Float:
    """Variance [ny, nx] of what is read where there is no light: reading, rounding to whole ADU; e-^2."""
    shape = (scene.ny, scene.nx)
    noise = scene.of_amplifiers("read_noise", "electron") if "read_noise" in applied else 0.0
    gain = scene.of_amplifiers("gain", "electron / adu")
    return np.broadcast_to(of_pixels(noise**2 + gain**2 / 12.0, shape, scene.middle), shape)


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


def reduced(
    electrons: Float, full: Bool, masters: Masters, scene: Scene, applied: Container[str], per_second: bool = False
) -> Reduced:
    """Calibrate a frame.

    electrons : [ny, nx] above the level of the overscan;  full : pixels that read no less than a saturated one
    masters   : of its detector;  scene : what effects may know of it
    applied   : names of the effects that are in the frame
    per_second : e-/s instead of the electrons of the exposure
    Error     : of the weight: shot noise of the light that is expected (the sky, and what is far above it), not counted
    """
    time = scene.exposure_time_s
    counted = electrons - masters.bias.mean
    if "nonlinearity" in applied:
        counted = linearised(counted, scene)
    dark = masters.dark.mean * time
    flags = masters.flags | np.where(full, SATURATED, 0).astype(np.uint8)
    flags[slice(*scene.unread)] = NO_DATA
    response = masters.flat.mean * (1.0 if masters.flat.vignetted else illuminated(scene, applied))
    used = (flags == 0) & (response > 0.0) & np.isfinite(counted)
    image = np.where(used, counted - dark, 0.0) / np.where(used, response, 1.0)
    reading = reading_variance(scene, applied)
    light = expected(image, used, float(np.median(reading)))
    variance = np.maximum(light * response + dark, 0.0) + reading
    variance += ((1.0 - time / masters.dark_time) * masters.bias.uncertainty) ** 2
    variance += (masters.dark.uncertainty * time) ** 2 + (light * response * masters.flat.uncertainty) ** 2
    with np.errstate(divide="ignore", invalid="ignore"):
        weight = np.where(used, response**2 / variance, 0.0)
    scale = time if per_second else 1.0
    return Reduced(
        (image / scale).astype(np.float32), np.where(np.isfinite(weight), weight * scale**2, 0.0).astype(np.float32),
        flags,
    )  # fmt: skip


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
