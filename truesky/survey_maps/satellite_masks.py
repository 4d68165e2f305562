"""Predict the trails of artificial satellites, which the seed and the exposure determine, in the pixels of a map."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from lake_schema.arrays import Float, Int
from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.tables.exposures import ExposureRow
from lake_schema.tables.survey.depth import SATELLITE
from truesky.fluxes.passbands import Passband
from truesky.randomness.rng import stream
from truesky.render.camera import detectors as camera_detectors
from truesky.render.camera import pointing
from truesky.render.camera.detectors import Detector
from truesky.render.channels import registry
from truesky.render.effects.scene import NOTICEABLE
from truesky.render.exposure import scene_factory
from truesky.render.exposure.records import Variant
from truesky.render.exposure.rendered_detector import random_identity
from truesky.render.planning import variants
from truesky.render.psf import seeing
from truesky.request.schema import Request
from truesky.survey_maps.pixel_overlap import PixelGrid

# Rate of satellites in the mission database.
_RATE = "survey.satellites.rate"


@dataclass(frozen=True, slots=True)
class Band:
    """Trail of a satellite, a straight band in the focal plane: direction (radian), offset and half width (arcsec)."""

    direction: float
    offset: float
    half_width: float


def predict(
    exposures: Iterable[ExposureRow],
    normals: dict[int, Float],
    request: Request,
    settings: tuple[Passband, MissionConfiguration],
    grid: PixelGrid,
) -> Int:
    """Return the mask bits of trails of satellites in the pixels of a cell, in one band.

    Parameters
    ----------
    exposures : iterable of ExposureRow
        Exposures of a camera that touch the cell.
    normals : dict of int to float array, shape (n, 4, 3)
        For each exposure, unit vectors normal to the sides of its detectors near the cell, towards the inside.
    request : Request
        The request: its seeds, accuracy and effects.
    settings : (Passband, MissionConfiguration)
        The passband, and the mission parameters of the request.
    grid : PixelGrid
        Pixels of the cell.

    Returns
    -------
    int64 array, shape (n,)
        Bits of the column `mask` of the table `depth`.
    """
    bits = np.zeros(len(grid.centres), np.int64)
    (band, mission), forced = settings, variants.forced_effects(request)

    # Exposures share few variants. To apply one, or to read the layout of a large camera, takes milliseconds.
    @cache
    def setup(camera: str, changes: str | None) -> tuple[Variant, tuple[Detector, ...]]:
        variant = variants.variant(changes, mission, request.accuracy, forced)
        has_satellites = variant.mission.value(_RATE, "1 / (deg s)") > 0.0
        return variant, camera_detectors.detectors(camera, variant.mission) if has_satellites else ()

    # A trail touches a pixel whose centre is at most this far from it, or a little less.
    pixel_radius = grid.pixel_radius / pointing.ARCSEC
    for exposure in exposures:
        if not registry.CHANNELS[exposure.channel].on_ground:
            continue
        variant, all_detectors = setup(exposure.camera, exposure.settings)
        if not all_detectors:
            continue
        places = None
        for trail in trails(exposure, request, band, (variant, all_detectors)):
            if places is None:
                boresight = exposure.ra, exposure.dec, exposure.position_angle
                places = pointing.plane_of_sky(grid.centres, *boresight)
            x, y, front = places
            distance = np.abs(np.cos(trail.direction) * y - np.sin(trail.direction) * x - trail.offset)
            touched = np.flatnonzero(front & (bits == 0) & (distance < trail.half_width + pixel_radius))
            # Pixels whose centres are up to the radius of a pixel outside a detector may be on it.
            u, v, w = grid.centres[touched].T[..., None]
            covered = np.zeros(len(touched), bool)
            for sides in normals[exposure.exposure_id]:
                depth = u * sides[:, 0] + v * sides[:, 1] + w * sides[:, 2]
                covered |= (depth > -grid.pixel_radius).all(axis=1)
            bits[touched[covered]] |= SATELLITE
    return bits


def trails(
    exposure: ExposureRow, request: Request, band: Passband, setup: tuple[Variant, tuple[Detector, ...]]
) -> Iterator[Band]:
    """Yield the trails of an exposure as the renderer draws them, where they are noticeable.

    Parameters
    ----------
    exposure : ExposureRow
        The exposure, of a ground camera.
    request : Request
        The request: its seeds.
    band : Passband
        The passband.
    setup : (Variant, tuple of Detector)
        Mission parameters, accuracy and effects of the exposure, and all detectors of its camera.

    Yields
    ------
    Band
        The part of each trail with more light than 0.1 times the noise of a pixel.
    """
    from truesky.render.effects.light import satellite_trails

    variant, all_detectors = setup
    if not variant.forced.get(satellite_trails.EFFECT.name, True):
        return
    detector = all_detectors[0]
    scene = scene_factory.from_exposure(exposure, detector, variant.mission, variant.accuracy)
    fwhm = seeing.image_fwhm(exposure, detector, band, variant.mission)
    scene = replace(scene, band=band, forced=variant.forced, seeing=fwhm)
    radius = camera_detectors.field_radius(all_detectors)
    satellites, blur = satellite_trails.in_field(scene, detector, radius)
    identity = random_identity(satellite_trails.EFFECT, exposure, "", request.seed, request.noise_seed)
    drawn = list(satellite_trails.draw_trails(satellites, radius, stream(*identity)))
    # Most exposures have no trail. Whether the effect is applied takes longer than to draw none.
    if not drawn or not satellite_trails.EFFECT.is_applied(scene):
        return
    for trail in drawn:
        pixels = satellite_trails.half_width(trail, blur, NOTICEABLE * scene.pixel_noise)
        if pixels:
            yield Band(trail.direction, trail.offset, pixels * detector.pixel_scale)
