"""Create the scene of a detector in an exposure: the properties on which detector effects depend."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from lake_schema.arrays import Float
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.tables.exposures import ExposureRow
from truesky.render.camera import pointing
from truesky.render.camera.detectors import Detector
from truesky.render.channels import registry
from truesky.render.channels.aim import Aim
from truesky.render.channels.channel import Channel
from truesky.render.effects.charge import cosmic_rays, ramp
from truesky.render.effects.effect import Effect
from truesky.render.effects.scene import Frame, Scene
from truesky.render.exposure.records import Variant
from truesky.render.psf import seeing
from truesky.request.accuracy import Accuracy

# Smallest sky in the middle of a detector relative to that at the field centre, if the sky has a gradient.
_MIN_SKY = 0.01


def with_non_source_light(scene: Scene, channel: Channel, effects: Sequence[Effect]) -> Scene:
    """Add the electrons of lamps, injected charge and satellite trails to the brightest pixel of a scene.

    The brightest pixel of cosmic rays is set separately.

    Parameters
    ----------
    scene : Scene
        Properties of the exposure, with the brightest pixel of the sources in `peak_electrons`.
    channel : Channel
        Channel (instrument mode) of the exposure.
    effects : sequence of Effect
        Effects of the channel for this image type.

    Returns
    -------
    Scene
        Scene with higher `peak_electrons`, and with the brightest pixel of cosmic rays in `track_electrons` (0 without
        cosmic rays).

    Notes
    -----
    Nonlinearity and charge transfer depend on the charge in a pixel, whether it comes from stars, lamps or cosmic rays.
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
    """Create the scene of a detector before anything is drawn.

    Parameters
    ----------
    exposure : ExposureRow
        Row of the table `exposures`.
    detector : Detector
        Detector of the camera of this exposure.
    mission : MissionConfiguration
        Mission database (parameters of telescopes and cameras).
    accuracy : Accuracy
        Errors that the request accepts.

    Returns
    -------
    Scene
        Properties on which effects depend; the brightest pixel has 0 electrons.

    Notes
    -----
    BadInput is raised by `ramp.find_mode` if the exposure time does not fit the channel's ramp.
    """
    channel = registry.CHANNELS.get(exposure.channel)
    level, *slopes = _sky_plane(exposure, detector)
    scene = Scene(
        mission, detector.section, exposure.exposure_time_s, exposure.sky * level, 0.0, detector,
        lamp=exposure.lamp or 1, accuracy=accuracy, ramp=channel.ramp_name if channel else "",
        zero_point=exposure.zero_point, sky_slopes=(slopes[0], slopes[1]), mjd=exposure.mjd,
    )  # fmt: skip
    if scene.ramp:
        ramp.mode_of_scene(scene)
    return scene


def sky_levels(exposures: Sequence[ExposureRow], detector: Detector) -> Float:
    """Return the sky in the middle of a detector relative to that at the field centre, for each exposure."""
    x, y = (float(axis[0, 0]) / 3600.0 for axis in pointing.outline((detector,)))
    slopes = np.array([(e.sky_slope_x or 0.0, e.sky_slope_y or 0.0) for e in exposures]).reshape(-1, 2)
    return np.maximum(1.0 + slopes[:, 0] * x + slopes[:, 1] * y, _MIN_SKY)


def _sky_plane(exposure: ExposureRow, detector: Detector) -> tuple[float, float, float]:
    """Return the sky in the middle of a detector relative to the field centre, and its relative slopes per pixel.

    The slopes are those along rows and along columns of pixels. The sky is a plane in the focal plane.
    """
    if not exposure.sky_slope_x and not exposure.sky_slope_y:
        return 1.0, 0.0, 0.0
    x, y = (axis[0] / 3600.0 for axis in pointing.outline((detector,)))
    middle, *corners = 1.0 + (exposure.sky_slope_x or 0.0) * x + (exposure.sky_slope_y or 0.0) * y
    # Corners have the order (first column, first row), (last, first), (last, last), (first, last).
    along_rows = (corners[1] + corners[2] - corners[0] - corners[3]) / (2.0 * detector.nx)
    along_columns = (corners[2] + corners[3] - corners[0] - corners[1]) / (2.0 * detector.ny)
    level = max(float(middle), _MIN_SKY)
    return level, float(along_rows) / level, float(along_columns) / level


def from_aim(aim: Aim, variant: Variant) -> Scene:
    """Create the scene of a detector before anything is drawn, with its passband, seeing and the switched effects.

    `aim` is an exposure and a detector. `variant` contains the mission database, the accuracy, and the effects that the
    request switches on or off. `ramp.find_mode` raises BadInput if the exposure time does not fit the channel's ramp.
    """
    scene = from_exposure(aim.exposure, aim.detector, variant.mission, variant.accuracy)
    fwhm = seeing.image_fwhm(aim.exposure, aim.detector, aim.band, variant.mission) if aim.channel.on_ground else 0.0
    return replace(scene, band=aim.band, forced=variant.forced, seeing=fwhm)


def with_peak_electrons(scene: Scene, frame: Frame) -> Scene:
    """Return the properties of an exposure (scene) with the electrons of the brightest pixel of an image, `frame`.

    Rows that the detector does not read are ignored. The result is 0 electrons if no pixel is positive.
    """
    halves = frame[: scene.unread_rows[0]], frame[scene.unread_rows[1] :]
    return replace(scene, peak_electrons=max(float(half.max(initial=0.0)) for half in halves))
