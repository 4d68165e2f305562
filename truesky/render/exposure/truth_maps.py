"""Truth of what is in an image besides the sources: the diffuse sky, cosmic rays, ghosts, what is full.

made       which of the maps that are wanted an image has
watch      what is called for every effect that is applied
complete   adds the maps of effects that were not needed, and what the converter could not hold
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

# Of each order of a grism its own light.
ORDER_MAPS = {1: "order_1", 0: "order_0", 2: "order_2", -1: "order_m1"}
# Bytes a pixel of each map's file.
BYTES_PER_PIXEL = {
    "noise_free": 4, "stars": 4, "sky": 4, "cosmic_rays": 4, "ghosts": 4, "persistence": 4, "satellites": 4,
    "saturation": 1, "traps": 4, "dipoles": 4,
    # Four groups of a photometric ramp.
    "ramp": 8, **dict.fromkeys(ORDER_MAPS.values(), 4),
}  # fmt: skip
# Beyond what they hold a pixel is not told.
_CONVERTERS = ("adc", "signal_adc")
# Of an image that a grism is in the beam of.
_GRISM = "dispersed_sky"
# What adds to a map of the same name as an effect, or of another.
_MAP_OF_EFFECT = {
    "ghosts": "ghosts", "filter_ghosts": "ghosts", "background": "sky", "dispersed_sky": "sky", "pixel_area": "sky",
    "straylight": "sky", "fringes": "sky", "satellite_trails": "satellites",
    "cosmic_rays": "cosmic_rays", "readout_cosmic_rays": "cosmic_rays", "ramp_cosmic_rays": "cosmic_rays",
    "persistence": "persistence", "macc": "ramp", "trap_pumping": "dipoles",
}  # fmt: skip


def available_maps(truth: Sequence[str], effects: Sequence[str] | None, sees_sky: bool) -> list[str]:
    """Those of the wanted maps that an image has.

    effects : names of its channel's, None = not known: all maps;  looks : whether sources shine on it
    """
    available = {_MAP_OF_EFFECT[name] for name in effects or () if name in _MAP_OF_EFFECT}
    available |= {"noise_free", "saturation"} | ({"stars"} if sees_sky else set())
    if "trap_pumping" in (effects or ()):
        available.add("traps")
    if sees_sky and _GRISM in (effects or ()):
        available |= set(ORDER_MAPS.values())
    return [name for name in truth if effects is None or name in available]


def map_recorder(
    maps: Maps, scene: Scene, truth: Sequence[str], mode: ReadoutMode
) -> Callable[[str, Frame, Frame], None]:
    """Fills in the truth that effects add to the frame.

    maps  : by name, filled in;  scene : what is rendered;  truth : the maps that are wanted
    mode  : how the detector is read
    """

    def record(name: str, frame_before: Frame, frame_after: Frame) -> None:
        if name in ("ghosts", "filter_ghosts") and "ghosts" in truth:
            maps["ghosts"] = (frame_after - frame_before).astype(np.float32) + maps.get("ghosts", np.float32(0.0))
        if _MAP_OF_EFFECT.get(name) == "sky" and "sky" in truth:
            maps["sky"] = (frame_after - frame_before).astype(np.float32) + maps.get("sky", np.float32(0.0))
        if name in ("persistence", "satellite_trails") and _MAP_OF_EFFECT[name] in truth:
            maps[_MAP_OF_EFFECT[name]] = (frame_after - frame_before).astype(np.float32)
        if name == "trap_pumping" and "dipoles" in truth:
            maps["dipoles"] = np.rint(frame_after - frame_before).astype(np.int32)
        if name == "bleeding" and "saturation" in truth:
            maps["saturation"] = bleeding.saturated_pixels(frame_after, scene.value("full_well", "electron")).astype(
                np.uint8
            )
        if name == "ramp" and "saturation" in truth:
            full = ramp.full_pixels(frame_before, ramp.mode_of_scene(scene), scene.value("full_well", "electron"))
            maps["saturation"] = full.astype(np.uint8)
        if name == "ramp_cosmic_rays" and "cosmic_rays" in truth and frame_after.ndim == 3:
            maps["cosmic_rays"] = np.rint(frame_after[1]).astype(np.int32)
        if name == "macc" and "ramp" in truth:
            maps["ramp"] = adc.convert_groups(frame_before, scene)
        if name in ("cosmic_rays", "readout_cosmic_rays") and "cosmic_rays" in truth:
            # Traps may have held some of it back: to the electron.
            maps["cosmic_rays"] = np.rint(mode.assemble(frame_after - frame_before, scene)).astype(np.int32) + maps.get(
                "cosmic_rays", 0
            )

    return record


def complete(
    maps: Maps, raw: Array, effects: Sequence[Effect], scene: Scene, truth: Sequence[str], mode: ReadoutMode
) -> None:
    """Adds maps of effects that were not needed, and pixels that the converter could not hold.

    Nothing is where no pixel is, between the halves of a detector.
    maps  : what there is so far;  raw : ADU;  effects : of the channel
    scene : what was rendered;  truth : maps that are wanted
    mode  : how the detector is read
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
