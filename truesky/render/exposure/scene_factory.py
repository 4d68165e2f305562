"""Create the scene of an exposure, on which its effects depend."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.tables.exposures import ExposureRow
from truesky.render.camera.detectors import Detector
from truesky.render.channels import registry
from truesky.render.channels.aim import Aim
from truesky.render.channels.channel import Channel
from truesky.render.effects.charge import cosmic_rays, ramp
from truesky.render.effects.effect import Effect
from truesky.render.effects.scene import Frame, Scene
from truesky.render.exposure.records import Variant
from truesky.request.accuracy import Accuracy


def with_non_source_light(scene: Scene, channel: Channel, effects: Sequence[Effect]) -> Scene:
    """Add the light of lamps, injected charge and cosmic rays to the brightest pixels of a scene.

    Parameters
    ----------
    scene : Scene
        Scene with the brightest pixel of the sources.
    channel : Channel
        Channel of the exposure.
    effects : sequence of Effect
        Effects of the image.

    Returns
    -------
    Scene
        Scene with higher `peak_electrons`, and with `track_electrons` if cosmic rays are applied.

    Notes
    -----
    Nonlinearity and charge transfer depend on this charge as they do on the charge of stars.
    """
    lamps = [
        effect for effect in effects if effect in channel.non_source_effects and scene.forced.get(effect.name, True)
    ]
    rays = [effect for effect in effects if effect in channel.track_effects and effect.is_applied(scene)]
    return replace(
        scene,
        peak_electrons=scene.peak_electrons + sum(lamp.contribution(scene) for lamp in lamps),
        track_electrons=cosmic_rays.brightest_pixel(scene) if rays else 0.0,
    )


def from_exposure(
    exposure: ExposureRow, detector: Detector, mission: MissionConfiguration, accuracy: Accuracy
) -> Scene:
    """Create a scene before anything is drawn.

    Parameters
    ----------
    exposure : ExposureRow
        Row of the exposure.
    detector : Detector
        Detector of its camera.
    mission : MissionConfiguration
        Mission database.
    accuracy : Accuracy
        Accuracy of the request.

    Returns
    -------
    Scene
        Scene with a brightest pixel of 0.

    Notes
    -----
    BadInput is raised by `ramp.find_mode` if the exposure time does not fit the channel's ramp.
    """
    channel = registry.CHANNELS.get(exposure.channel)
    scene = Scene(
        mission, detector.section, exposure.exposure_time_s, exposure.sky, 0.0, detector,
        lamp=exposure.lamp or 1, accuracy=accuracy, ramp=channel.ramp_name if channel else "",
        seeing=exposure.seeing, zero_point=exposure.zero_point,
    )  # fmt: skip
    if scene.ramp:
        ramp.mode_of_scene(scene)
    return scene


def from_aim(aim: Aim, variant: Variant) -> Scene:
    """Create a scene before anything is drawn, with the passband and forced effects."""
    scene = from_exposure(aim.exposure, aim.detector, variant.mission, variant.accuracy)
    return replace(scene, band=aim.band, forced=variant.forced)


def with_peak_electrons(scene: Scene, frame: Frame) -> Scene:
    """Return the scene with the brightest pixel of a frame among the pixels that are read."""
    halves = frame[: scene.unread_rows[0]], frame[scene.unread_rows[1] :]
    return replace(scene, peak_electrons=max(float(half.max(initial=0.0)) for half in halves))
