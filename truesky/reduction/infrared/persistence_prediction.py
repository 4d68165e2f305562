"""Predict persistence (charge of earlier exposures that an infrared detector releases later) in a frame.

The prediction uses only what an observer has: earlier frames of the detector, and the mission parameters.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from lake_schema.arrays import Float, Float32
from truesky.reduction.frames import Frame
from truesky.render.channels import registry
from truesky.render.channels.image_types import shared_settings
from truesky.render.effects.charge.persistence import PersistenceModel
from truesky.render.exposure import persistence

_DAY_S = 86400.0
# Number of earlier frames whose released charge is kept in memory, with 4 bytes per pixel.
_CACHE_SIZE = 48
# Image types whose frames contain no light and therefore leave no persistence.
_DARK_TYPES = ("bias", "dark", "persistence")


@dataclass(slots=True)
class PersistencePrediction:
    """Prediction of persistence in the frames of one detector.

    Attributes
    ----------
    frames : sequence of Frame
        All frames of the detector in all channels (NISP-P images and NISP-S spectra).

    Notes
    -----
    All pixels are assumed to have the same traps, because differences between pixels are not known. Persistence of
    exposures that are not in `frames` is missed.
    """

    frames: Sequence[Frame]
    _charge_cache: OrderedDict[int, Float32] = field(default_factory=OrderedDict)

    def charge_in(self, frame: Frame) -> Float:
        """Return the predicted electrons of persistence in a frame, float64[ny, nx].

        The result is the sum of the charge from all earlier frames with light; it is 0 without such frames. The
        camera's time window limits how long before `frame` they may begin. Frames with other simulation settings, and
        further noise realisations of an exposure, are ignored.
        """
        out = np.zeros((frame.scene.ny, frame.scene.nx))
        exposure, traps = frame.exposure, PersistenceModel.from_scene(frame.scene)
        start_mjd = exposure.mjd - persistence.window_days(exposure.camera, frame.scene.mission)
        for previous_frame in self.frames:
            previous = previous_frame.exposure
            if (
                not start_mjd <= previous.mjd < exposure.mjd
                or previous.image_type in _DARK_TYPES
                or (previous.realisation or 1) > 1
            ):
                continue
            if registry.CHANNELS[previous.channel].persistence_effect is None or shared_settings(
                previous.settings
            ) != shared_settings(exposure.settings):
                continue
            times = (exposure.mjd - previous.mjd) * _DAY_S, exposure.exposure_time_s, previous.exposure_time_s
            out += traps.time_scaling(*times) * self._charge_at_reference(previous_frame, traps)
        return out

    def _charge_at_reference(self, previous_frame: Frame, traps: PersistenceModel) -> Float32:
        """Return the electrons [ny, nx] that `previous_frame` releases in a standard later exposure.

        The later exposure starts `traps.reference` seconds after `previous_frame` starts, and is
        `traps.nominal_length` seconds long. Results are cached.
        """
        number = previous_frame.exposure.exposure_id
        if number not in self._charge_cache:
            charge = np.where(previous_frame.saturated_pixels(), traps.full_well, previous_frame.electrons())
            self._charge_cache[number] = traps.released_charge(charge, traps.reference, traps.nominal_length).astype(
                np.float32
            )
            if len(self._charge_cache) > _CACHE_SIZE:
                self._charge_cache.popitem(last=False)
        self._charge_cache.move_to_end(number)
        return self._charge_cache[number]
