"""Truth of what a detector adds to its image: cosmic rays, ghosts, what is full.

watch      what is called for every effect that is applied
complete   adds the maps of effects that were not needed, and what the converter could not hold
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from jobs.render.effects import bleeding, quadrants
from jobs.render.effects.effect import Effect, Frame, Scene

Maps = dict[str, npt.NDArray[Any]]


def watch(maps: Maps, scene: Scene, truth: Sequence[str]) -> Callable[[str, Frame, Frame], None]:
    """Fills in the truth that effects add to the frame."""

    def see(name: str, before: Frame, after: Frame) -> None:
        if name == "ghosts" and "ghosts" in truth:
            maps["ghosts"] = (after - before).astype(np.float32)
        if name in ("bleeding", "full_well") and "saturation" in truth:
            maps["saturation"] = bleeding.saturated(after, scene.value("full_well", "electron")).astype(np.uint8)
        if name in ("cosmic_rays", "readout_cosmic_rays") and "cosmic_rays" in truth:
            hit = after - before
            hit = hit if hit.ndim == 2 else quadrants.assembled(hit, *quadrants.sizes(scene))
            maps["cosmic_rays"] = hit.astype(np.int32) + maps.get("cosmic_rays", 0)

    return see


def complete(
    maps: Maps, raw: npt.NDArray[np.uint16], effects: Sequence[Effect], scene: Scene, truth: Sequence[str]
) -> None:
    """Adds maps of effects that were not needed, and pixels that the converter could not hold."""
    shape = maps["noise_free"].shape
    names = {effect.name for effect in effects}
    for name, dtype in (("ghosts", np.float32), ("cosmic_rays", np.int32), ("saturation", np.uint8)):
        if name in truth and (name in names or name == "saturation") and name not in maps:
            maps[name] = np.zeros(shape, dtype)
    if "saturation" in truth:
        full = raw >= scene.value("adc_max", "adu")
        maps["saturation"] |= full if full.ndim == 2 else quadrants.assembled(full, *quadrants.sizes(scene))
