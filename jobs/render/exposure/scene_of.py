"""The scene of an exposure: what its effects may know of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from jobs.accuracy import Accuracy
from jobs.render.camera.detectors import Detector
from jobs.render.effects.charge import charge_injection, cosmic_rays
from jobs.render.effects.effect import Effect
from jobs.render.effects.light import calibration_lamp
from jobs.render.effects.readout import readout_cosmic_rays
from jobs.render.effects.scene import Scene
from lake_schema import units
from lake_schema.arrays import Row
from lake_schema.mission.configuration import MissionConfiguration

# What fills pixels besides the sky and its sources.
_LAMPS = (calibration_lamp.EFFECT, charge_injection.EFFECT, charge_injection.NOISE)
# What crosses it besides light: its tracks are squeezed, and left behind, in the dark, too.
_RAYS = (cosmic_rays.EFFECT, readout_cosmic_rays.READOUT)


def with_own_light(scene: Scene, effects: Sequence[Effect]) -> Scene:
    """A lamp's light and injected charge are moved and squeezed like a star's, and so are tracks of cosmic rays."""
    lamps = [effect for effect in effects if effect in _LAMPS and scene.forced.get(effect.name, True)]
    rays = [effect for effect in effects if effect in _RAYS and effect.applied(scene)]
    return replace(
        scene,
        peak_electrons=scene.peak_electrons + sum(lamp.contribution(scene) for lamp in lamps),
        track_electrons=cosmic_rays.brightest(scene) if rays else 0.0,
    )


def scene_of(exposure: Row, detector: Detector, mission: MissionConfiguration, accuracy: Accuracy) -> Scene:
    """Before anything is drawn."""
    return Scene(
        mission, detector.section, float(exposure["exposure_time_s"]), float(exposure["sky"]), 0.0, detector,
        lamp=int(exposure.get("lamp") or 1), accuracy=accuracy,
    )  # fmt: skip


def electron_rate(exposure: Row) -> float:
    """Electrons a second of a source of one microjansky."""
    return float(10.0 ** (0.4 * (float(exposure["zero_point"]) - units.AB_UJY)))
