"""Record truth maps of a simulated image: diffuse sky, cosmic rays, ghosts, saturated pixels and others.

A truth map is an image of the detector with the contribution of one detector effect or of a kind of sources.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from lake_schema.arrays import Array
from truesky.render.channels.readout import ReadoutMode
from truesky.render.effects.charge import bleeding, ramp
from truesky.render.effects.effect import Effect
from truesky.render.effects.readout import adc
from truesky.render.effects.scene import Frame, Scene

Maps = dict[str, Array]

# Name of the truth map with the light of each spectral order of a grism, by number of the order.
ORDER_MAPS = {1: "order_1", 0: "order_0", 2: "order_2", -1: "order_m1"}
# Bytes per pixel in the file of each truth map, before compression.
BYTES_PER_PIXEL = {
    "noise_free": 4, "stars": 4, "sky": 4, "cosmic_rays": 4, "ghosts": 4, "persistence": 4, "satellites": 4,
    "saturation": 1, "traps": 4, "dipoles": 4,
    # The map "ramp" contains the groups of reads of an infrared detector. Images without grism have four groups of 2
    # bytes per pixel.
    "ramp": 8, **dict.fromkeys(ORDER_MAPS.values(), 4),
}  # fmt: skip
# Names of the effects that simulate an analogue-digital converter. Pixels with its largest number are marked as
# saturated.
_CONVERTERS = ("adc", "signal_adc")
# Name of an effect that a channel has only if it uses a grism. Only images with this effect have truth maps by spectral
# order.
_GRISM = "dispersed_sky"
# Name of the truth map to which each detector effect contributes, by name of the effect.
_MAP_OF_EFFECT = {
    "ghosts": "ghosts", "filter_ghosts": "ghosts", "lens_ghosts": "ghosts", "background": "sky",
    "dispersed_sky": "sky", "pixel_area": "sky", "straylight": "sky", "fringes": "sky",
    "satellite_trails": "satellites", "cosmic_rays": "cosmic_rays", "readout_cosmic_rays": "cosmic_rays",
    "ramp_cosmic_rays": "cosmic_rays", "persistence": "persistence", "macc": "ramp", "trap_pumping": "dipoles",
}  # fmt: skip


def available_maps(truth: Sequence[str], effects: Sequence[str] | None, sees_sky: bool) -> list[str]:
    """Select those of the requested truth maps that an image can have.

    Parameters
    ----------
    truth : sequence of str
        Names of the requested truth maps.
    effects : sequence of str or None
        Names of the channel's effects for this image type. None if they are not known: all maps are then returned.
    sees_sky : bool
        True if light of astronomical sources reaches the detector.

    Returns
    -------
    list of str
        Names of the maps that the image has, in the order of `truth`.
    """
    available = {_MAP_OF_EFFECT[name] for name in effects or () if name in _MAP_OF_EFFECT}
    available |= {"noise_free", "saturation"} | ({"stars"} if sees_sky else set())
    if "trap_pumping" in (effects or ()):
        available.add("traps")
    if sees_sky and _GRISM in (effects or ()):
        available |= set(ORDER_MAPS.values())
    return [name for name in truth if effects is None or name in available]


def recorded_effects(truth: Sequence[str]) -> set[str]:
    """Return the names of the effects that `map_recorder` needs for the requested truth maps `truth`."""
    names = {effect for effect, name in _MAP_OF_EFFECT.items() if name in truth}
    return names | ({"bleeding", "ramp"} if "saturation" in truth else set())


def map_recorder(
    maps: Maps, scene: Scene, truth: Sequence[str], mode: ReadoutMode
) -> Callable[[str, Frame, Frame], None]:
    """Return a callback for `effect.apply_all` that records truth maps while effects are applied.

    Parameters
    ----------
    maps : dict of str to array
        Truth maps by name, to which the callback adds.
    scene : Scene
        Properties of the exposure on which effects depend.
    truth : sequence of str
        Names of the requested truth maps. Effects without a requested map are not recorded.
    mode : ReadoutMode
        Readout of the detector, which converts images in readout order to the axes of the detector.

    Returns
    -------
    callable
        Function (name of the effect, image before the effect, image after it) -> None.
    """

    def record(name: str, frame_before: Frame, frame_after: Frame) -> None:
        if _MAP_OF_EFFECT.get(name) == "ghosts" and "ghosts" in truth:
            maps["ghosts"] = (frame_after - frame_before).astype(np.float32) + maps.get("ghosts", np.float32(0.0))
        if _MAP_OF_EFFECT.get(name) == "sky" and "sky" in truth:
            maps["sky"] = (frame_after - frame_before).astype(np.float32) + maps.get("sky", np.float32(0.0))
        if name in ("persistence", "satellite_trails") and _MAP_OF_EFFECT[name] in truth:
            maps[_MAP_OF_EFFECT[name]] = (frame_after - frame_before).astype(np.float32)
        if name == "trap_pumping" and "dipoles" in truth:
            maps["dipoles"] = np.rint(frame_after - frame_before).astype(np.int32)
        if name == "bleeding" and "saturation" in truth:
            maps["saturation"] = bleeding.saturated_pixels(frame_after, *bleeding.parameters(scene)).astype(np.uint8)
        if name == "ramp" and "saturation" in truth:
            full = ramp.full_pixels(frame_before, ramp.mode_of_scene(scene), scene.value("full_well", "electron"))
            maps["saturation"] = full.astype(np.uint8)
        if name == "ramp_cosmic_rays" and "cosmic_rays" in truth and frame_after.ndim == 3:
            maps["cosmic_rays"] = np.rint(frame_after[1]).astype(np.int32)
        if name == "macc" and "ramp" in truth:
            maps["ramp"] = adc.convert_groups(frame_before, scene)
        if name in ("cosmic_rays", "readout_cosmic_rays") and "cosmic_rays" in truth:
            # Cosmic rays add whole electrons, but traps may have captured a fraction of an electron. Therefore the
            # difference is rounded.
            maps["cosmic_rays"] = np.rint(mode.assemble(frame_after - frame_before, scene)).astype(np.int32) + maps.get(
                "cosmic_rays", 0
            )

    return record


def complete(
    maps: Maps, raw: Array, effects: Sequence[Effect], scene: Scene, truth: Sequence[str], mode: ReadoutMode
) -> None:
    """Complete the truth maps of an image after all effects have been applied.

    A requested map is 0 everywhere if its effects were not applied. Pixels at the upper limit of the analogue-digital
    converter are marked as saturated. Maps are set to 0 in rows and pixels that the detector does not read.

    Parameters
    ----------
    maps : dict of str to array
        Recorded truth maps by name, which are changed in place. `noise_free` must be among them.
    raw : array
        Pixel values after the last effect, ADU, in readout order.
    effects : sequence of Effect
        Effects of the channel for this image type.
    scene : Scene
        Properties of the exposure on which effects depend.
    truth : sequence of str
        Names of the requested truth maps.
    mode : ReadoutMode
        Readout of the detector, which converts images in readout order to the axes of the detector.
    """
    shape = maps["noise_free"].shape
    requested = available_maps(truth, [effect.name for effect in effects], False)
    for name, dtype in (
        ("ghosts", np.float32),
        ("sky", np.float32),
        ("cosmic_rays", np.int32),
        ("persistence", np.float32),
        ("dipoles", np.int32),
        ("satellites", np.float32),
        ("saturation", np.uint8),
    ):
        if name in requested and name not in maps:
            maps[name] = np.zeros(shape, dtype)
    if "saturation" in truth and any(effect.name in _CONVERTERS for effect in effects):
        largest = scene.amplifier_values("adc_max", "adu")
        full = raw >= (np.reshape(largest, (-1, 1, 1)) if np.ndim(largest) else largest)
        maps["saturation"] |= mode.assemble(full, scene)
    for truth_map in maps.values():
        truth_map[slice(*scene.unread_rows)] = 0
        if scene.layout is not None:
            truth_map[scene.layout.unread_pixels] = 0
