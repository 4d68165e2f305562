"""Persistence as an observer foresees it: of the earlier frames of a detector of a lake, by the mission's numbers.

foreseen      electrons that the frames before one left in it
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from lake_schema.arrays import Float, Float32
from truesky.reduction.frames import Frame
from truesky.render.channels import registry
from truesky.render.channels.image_types import family
from truesky.render.effects.charge.persistence import Traps
from truesky.render.exposure import persistence

_DAY_S = 86400.0
# Frames whose charge is kept in memory: 4 bytes a pixel.
_KEPT = 48
# Nothing shone on them.
_DARK = ("bias", "dark", "persistence")


@dataclass(slots=True)
class Foreseen:
    """What is left in frames of a detector; frames : all that there are of it, of whatever channel.

    Error : of what each pixel's traps have of their own nothing is known; what no frame of the lake shows is missed
    """

    frames: Sequence[Frame]
    _left: OrderedDict[int, Float32] = field(default_factory=OrderedDict)

    def of(self, frame: Frame) -> Float:
        """e- [ny, nx] in a frame of it."""
        out = np.zeros((frame.scene.ny, frame.scene.nx))
        now, traps = frame.exposure, Traps.of(frame.scene)
        since = now.mjd - persistence.window(now.camera, frame.scene.mission)
        for before in self.frames:
            row = before.exposure
            if not since <= row.mjd < now.mjd or row.image_type in _DARK or (row.realisation or 1) > 1:
                continue
            if registry.CHANNELS[row.channel].remembers is None or family(row.settings) != family(now.settings):
                continue
            times = (now.mjd - row.mjd) * _DAY_S, now.exposure_time_s, row.exposure_time_s
            out += traps.scale(*times) * self._at_reference(before, traps)
        return out

    def _at_reference(self, before: Frame, traps: Traps) -> Float32:
        """e- of a frame's charge after the reference time, in an exposure of the nominal length."""
        number = before.exposure.exposure_id
        if number not in self._left:
            charge = np.where(before.full(), traps.full_well, before.electrons())
            self._left[number] = traps.left(charge, traps.reference, traps.length).astype(np.float32)
            if len(self._left) > _KEPT:
                self._left.popitem(last=False)
        self._left.move_to_end(number)
        return self._left[number]
