"""Euclid NISP-P: the order of physics.

Light and dark current are expected electrons until they are counted up the ramp; then charge of its groups, as every
pixel and its neighbours see it and as it is read; then the signal that is estimated of them on board, and its quality.
"""

from __future__ import annotations

from collections.abc import Mapping

from lake_schema.mission.configuration import MissionConfiguration
from lake_schema.tables.exposures import ExposureRow
from truesky.fluxes.passbands import Passband
from truesky.render.camera import bands
from truesky.render.camera.detectors import Detector
from truesky.render.channels import readout
from truesky.render.channels.channel import Channel
from truesky.render.channels.cost import Cost
from truesky.render.channels.image_types import SKY_TYPES
from truesky.render.effects.charge import (
    dark_map,
    ipc,
    persistence,
    pixel_response,
    ramp,
    ramp_cosmic_rays,
    ramp_nonlinearity,
)
from truesky.render.effects.effect import Effect
from truesky.render.effects.light import (
    background,
    calibration_lamp,
    chromatic_response,
    ghosts,
    pixel_area,
    straylight,
)
from truesky.render.effects.readout import adc, macc, output_gain, ramp_noise
from truesky.render.psf import euclid
from truesky.render.psf.model import Psf
from truesky.render.sky import diffuse_light

_LIGHT = (
    ghosts.EFFECT,
    ghosts.FILTER,
    straylight.EFFECT,
    background.EFFECT,
    pixel_area.EFFECT,
)
# Of any of the channels that these detectors are read for.
CURRENT = (
    dark_map.EFFECT,
    persistence.EFFECT,
)
RAMP = (
    ramp_cosmic_rays.EFFECT,
    ramp_nonlinearity.EFFECT,
    ramp.EFFECT,
    ipc.EFFECT,
    ramp_noise.RESET,
    ramp_noise.EFFECT,
    ramp_noise.DRIFT,
    output_gain.EFFECT,
    macc.EFFECT,
    ramp_nonlinearity.SIGNAL,
    adc.SIGNAL,
)

SKY = (*_LIGHT, chromatic_response.EFFECT, pixel_response.EFFECT, *CURRENT, *RAMP)
# Assumed to be taken on the way from field to field: neither sky nor stars are in a flat.
FLAT = (calibration_lamp.EFFECT, chromatic_response.LAMP, pixel_response.EFFECT, *CURRENT, *RAMP)
DARK = (*CURRENT, *RAMP)

EFFECTS: Mapping[str, tuple[Effect, ...]] = {
    "science": SKY,
    "deep": SKY,
    "self_calibration": SKY,
    "standard_star": SKY,
    "flat": FLAT,
    "dark": DARK,
    "persistence": DARK,
}


def _psf(
    exposure: ExposureRow, detector: Detector, band: Passband, mission: MissionConfiguration, positions: int
) -> Psf:
    return euclid.nisp_psf(detector, band, mission, positions)


# Of the demo's sky (1.2e4 predicted sources): 1.5 s of CPU and 1.2 GB on an AMD EPYC, which takes half of the time of
# the machine that costs are of (forecasting/speed.py).  Again: the last image of a visit of four dithers takes 10.5 s
# of CPU there, of which 0.28 s are for each of eleven images of NISP-P before it, and 0.6 s for each of four of NISP-S.
COST = Cost(
    frame_s=0.05,
    sky_s=0.3,
    galaxy_s=1.3e-4,
    star_s=1.3e-4,
    base_gb=0.5,
    bytes_per_pixel=120.0,
    sky_bytes_per_pixel=160.0,
    file_bytes_per_pixel=3.0,
    redraw_s=0.3,
)

CHANNEL = Channel(
    effects=EFFECTS,
    psf=_psf,
    readout=readout.RAMP,
    bands=bands.single_camera_bands("nisp", "euclid_y", "euclid_j", "euclid_h"),
    sky=diffuse_light.thermal_sky,
    cost=COST,
    sky_types=(*SKY_TYPES, "standard_star"),
    diffraction_edges=euclid.nisp_edges,
    draws_moving_bodies=True,
    non_source_effects=(calibration_lamp.EFFECT,),
    has_scattered_light=True,
    ramp_name="photometric",
    persistence_effect=persistence.EFFECT,
    chromatic_effect=chromatic_response.EFFECT,
)
