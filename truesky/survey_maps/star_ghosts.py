"""Predict the ghosts of bright stars: circles on the sky, with the positions and sizes of the renderer's ghosts.

Only ghosts whose light in a pixel exceeds a tenth of the pixel's noise are predicted. The hole and the arms in the
image of the pupil are neglected.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from lake_schema import units
from lake_schema.arrays import Float
from lake_schema.mission import ghost_offsets
from lake_schema.tables.exposures import ExposureRow
from truesky.render.camera import pointing
from truesky.render.camera.detectors import field_radius
from truesky.render.channels.aim import electron_rate
from truesky.render.effects.light import ground_ghosts
from truesky.render.effects.scene import NOTICEABLE, Scene
from truesky.render.exposure import scene_factory
from truesky.request.accuracy import SURVEY
from truesky.survey_maps.star_places import MaskExposures, Stars, focal_plane

# Ghosts in the focal plane: places x and y and the radius of each, arcsec.
_Circles = tuple[Float, Float, Float]


def circles(stars: Stars, exposure: ExposureRow, seen_by: MaskExposures) -> Iterator[tuple[Float, Float, Float]]:
    """Yield the ghosts in an exposure that touch the field of its camera.

    Parameters
    ----------
    stars : Stars
        Bright stars.
    exposure : ExposureRow
        The exposure.
    seen_by : MaskExposures
        Mission parameters and passband.

    Yields
    ------
    ra, dec : float array, shape (m,)
        Centres of the ghosts of one kind, deg.
    radius : float array, shape (m,)
        Outer radii, arcsec.
    """
    all_detectors = seen_by.detectors
    field_x, field_y = pointing.outline(all_detectors)
    scene = scene_factory.from_exposure(exposure, all_detectors[0], seen_by.mission, SURVEY)
    x, y, front = focal_plane(stars, exposure)
    electrons = electron_rate(exposure) * exposure.exposure_time_s * 10.0 ** (0.4 * (units.AB_UJY - stars.magnitude))
    lights = x[front], y[front], electrons[front]
    scene = replace(scene, band=seen_by.band)
    if exposure.camera in ghost_offsets.PLATES:
        ghosts = _of_plates(scene, *lights)
    else:
        ghosts = _of_lenses(scene, ground_ghosts.in_focal_plane(scene, *lights, field_radius(all_detectors)))
    for to_x, to_y, radius in ghosts:
        # Other exposures may observe the place of a ghost outside the field, but they do not have this ghost.
        inside = (to_x > field_x.min() - radius) & (to_x < field_x.max() + radius)
        inside &= (to_y > field_y.min() - radius) & (to_y < field_y.max() + radius)
        place = to_x[inside], to_y[inside]
        yield *pointing.sky_of_plane(*place, exposure.ra, exposure.dec, exposure.position_angle), radius[inside]


def _of_plates(scene: Scene, x: Float, y: Float, electrons: Float) -> Iterator[_Circles]:
    """Yield the ghosts of each plate and order of Euclid."""
    mission, section, noise = scene.mission, scene.section, NOTICEABLE * scene.pixel_noise
    scale = mission.value(f"{section}.fpa.pixel_scale", "arcsec / pix")
    for plate in ghost_offsets.PLATES[section]:
        for order in ghost_offsets.orders(mission, section, plate):
            radius = order * mission.value(f"{section}.{plate}.radius_out", "pix")
            ratio = mission.value(f"{section}.{plate}.flux_ratio", "")
            if order > 1:
                ratio *= mission.value(f"{section}.{plate}.order_ratio", "") ** (order - 1)
            noticeable = ratio * electrons > noise * np.pi * radius**2
            dx, dy = ghost_offsets.offset(
                mission, (section, plate), order, x[noticeable] / 3600.0, y[noticeable] / 3600.0
            )
            yield x[noticeable] + scale * dx, y[noticeable] + scale * dy, np.full(len(dx), radius * scale)


def _of_lenses(scene: Scene, ghosts: Iterator[tuple[Float, Float, Float, Float]]) -> Iterator[_Circles]:
    """Yield the noticeable ghosts of each pair of surfaces in a ground camera, from all of `in_focal_plane`."""
    scale = scene.mission.value(f"{scene.section}.fpa.pixel_scale", "arcsec / pix")
    limit = NOTICEABLE * scene.pixel_noise
    for to_x, to_y, radius, level in ghosts:
        noticeable = level > limit
        yield to_x[noticeable], to_y[noticeable], radius[noticeable] * scale
